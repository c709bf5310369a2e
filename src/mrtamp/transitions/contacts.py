"""Contact configurations on the roadmaps: checked, and joined to the rest by approach, lift and retreat motions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mrtamp.modes import Attachment, Mode
from mrtamp.roadmap import Roadmap
from mrtamp.transitions.candidate import Outcome, SolvedHandover
from mrtamp.transitions.workspace import Workspace

APPROACH = (0.07, 0.15, 0.25)
"""Distances (m) of the approach vertices from a contact vertex, along the hand's approach direction."""
LIFT = (0.015, 0.08, 0.2)
"""Distances (m) of the lift vertices along the support's normal, where the hand does not come from there."""
_CHAIN_JUMP = 1.0
"""Largest change (rad) of a joint between neighbours of a chain: more would be another arm posture."""
_CHAIN_SAMPLES = 8
_UP = np.array([0.0, 0.0, 1.0])


class ContactBuilder:
    """Puts transition configurations that are valid for their robots alone onto the roadmaps."""

    def __init__(self, workspace: Workspace) -> None:
        self.workspace = workspace
        self.problem = workspace.problem
        self.roadmaps = workspace.roadmaps
        self.validity = workspace.validity
        self._normals = {s.name: s.X_BS.rotation().matrix()[:, 2] for s in self.problem.supports}

    def contact(
        self,
        robot: str,
        placement: Attachment,
        chain: tuple[Attachment, ...],
        grasp: Attachment,
        q: np.ndarray,
        stats: Outcome,
        mode: Mode,
    ) -> int | None:
        """Check a contact configuration alone and put it, with its approach and lift chains, on the roadmap."""
        roadmap = self.roadmaps[robot]
        world = roadmap.world
        item = grasp.object
        slot = world.slot_of[item]
        below = {a.object: self.validity.world_pose(chain[k:]) for k, a in enumerate(chain) if k > 0}
        # What stands in the way now is a reason not to act now; the counts tell the guidance who it is.
        around = {r.name: r.X_WO for r in self.validity.resting(mode) if r.name != item} | below
        X_WO = self.validity.world_pose(chain)
        holding = world.rows(q[None], grasp, around)
        if world.first_hit(holding, placement.parent, slot) >= 0:
            self._blame(stats, world.culprits(holding[0], placement.parent, slot), {robot, slot})
            return None
        open_hand = world.rows(q[None], None, {**around, item: X_WO})
        if world.first_hit(open_hand) >= 0:
            self._blame(stats, world.culprits(open_hand[0]), {robot})
            return None
        X_WG = world.tool.matrix(q[None])[0]
        normal = self._normal(placement, chain)
        away = -X_WG[:3, 2]
        same = float(away @ normal) > 1 - 1e-6
        approach = self._chain(robot, q, X_WG, away, APPROACH)
        lift = approach if same else self._chain(robot, q, X_WG, normal, LIFT)
        if not len(approach) or not len(lift):
            stats.collisions["no approach"] += 1
            return None
        # The first step of each chain is the only way in or out.
        arrive = world.rows(np.linspace(q, approach[0], _CHAIN_SAMPLES), None, {**around, item: X_WO})
        carry = world.rows(np.linspace(q, lift[0], _CHAIN_SAMPLES), grasp, around)
        if world.first_hit(arrive) >= 0 or world.first_hit(carry, placement.parent, slot) >= 0:
            stats.collisions["no approach"] += 1
            return None
        v = roadmap.add_vertex(q, connect=False)
        roadmap.contact[roadmap.edge(v, v)] = (item, placement.parent)
        exits = self._attach(roadmap, v, approach, (item, placement.parent) if same else None)
        if not same:
            exits += self._attach(roadmap, v, lift, (item, placement.parent))
        roadmap.exits[v] = exits
        return v

    def open_hand_fits(self, mode: Mode, robot: str, item: str, q: np.ndarray, stats: Outcome) -> np.ndarray:
        """Which configurations (N, n) put the open hand around a resting object without touching anything (N,)."""
        world = self.roadmaps[robot].world
        rows = world.rows(q, None, {r.name: r.X_WO for r in self.validity.resting(mode)})
        hits = world.hits(rows)
        for row in rows[hits]:
            self._blame(stats, world.culprits(row), {robot})
        return ~hits

    def _blame(self, stats: Outcome, culprits: list[tuple[str, str]], self_names: set[str]) -> None:
        for a, b in culprits:
            others = [x for x in (a, b) if x not in self_names]
            stats.collisions[others[0] if others else "itself"] += 1

    def _normal(self, placement: Attachment, chain: tuple[Attachment, ...]) -> np.ndarray:
        normal = self._normals.get(placement.support or "")
        if normal is None:
            return _UP
        X_WB = self.validity.world_pose(chain[1:]) if len(chain) > 1 else self.validity.X_WB[placement.parent]
        return X_WB[:3, :3] @ normal

    def _chain(
        self, robot: str, q: np.ndarray, X_WG: np.ndarray, direction: np.ndarray, distances: Sequence[float]
    ) -> list[np.ndarray]:
        """Configurations along a straight retreat of the hand, as far as they continue q without a jump."""
        return self._chains(robot, q[None], X_WG[None], direction[None], distances)[0]

    def _chains(
        self, robot: str, q: np.ndarray, X_WG: np.ndarray, direction: np.ndarray, distances: Sequence[float]
    ) -> list[list[np.ndarray]]:
        """The same for N configurations (N, n), hands (N, 4, 4) and directions (N, 3), by IK in one batch."""
        n, k = len(q), len(distances)
        targets = np.repeat(X_WG, k, axis=0)
        targets[:, :3, 3] += (np.array(distances)[:, None] * direction[:, None]).reshape(-1, 3)
        found, solved = self.workspace.ik(robot, targets, np.repeat(q, k, axis=0))
        jumps = np.abs(np.diff(np.concatenate([q[:, None], found.reshape(n, k, -1)], axis=1), axis=1)).max(axis=2)
        goes_on = np.cumprod(solved.reshape(n, k) & (jumps <= _CHAIN_JUMP), axis=1).sum(axis=1)
        return [list(x[:m]) for x, m in zip(found.reshape(n, k, -1), goes_on.tolist(), strict=True)]

    def with_retreats(self, handovers: Sequence[SolvedHandover]) -> list[SolvedHandover]:
        """Handovers between the same two robots with their retreats, in one batch."""
        if not handovers:
            return []
        retreats: list[dict[str, list[np.ndarray]]] = [{} for _ in handovers]
        for robot in handovers[0].q:
            q = np.array([h.q[robot] for h in handovers])
            X_WG = self.roadmaps[robot].world.tool.matrix(q)
            for own, chain in zip(retreats, self._chains(robot, q, X_WG, -X_WG[:, :3, 2], APPROACH[:2]), strict=True):
                own[robot] = chain
        return [replace(h, retreats=own) for h, own in zip(handovers, retreats, strict=True)]

    def _attach(
        self, roadmap: Roadmap, v: int, chain: Sequence[np.ndarray], contact: tuple[str, str] | None
    ) -> list[int]:
        last, exits = v, []
        for x in chain:
            i = roadmap.add_vertex(x)
            e = roadmap.edge(last, i)
            if contact is not None and last == v:
                roadmap.contact[e] = contact
            exits.append(i)
            last = i
        return exits

    def exchange(self, handover: SolvedHandover, stats: Outcome) -> dict[str, int] | None:
        """Check a handover configuration before and after, and put both contact vertices on their roadmaps."""
        given, taken = handover.given, handover.taken
        giver, receiver = given.parent, taken.parent
        qa, qb = handover.q[giver], handover.q[receiver]
        worlds = [self.roadmaps[r].world for r in (giver, receiver)]
        for world, q, grasp in ((worlds[0], qa, given), (worlds[1], qb, taken)):
            for held in (grasp, None):
                rows = world.rows(q[None], held, {})
                if world.first_hit(rows) >= 0:
                    self._blame(stats, world.culprits(rows[0]), {world.name, *world.slot_of.values()})
                    return None
        collision = self.workspace.collision
        # The receiver's fingers close before the giver's open; both are looked at on their way.
        stages: list[tuple[Attachment | None, Attachment | None, tuple[float | None, float | None]]] = [
            (given, None, (None, None)),
            *((None, None, (given.width, w)) for w in self._widths(receiver, taken)),
            *((None, None, (w, taken.width)) for w in self._widths(giver, given)),
            (None, taken, (None, None)),
        ]

        def apart(
            a: np.ndarray, ha: Attachment | None, b: np.ndarray, hb: Attachment | None, w: tuple = (None, None)
        ) -> bool:
            return collision.first_hit(giver, a, ha, receiver, b, hb, w) < 0

        if not all(apart(qa[None], ha, qb[None], hb, widths) for ha, hb, widths in stages):
            stats.collisions["each other"] += 1
            return None
        retreats = handover.retreats or self.with_retreats([handover])[0].retreats
        assert retreats is not None
        if not retreats[giver] or not retreats[receiver]:
            stats.collisions["no approach"] += 1
            return None
        # The receiver comes in while the giver holds, the giver leaves while the receiver holds.
        leave = np.linspace(qa, retreats[giver][0], _CHAIN_SAMPLES)
        enter = np.linspace(qb, retreats[receiver][0], _CHAIN_SAMPLES)
        stay_a, stay_b = np.tile(qa, (_CHAIN_SAMPLES, 1)), np.tile(qb, (_CHAIN_SAMPLES, 1))
        clear = apart(stay_a, given, enter, None) and apart(leave, None, stay_b, taken)
        if not clear or any(w.first_hit(w.rows(x, None, {})) >= 0 for w, x in zip(worlds, (leave, enter), strict=True)):
            stats.collisions["no approach"] += 1
            return None
        at: dict[str, int] = {}
        for robot, q in ((giver, qa), (receiver, qb)):
            roadmap = self.roadmaps[robot]
            v = roadmap.add_vertex(q, connect=False)
            roadmap.exits[v] = self._attach(roadmap, v, retreats[robot], None)
            at[robot] = v
        return at

    def _widths(self, robot: str, grasp: Attachment) -> np.ndarray:
        """Opening widths (m) from open to closed on the object."""
        gripper = self.problem.robot(robot).model.gripper
        assert gripper is not None
        if grasp.width is None:
            # Taken by a subgoal: the fingers do not move.
            return np.array([gripper.max_width])
        return np.linspace(gripper.max_width, grasp.width, 5)
