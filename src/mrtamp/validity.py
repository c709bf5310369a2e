"""Which roadmap edges are free in which mode: factored and cached answers, computed when first asked for.

A mode's verdict on an edge is the conjunction of factors that outlive the mode: robot and load against the static
world, against each resting object at its pose, and against each other robot.  A new mode re-checks only what changed
in it.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from mrtamp.collision import Collision, RobotWorld, bisection_order
from mrtamp.modes import Attachment, Mode, static_poses
from mrtamp.problem import Problem
from mrtamp.roadmap import Roadmap

_GLANCES = (0.5, 0.25, 0.75)
"""Where on its edges a path is looked at, besides the vertices, before any edge is validated."""
_BESIDE = 16
"""Edges of either end of an edge found to be blocked that are looked at beside that place."""
_SLACK = 0.012
"""Clearance (m) of bounding spheres below which Drake is asked: padding plus half a step."""


@dataclass
class Label:
    """Edges known to be free, and known to be blocked, with respect to one factor."""

    free: set[int] = field(default_factory=set)
    hit: set[int] = field(default_factory=set)

    def get(self, e: int) -> bool | None:
        """True free, False blocked, None unknown."""
        return True if e in self.free else False if e in self.hit else None

    def put(self, e: int, free: bool) -> None:
        """Record a verdict, instead of an earlier one if there was any."""
        (self.hit if free else self.free).discard(e)
        (self.free if free else self.hit).add(e)


@dataclass(frozen=True)
class Resting:
    """A resting object of a mode: the chain of attachments that fixes it (the cache key) and its world pose."""

    name: str
    chain: tuple[Attachment, ...]
    X_WO: np.ndarray = field(compare=False)


class Validity:
    """Cached verdicts on edges of all roadmaps.

    Without `remember`, verdicts are kept for the mode they were asked for only: nothing is shared between modes.
    """

    def __init__(
        self, problem: Problem, collision: Collision, roadmaps: Mapping[str, Roadmap], *, remember: bool = True
    ) -> None:
        self.remember = remember
        self.collision = collision
        self.roadmaps = roadmaps
        self.counts = collision.counts
        self.X_WB = static_poses(problem)
        self.touching: dict[tuple[str, int], tuple[str, str]] = {}
        """(robot, vertex) of a subgoal that takes or releases an object -> that object and what it rests on there."""
        self._labels: dict[Hashable, Label] = {}
        self._moves: dict[Hashable, bool] = {}
        self._forbidden: dict[tuple[str, tuple[Attachment, ...]], set[int]] = {}
        self._poses: dict[tuple[Attachment, ...], np.ndarray] = {}
        self._resting: dict[tuple[Attachment, ...], tuple[Resting, ...]] = {}

    def label(self, key: Hashable) -> Label:
        """The label of a factor."""
        found = self._labels.get(key)
        if found is None:
            found = self._labels[key] = Label()
        return found

    def key(self, mode: Mode, key: Hashable) -> Hashable:
        """What a factor is known by in `mode`: the same in all modes, if they remember."""
        return key if self.remember else (mode.key, key)

    def known(self, mode: Mode, key: Hashable) -> Label:
        """The label of a factor, as far as it may be used in `mode`."""
        return self.label(self.key(mode, key))

    def insert(self, robot: str, e: int) -> None:
        """Ask at once whether the robot, with its hand empty, may move along a new edge in the static world."""
        self._ask(robot, e, None, self.label((robot, None, None)), [])

    def world_pose(self, chain: tuple[Attachment, ...]) -> np.ndarray:
        """World pose (4, 4) of an object at rest, from its chain of attachments."""
        X = self._poses.get(chain)
        if X is None:
            base = self.X_WB[chain[0].parent] if len(chain) == 1 else self.world_pose(chain[1:])
            X = self._poses[chain] = base @ chain[0].X_PO
        return X

    def resting(self, mode: Mode) -> tuple[Resting, ...]:
        """The resting objects of a mode."""
        found = self._resting.get(mode.attachments)
        if found is None:
            out = []
            for a in mode.attachments:
                if not a.held:
                    chain = mode.chain(a.object)
                    out.append(Resting(a.object, chain, self.world_pose(chain)))
            found = self._resting[mode.attachments] = tuple(out)
        return found

    def blocked(self, robot: str, mode: Mode, at: Mapping[str, int]) -> np.ndarray:
        """Edges (E,) of a robot already known to be blocked in `mode` with the other robots standing at `at`."""
        mask = np.zeros(self.roadmaps[robot].n_edges, dtype=bool)
        held = mode.held.get(robot)
        keys: list[Hashable] = [(robot, held, None)]
        keys += [(robot, held, r.chain) for r in self.resting(mode)]
        keys += [(robot, held, other, v, mode.held.get(other)) for other, v in at.items() if other != robot]
        keys = [*dict.fromkeys([*(self.key(mode, k) for k in keys), *keys[:1]])]
        for key in keys:
            found = self._labels.get(key)
            if found is not None and found.hit:
                mask[list(found.hit)] = True
        mask[list(self._forbidden.get((robot, mode.attachments), ()))] = True
        return mask

    def edge(self, robot: str, e: int, mode: Mode) -> bool:
        """Whether the robot, with what it holds, may move along edge e in `mode`, other robots aside."""
        held = mode.held.get(robot)
        static = self.known(mode, (robot, held, None))
        verdict = static.get(e)
        if verdict is False or e in self._forbidden.get((robot, mode.attachments), ()):
            return False
        if not self.remember and e in self.label((robot, held, None)).hit:
            # Found out when the edge was made.
            return False
        unknown: list[tuple[Resting, Label]] = []
        for item in self.resting(mode):
            factor = self.known(mode, (robot, held, item.chain))
            known = factor.get(e)
            if known is False:
                return False
            if known is None:
                unknown.append((item, factor))
        if verdict is True:
            # Where Drake has to be asked anyway, it is not asked about less.
            unknown = self._cull(robot, e, held, unknown)
            if not unknown:
                return True
        return self._ask(robot, e, held, static, unknown)

    def _cull(
        self, robot: str, e: int, held: Attachment | None, unknown: list[tuple[Resting, Label]]
    ) -> list[tuple[Resting, Label]]:
        """Drop objects that bounding spheres prove to be out of reach of the edge."""
        if not unknown:
            return unknown
        roadmap = self.roadmaps[robot]
        world = roadmap.world
        centres, radii = self._spheres(robot, e, held)
        kept = []
        for item, factor in unknown:
            p = item.X_WO[:3, 3]
            gap = np.linalg.norm(centres - p, axis=2) - radii
            if gap.min() > world.object_radius[item.name] + _SLACK:
                factor.put(e, True)
            else:
                kept.append((item, factor))
        return kept

    def _spheres(self, robot: str, e: int, held: Attachment | None) -> tuple[np.ndarray, np.ndarray]:
        """Bounding spheres of robot and load along an edge: centres (n, B, 3), radii (B,)."""
        roadmap = self.roadmaps[robot]
        world = roadmap.world
        centres, radii = roadmap.spheres(e), world.bounds.radii
        if held is not None:
            R, p = world.tool.pose(roadmap.path_samples(e))
            load = p + R @ held.X_PO[:3, 3]
            centres = np.concatenate([centres, load[:, None]], axis=1)
            radii = np.append(radii, world.object_radius[held.object])
        return centres, radii

    def _ask(
        self, robot: str, e: int, held: Attachment | None, static: Label, unknown: list[tuple[Resting, Label]]
    ) -> bool:
        roadmap = self.roadmaps[robot]
        world = roadmap.world
        q = roadmap.path_samples(e)
        rows = world.rows(q, held, {item.name: item.X_WO for item, _ in unknown})
        rows = rows[bisection_order(len(rows))]
        contact, slot = self._contact(roadmap, e, held)
        self.counts.edges_validated += 1
        i = world.first_hit(rows, contact, slot)
        if i < 0:
            static.put(e, True)
            for _, factor in unknown:
                factor.put(e, True)
            return True
        for factor in self._guilty(world, rows[i], static, unknown, contact, slot):
            factor.put(e, False)
        return False

    @staticmethod
    def _guilty(
        world: RobotWorld,
        row: np.ndarray,
        static: Label,
        objects: list[tuple[Resting, Label]],
        contact: str | None = None,
        slot: str | None = None,
    ) -> list[Label]:
        """The factors in whose way a row of positions is: objects or, where it is none of them, all the rest."""
        names = {x for pair in world.culprits(row, contact, slot) for x in pair}
        return [factor for item, factor in objects if item.name in names] or [static]

    def glance(self, robot: str, edges: Sequence[int], mode: Mode) -> list[int]:
        """Edges that a few samples of some `edges`, the first of which matter most, show to be blocked in `mode`.

        Where the robot cannot even be at one of their vertices, all edges of that vertex are; where it cannot be
        between two, some that pass by there most likely are, too.
        """
        roadmap, held = self.roadmaps[robot], mode.held.get(robot)
        world, static = roadmap.world, self.known(mode, (robot, held, None))
        factors = [(item, self.known(mode, (robot, held, item.chain))) for item in self.resting(mode)]
        open_ = [
            e
            for e in edges
            if (static.get(e) is None or any(factor.get(e) is None for _, factor in factors))
            and self._contact(roadmap, e, held) == (None, None)
        ]
        if not open_:
            return []
        vertices = list(dict.fromkeys(roadmap.ends[open_].ravel().tolist()))
        a, b = (roadmap.q[roadmap.ends[open_, k]] for k in (0, 1))
        q = np.concatenate([roadmap.q[vertices], *(a + t * (b - a) for t in _GLANCES)])
        objects = {item.name: item.X_WO for item, _ in factors}
        rows = world.rows(q, held, objects)
        i = world.first_hit(rows)
        if i < 0:
            return []
        if i < len(vertices):
            around = roadmap.arcs(vertices[i])[1].tolist()
            found = [(rows[i], [e for e in around if self._contact(roadmap, e, held) == (None, None)])]
        else:
            e = open_[(i - len(vertices)) % len(open_)]
            labels = [static, *(factor for _, factor in factors)]
            others, q = self._beside(roadmap, e, q[i], held, labels)
            beside = world.rows(q, held, objects)
            found = [(rows[i], [e]), *((beside[k], [others[k]]) for k in np.flatnonzero(world.hits(beside)))]
        for row, blocked in found:
            for factor in self._guilty(world, row, static, factors):
                for e in blocked:
                    factor.put(e, False)
        return [e for _, blocked in found for e in blocked]

    def _beside(
        self, roadmap: Roadmap, e: int, q: np.ndarray, held: Attachment | None, labels: Sequence[Label]
    ) -> tuple[list[int], np.ndarray]:
        """Edges (k,) that share an end with e and pass near to q (n,) on it, and where they do (k, n).

        Those that are blocked by what any of `labels` stands for are left out.
        """

        def asked(f: int) -> bool:
            return not any(f in label.hit for label in labels) and self._contact(roadmap, f, held) == (None, None)

        found, passing = [], [np.zeros((0, roadmap.n_dof))]
        for v in roadmap.ends[e].tolist():
            there, edges = roadmap.arcs(v)
            way = roadmap.q[there] - roadmap.q[v]
            length = np.linalg.norm(way, axis=1)
            reach = float(np.linalg.norm(q - roadmap.q[v]))
            longer = [k for k, f in enumerate(edges.tolist()) if length[k] > reach and f != e and asked(f)]
            x = roadmap.q[v] + way[longer] * (reach / length[longer])[:, None]
            nearest = np.argsort(np.linalg.norm(x - q, axis=1), kind="stable")[:_BESIDE]
            found += edges[longer][nearest].tolist()
            passing.append(x[nearest])
        return found, np.concatenate(passing)

    def _contact(self, roadmap: Roadmap, e: int, held: Attachment | None) -> tuple[str | None, str | None]:
        """The body that the load may touch along an edge that ends where it is lifted or put down, and its slot."""
        if held is None:
            return None, None
        item, body = roadmap.contact.get(e, (None, None))
        for v in roadmap.ends[e].tolist() if item is None else ():
            item, body = self.touching.get((roadmap.name, v), (item, body))
        return (body, roadmap.world.slot_of[item]) if item == held.object else (None, None)

    def against(self, robot: str, e: int, mode: Mode, other: str, v: int) -> bool:
        """Whether the robot may move along edge e while `other` stands at its vertex v."""
        held, other_held = mode.held.get(robot), mode.held.get(other)
        factor = self.known(mode, (robot, held, other, v, other_held))
        known = factor.get(e)
        if known is not None:
            return known
        stand = self.roadmaps[other].edge(v, v)
        free = self._apart(robot, e, held, other, stand, other_held, False)
        factor.put(e, free)
        return free

    def move(self, mode: Mode, a: str, edge_a: tuple[int, int], b: str, edge_b: tuple[int, int]) -> bool:
        """Whether two robots may move along directed edges (from, to) at the same time."""
        if a > b:
            a, edge_a, b, edge_b = b, edge_b, a, edge_a
        held_a, held_b = mode.held.get(a), mode.held.get(b)
        key = self.key(mode, (a, edge_a, held_a, b, edge_b, held_b))
        known = self._moves.get(key)
        if known is None:
            ea, eb = self.roadmaps[a].edge(*edge_a), self.roadmaps[b].edge(*edge_b)
            opposed = (edge_a[0] > edge_a[1]) != (edge_b[0] > edge_b[1])
            known = self._moves[key] = self._apart(a, ea, held_a, b, eb, held_b, opposed)
        return known

    def _apart(
        self, a: str, ea: int, held_a: Attachment | None, b: str, eb: int, held_b: Attachment | None, opposed: bool
    ) -> bool:
        """Synchronous motion of two robots along edges; `opposed`: they are stored in opposite directions of travel."""
        na, nb = self.roadmaps[a].n_samples(ea), self.roadmaps[b].n_samples(eb)
        ca, ra = self._spheres(a, ea, held_a)
        cb, rb = self._spheres(b, eb, held_b)
        reach = ra[None, :, None] + rb[None, None, :] + _SLACK
        if nb == 1 or na == 1:
            gap = np.linalg.norm(ca[:, :, None] - cb[:, None], axis=3) - reach
            close = np.flatnonzero(gap.min(axis=(1, 2)) < 0)
            n = max(na, nb)
        else:
            low_a, high_a = (ca - ra[:, None]).min(axis=(0, 1)), (ca + ra[:, None]).max(axis=(0, 1))
            low_b, high_b = (cb - rb[:, None]).min(axis=(0, 1)), (cb + rb[:, None]).max(axis=(0, 1))
            if np.any(low_a > high_b + _SLACK) or np.any(low_b > high_a + _SLACK):
                return True
            n = max(na, nb)
            rows_b = np.arange(n)[::-1] if opposed else np.arange(n)
            ia = np.round(np.arange(n) * (na - 1) / (n - 1)).astype(int)
            ib = np.round(rows_b * (nb - 1) / (n - 1)).astype(int)
            gap = np.linalg.norm(ca[ia][:, :, None] - cb[ib][:, None], axis=3) - reach
            # The coarser robot's spheres are read at the nearest sample, up to half a step away.
            close = np.flatnonzero(gap.min(axis=(1, 2)) < 0.01)
        if not len(close):
            return True
        qa = self.roadmaps[a].path_samples(ea, n)
        qb = self.roadmaps[b].path_samples(eb, n)
        if opposed:
            qb = qb[::-1]
        close = close[bisection_order(len(close))]
        # Robots may stand at the ends of an edge: no padding there.
        exact = (close == 0) | (close == n - 1)
        return self.collision.first_hit(a, qa[close], held_a, b, qb[close], held_b, exact=exact) < 0

    def stand(self, mode: Mode, at: Mapping[str, int], robots: tuple[str, ...]) -> str | None:
        """None if `robots` may stand at their vertices among all others in `mode`; else who is in the way."""
        for robot in robots:
            e = self.roadmaps[robot].edge(at[robot], at[robot])
            if not self.edge(robot, e, mode):
                return "world"
            for other, v in at.items():
                if other != robot and not self.against(robot, e, mode, other, v):
                    return other
        return None

    def forbid(
        self,
        mode: Mode,
        a: Mapping[str, int],
        b: Mapping[str, int],
        guilty: tuple[str, ...],
        obstacle: str | None = None,
    ) -> None:
        """Record that the step from vertices a to b collides after all.

        `guilty` names one robot or two; `obstacle` what a single one hits: a resting object, or else the static world
        or itself.  Without it the verdict holds for this very mode only.
        """
        edges = {r: self.roadmaps[r].edge(a[r], b[r]) for r in guilty}
        if len(guilty) == 1:
            [robot] = guilty
            chains = {r.name: r.chain for r in self.resting(mode)}
            if obstacle is None:
                self._forbidden.setdefault((robot, mode.attachments), set()).add(edges[robot])
            else:
                self.known(mode, (robot, mode.held.get(robot), chains.get(obstacle))).put(edges[robot], False)
            return
        one, two = sorted(guilty)
        moving = [r for r in (one, two) if a[r] != b[r]]
        if len(moving) == 2:
            key = (one, (a[one], b[one]), mode.held.get(one), two, (a[two], b[two]), mode.held.get(two))
            self._moves[self.key(mode, key)] = False
            return
        for robot in moving or [one]:
            other = two if robot == one else one
            factor = self.known(mode, (robot, mode.held.get(robot), other, a[other], mode.held.get(other)))
            factor.put(edges[robot], False)
