"""Conditional stratified transition sampling (paper, section IV-A): strata -> candidates standing on roadmap vertices.

A pick and a place with the same object, grasp and placement share one configuration, so both are labels on the same
*contact vertex*, reached through a chain of approach vertices.  A handover is a pair of contact vertices.  Samples are kept: every
candidate ever accepted stays available to the search, and new ones are added for ever.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from mrtamp.collision import Collision
from mrtamp.kinematics import inverse, matrix
from mrtamp.modes import Attachment, Mode
from mrtamp.plan import Action
from mrtamp.problem import AtPose, InRegion, Problem, Support
from mrtamp.roadmap import Roadmap
from mrtamp.transitions.families import FixedFamily, GraspFamily, grasp_families, placement_families
from mrtamp.transitions.projection import mixed_seeds, solve_ik, uniform_configurations
from mrtamp.transitions.stratum import Stratum
from mrtamp.validity import Validity

APPROACH = (0.07, 0.15, 0.25)
"""Distances (m) of the approach vertices from a contact vertex, along the hand's approach direction."""
LIFT = (0.04, 0.12, 0.22)
"""Distances (m) of the lift vertices along the support's normal, where the hand does not come from there."""
_CHAIN_JUMP = 1.0
_GRASP_DRAWS = 8
_EXCHANGE_SAMPLES = 8
_SEEDS = 3
_POOL = 48
"""Grasps per robot and object that are known to lead on to the goal; enough to choose from."""
_ROOM = 0.3
"""Distance (m) between two palms beyond which more does not help."""
_PALM = 0.08
"""How far (m) behind the grasp point the bulk of a hand lies, for guessing whether two hands have room."""
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class Candidate:
    """An elementary transition that stands on roadmap vertices.

    `at` maps each active robot to its contact vertex.  `base` is the chain of attachments of the object it is placed
    on or picked from (empty for a static body): the candidate exists only while that object is there.  `promising` is
    the sampler's guess that what is gained can be put down at its goal; guidance prefers such candidates.
    """

    kind: str
    robots: tuple[str, ...]
    at: Mapping[str, int]
    before: Attachment
    after: Attachment
    base: tuple[Attachment, ...] = ()
    promising: bool = True

    @property
    def object(self) -> str:
        """The object that changes hands."""
        return self.after.object

    @property
    def action(self) -> Action:
        """The change of attachment, without the vertices."""
        return Action(self.kind, self.robots, self.before, self.after)


StratumKey = tuple[str, tuple[str, ...], str, str]
"""Kind, robots, object, and the place it comes from (pick), goes to (place) or the giver (handover)."""


@dataclass
class Outcome:
    """What became of the samples of one stratum."""

    calls: int = 0
    samples: int = 0
    ik_solved: int = 0
    accepted: int = 0
    collisions: Counter[str] = field(default_factory=Counter)


class TransitionSampler:
    """Samples strata, checks single-robot validity, and turns what is feasible into candidates on the roadmaps."""

    def __init__(
        self,
        problem: Problem,
        collision: Collision,
        roadmaps: Mapping[str, Roadmap],
        validity: Validity,
        rng: np.random.Generator,
    ) -> None:
        self.problem = problem
        self.collision = collision
        self.roadmaps = roadmaps
        self.validity = validity
        self.rng = rng
        self.outcomes: dict[StratumKey, Outcome] = {}
        self._picks: dict[tuple[str, tuple[Attachment, ...]], list[Candidate]] = {}
        self._places: dict[tuple[str, Attachment], list[Candidate]] = {}
        self._handovers: dict[tuple[Attachment, str], list[Candidate]] = {}
        self._fixed: dict[tuple[str, int], Attachment] = {}
        self._grasps: dict[tuple[str, str, int], Attachment] = {}
        self._pools: dict[tuple[str, str], list[Attachment]] = {}
        self.families: dict[tuple[str, str], list[GraspFamily]] = {}
        self.reach: dict[str, tuple[np.ndarray, float]] = {}
        for robot in problem.robots:
            gripper = robot.model.gripper
            for item in problem.objects:
                fits = grasp_families(item, gripper.max_width) if gripper else []
                self.families[robot.name, item.name] = fits
            tool = roadmaps[robot.name].world.tool
            spread = tool.pose(uniform_configurations(tool, np.random.default_rng(0), 2000))[1]
            centre = spread.mean(axis=0)
            self.reach[robot.name] = (centre, float(np.linalg.norm(spread - centre, axis=1).max()))
        self._normals: dict[str, np.ndarray] = {s.name: s.X_BS.rotation().matrix()[:, 2] for s in problem.supports}
        self.goal_supports: dict[str, list[Support]] = {o.name: _goal_supports(problem, o.name) for o in problem.objects}

    # -- strata ---------------------------------------------------------------------------------------------------

    def strata(self, mode: Mode, kind: str, robots: tuple[str, ...], item: str, place: str = "") -> list[Stratum]:
        """The elementary strata of one kind, pair of robot(s) and object in `mode`; one per family of choices."""
        tools = tuple(self.roadmaps[r].world.tool for r in robots)
        if kind == "pick":
            base = self.validity.world_pose(mode.chain(item))
            return [
                Stratum("pick", robots, item, tools, f, base, np.eye(4)) for f in self.families[robots[-1], item]
            ]
        held = mode.of[item]
        if kind == "place":
            support = self.problem.support(place)
            base = self._body_pose(mode, support.body)
            families = placement_families(self.problem.object(item), support, self.problem.package_paths)
            return [Stratum("place", robots, item, tools, f, base, held.X_PO) for f in families]
        return [
            Stratum("handover", robots, item, tools, f, np.eye(4), np.eye(4), held.X_PO)
            for f in self.families[robots[-1], item]
        ]

    def _body_pose(self, mode: Mode, body: str) -> np.ndarray:
        if body in mode.of:
            return self.validity.world_pose(mode.chain(body))
        return self.validity.X_WB[body]

    def outcome(self, key: StratumKey) -> Outcome:
        """Statistics of a stratum."""
        return self.outcomes.setdefault(key, Outcome())

    def in_reach(self, robot: str, p: np.ndarray) -> bool:
        """Whether a point lies inside the ball that the robot's grasp point was seen to reach."""
        centre, radius = self.reach[robot]
        return bool(np.linalg.norm(p - centre) <= radius)

    # -- known candidates -----------------------------------------------------------------------------------------

    def picks(self, mode: Mode, robot: str, item: str) -> list[Candidate]:
        """Known picks of an object where it rests in `mode`."""
        return self._picks.get((robot, mode.chain(item)), [])

    def places(self, mode: Mode, robot: str, support: str | None = None) -> list[Candidate]:
        """Known places for what `robot` holds in `mode`, on one support or on all."""
        found = self._places.get((robot, mode.held[robot]), [])
        return [
            c
            for c in found
            if (support is None or c.after.support == support)
            and (not c.base or (not mode.of[c.base[0].object].held and c.base == mode.chain(c.base[0].object)))
        ]

    def handovers(self, mode: Mode, giver: str, receiver: str) -> list[Candidate]:
        """Known handovers of what `giver` holds to `receiver`."""
        return self._handovers.get((mode.held[giver], receiver), [])

    # -- sampling -------------------------------------------------------------------------------------------------

    def sample_pick(self, mode: Mode, robot: str, item: str, n: int = 48, keep: int = 4) -> list[Candidate]:
        """Sample picks of a resting object; returns the new candidates."""
        placement, chain = mode.of[item], mode.chain(item)
        strata = self.strata(mode, "pick", (robot,), item)
        stats = self.outcome(("pick", (robot,), item, placement.place))
        stats.calls += 1
        if not strata:
            stats.collisions["gripper too small"] += 1
            return []
        drawn = self._draw(robot, strata, n, stats)
        if drawn is None:
            return []
        q, family, c, _ = drawn
        grasps = [self._grasp(robot, item, strata[f].family, f, c[i]) for i, f in enumerate(family)]
        reward = self._look_ahead(mode, robot, item, grasps, q)
        near = np.linalg.norm(q - self.roadmaps[robot].world.home, axis=1)
        promising = np.isfinite(reward)
        if not promising.any() and self.goal_supports[item]:
            promising[:] = True
            # Somebody else will have to take it over: a grasp that leaves room for a second hand is worth a detour.
            for other in self.roadmaps:
                if other != robot:
                    self._grow_pool(mode, other, item)
            near = near - 30.0 * self._room(item, robot, grasps)
        order = self._mixed_order(near + np.where(np.isfinite(reward), reward, 50.0))
        out: list[Candidate] = []
        for i in order[: 4 * keep]:
            v = self._contact(robot, placement, chain, grasps[i], q[i], stats)
            if v is not None:
                candidate = Candidate(
                    "pick", (robot,), {robot: v}, placement, grasps[i], chain[1:], bool(promising[i])
                )
                self._picks.setdefault((robot, chain), []).append(candidate)
                back = Candidate("place", (robot,), {robot: v}, grasps[i], placement, chain[1:])
                self._places.setdefault((robot, grasps[i]), []).append(back)
                out.append(candidate)
                stats.accepted += 1
                if len(out) == keep:
                    break
        return out

    def sample_place(self, mode: Mode, robot: str, support: str, n: int = 48, keep: int = 3) -> list[Candidate]:
        """Sample places of what `robot` holds on a support; returns the new candidates."""
        grasp = mode.held[robot]
        item = grasp.object
        strata = self.strata(mode, "place", (robot,), item, support)
        stats = self.outcome(("place", (robot,), item, support))
        stats.calls += 1
        body = self.problem.support(support).body
        on_object = body in mode.of
        if not strata or (on_object and mode.of[body].held):
            return []
        drawn = self._draw(robot, strata, n, stats)
        if drawn is None:
            return []
        q, family, c, _ = drawn
        base = mode.chain(body) if on_object else ()
        order = self._mixed_order(np.linalg.norm(q - self.roadmaps[robot].world.home, axis=1))
        out: list[Candidate] = []
        for i in order[: 4 * keep]:
            fixed = isinstance(strata[family[i]].family, FixedFamily)
            X_BO = strata[family[i]].family.pose(c[i][None])[0]
            placement = self._placement(item, body, support, X_BO, fixed)
            v = self._contact(robot, placement, (placement, *base), grasp, q[i], stats, mode)
            if v is not None:
                candidate = Candidate("place", (robot,), {robot: v}, grasp, placement, base)
                self._places.setdefault((robot, grasp), []).append(candidate)
                back = Candidate("pick", (robot,), {robot: v}, placement, grasp, base)
                self._picks.setdefault((robot, (placement, *base)), []).append(back)
                out.append(candidate)
                stats.accepted += 1
                if len(out) == keep:
                    break
        return out

    def sample_handover(self, mode: Mode, giver: str, receiver: str, n: int = 72, keep: int = 3) -> list[Candidate]:
        """Sample handovers of what `giver` holds to `receiver`; returns the new candidates."""
        grasp = mode.held[giver]
        item = grasp.object
        strata = self.strata(mode, "handover", (giver, receiver), item)
        stats = self.outcome(("handover", (giver, receiver), item, giver))
        stats.calls += 1
        if not strata:
            return []
        self._grow_pool(mode, receiver, item)
        qa, grasps = self._meetings(giver, receiver, grasp, n)
        if not len(qa):
            return []
        stats.samples += len(qa)
        tool = self.roadmaps[receiver].world.tool
        X_WO = self.roadmaps[giver].world.tool.matrix(qa) @ grasp.X_PO
        X_OG = inverse(np.array([g.X_PO for g in grasps]))
        # Most meeting places are near the edge of both arms' reach: several seeds each.
        X_WG = np.repeat(X_WO @ X_OG, _SEEDS, axis=0)
        seeds = mixed_seeds(tool, self.rng, len(X_WG), self._near(receiver))
        found, each = (x.reshape(len(qa), _SEEDS, -1) for x in self._ik(receiver, X_WG, seeds))
        solved = each[:, :, 0].any(axis=1)
        qb = found[np.arange(len(qa)), np.argmax(each[:, :, 0], axis=1)]
        stats.ik_solved += int(solved.sum())
        rows = np.flatnonzero(solved)
        grasps = [grasps[i] for i in rows]
        reward = self._look_ahead(mode, receiver, item, grasps, qb[rows])
        homes = [self.roadmaps[r].world.home for r in (giver, receiver)]
        near = np.linalg.norm(qa[rows] - homes[0], axis=1) + np.linalg.norm(qb[rows] - homes[1], axis=1)
        out: list[Candidate] = []
        promising = np.isfinite(reward)
        if not self._pools.get((receiver, item)):
            promising[:] = True
        elif not promising.any():
            # Nothing here can be put down where it belongs: one such handover is enough.
            keep = 1
        for k in self._mixed_order(near + np.where(np.isfinite(reward), reward, 50.0))[: 8 * keep]:
            at = self._exchange(mode, giver, receiver, grasp, grasps[k], qa[rows[k]], qb[rows[k]], stats)
            if at is not None:
                candidate = Candidate(
                    "handover", (giver, receiver), at, grasp, grasps[k], promising=bool(promising[k])
                )
                self._handovers.setdefault((grasp, receiver), []).append(candidate)
                out.append(candidate)
                stats.accepted += 1
                if len(out) == keep:
                    break
        return out

    def _widths(self, robot: str, grasp: Attachment) -> np.ndarray:
        """Opening widths (m) from open to closed on the object."""
        gripper = self.problem.robot(robot).model.gripper
        assert gripper is not None and grasp.width is not None
        return np.linspace(gripper.max_width, grasp.width, 5)

    # -- steps ----------------------------------------------------------------------------------------------------

    def _draw(
        self, robot: str, strata: Sequence[Stratum], n: int, stats: Outcome
    ) -> tuple[np.ndarray, np.ndarray, list[np.ndarray], np.ndarray] | None:
        """n samples over `strata` with constant base: solved configurations, stratum index, choices, targets."""
        family = self.rng.integers(len(strata), size=n)
        choices = [strata[f].draw_choices(self.rng, 1)[0] for f in family]
        targets = np.concatenate(
            [strata[f].targets(strata[f].base, c[None]) for f, c in zip(family, choices, strict=True)]
        )
        centre, radius = self.reach[robot]
        near = np.linalg.norm(targets[:, :3, 3] - centre, axis=1) <= radius
        stats.samples += n
        if not near.any():
            stats.collisions["out of reach"] += 1
            return None
        family, targets = family[near], targets[near]
        choices = [c for c, ok in zip(choices, near, strict=True) if ok]
        tool = self.roadmaps[robot].world.tool
        q, solved = self._ik(robot, targets, mixed_seeds(tool, self.rng, len(targets), self._near(robot)))
        stats.ik_solved += int(solved.sum())
        if not solved.any():
            return None
        rows = np.flatnonzero(solved)
        return q[rows], family[rows], [choices[i] for i in rows], targets[rows]

    def _near(self, robot: str) -> np.ndarray:
        """Configurations around which short motions are likely: home and some open roadmap vertices."""
        roadmap = self.roadmaps[robot]
        open_vertices = roadmap.open_vertices()
        rows = self.rng.integers(len(open_vertices), size=4)
        return np.vstack([roadmap.world.home[None], roadmap.world.home[None], roadmap.q[[open_vertices[i] for i in rows]]])

    def _ik(self, robot: str, X_WG: np.ndarray, seeds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        q, solved = solve_ik(self.roadmaps[robot].world.tool, X_WG[:, :3, :3], X_WG[:, :3, 3], seeds)
        self.collision.counts.ik_attempts += len(q)
        self.collision.counts.ik_successes += int(solved.sum())
        return q, solved

    def _mixed_order(self, score: np.ndarray) -> np.ndarray:
        """Mostly the lowest scores first, every third one drawn at random, so that no sample is excluded."""
        ranked = np.argsort(score, kind="stable")
        shuffled = self.rng.permutation(len(score))
        out: list[int] = []
        a, b = iter(ranked), iter(shuffled)
        seen: set[int] = set()
        while len(out) < len(score):
            i = int(next(b if len(out) % 3 == 2 else a))
            while i in seen:
                i = int(next(b if len(out) % 3 == 2 else a))
            seen.add(i)
            out.append(i)
        return np.array(out, dtype=int)

    def _grasp(self, robot: str, item: str, family: GraspFamily, index: int, c: np.ndarray) -> Attachment:
        X_GO = inverse(family.pose(c[None]))[0]
        if isinstance(family, FixedFamily):
            key = (robot, item, index)
            if key not in self._grasps:
                self._grasps[key] = Attachment(item, robot, X_GO, None, family.width)
            return self._grasps[key]
        return Attachment(item, robot, X_GO, None, family.width)

    def _placement(self, item: str, body: str, support: str, X_BO: np.ndarray, fixed: bool) -> Attachment:
        if not fixed:
            return Attachment(item, body, X_BO, support)
        key = (f"{item}@{support}", 0)
        if key not in self._fixed:
            self._fixed[key] = Attachment(item, body, X_BO, support)
        return self._fixed[key]

    def remember(self, mode: Mode) -> None:
        """Make the exact placements of the start mode the ones that later samples return to."""
        for a in mode.attachments:
            if a.support is not None and self._is_exact(a.support):
                self._fixed[f"{a.object}@{a.support}", 0] = a

    def _is_exact(self, support: str) -> bool:
        return any(s.name == support and s.X_BO is not None for s in self.problem.supports)

    def _look_ahead(
        self, mode: Mode, robot: str, item: str, grasps: Sequence[Attachment], q: np.ndarray
    ) -> np.ndarray:
        """Joint distance from q to a place at the object's goal with each grasp; infinite where none was found.

        The places are solved by IK and free of collision with the world as it is fixed, nothing more: a ranking, not a
        filter.
        """
        reward = np.full(len(grasps), np.inf)
        if not len(grasps):
            return reward
        world = self.roadmaps[robot].world
        places: list[tuple[Support, dict[str, np.ndarray], np.ndarray]] = []
        for support in self.goal_supports[item]:
            body = support.body
            if body in mode.of and mode.of[body].held:
                continue
            chain = mode.chain(body) if body in mode.of else ()
            below = {a.object: self.validity.world_pose(chain[k:]) for k, a in enumerate(chain)}
            for f in placement_families(self.problem.object(item), support, self.problem.package_paths):
                c = self.rng.uniform(f.lower, f.upper, size=(len(grasps), len(f.lower)))
                places.append((support, below, self._body_pose(mode, body) @ f.pose(c)))
        if not places:
            return reward
        # What is found out here about the places is what sampling them would have found out.
        for name in dict.fromkeys(support.name for support, _, _ in places):
            self.outcome(("place", (robot,), item, name)).calls += 1
        if not any(self.in_reach(robot, X[0, :3, 3]) for _, _, X in places):
            return reward
        which = self.rng.integers(len(places), size=len(grasps))
        X_WO = np.array([places[k][2][i] for i, k in enumerate(which)])
        X_WG = X_WO @ inverse(np.array([g.X_PO for g in grasps]))
        seeds = np.where(self.rng.random(len(q))[:, None] < 0.5, q, world.home)
        found, solved = self._ik(robot, X_WG, seeds + self.rng.normal(scale=0.3, size=q.shape))
        for i in np.flatnonzero(solved):
            support, below, _ = places[which[i]]
            stats = self.outcome(("place", (robot,), item, support.name))
            stats.ik_solved += 1
            rows = world.rows(found[i][None], grasps[i], below)
            if world.first_hit(rows, support.body, world.slot_of[item]) < 0:
                reward[i] = np.linalg.norm(found[i] - q[i])
                stats.accepted += 1
        return reward

    def _meetings(
        self, giver: str, receiver: str, grasp: Attachment, n: int
    ) -> tuple[np.ndarray, list[Attachment]]:
        """Configurations of the giver, and a grasp for the receiver at each, where the two may meet.

        A quarter is uniform in the giver's joints and over the receiver's whole grasp family: positive density over the whole
        stratum.  The rest puts the object between the robots, each hand on its own robot's side, turned freely about the
        line between the hands.
        """
        world = self.roadmaps[giver].world
        tool = world.tool
        own, centre = self.reach[giver][0], self.reach[receiver][0]
        uniform = uniform_configurations(tool, self.rng, 4 * n)
        p = (tool.matrix(uniform) @ grasp.X_PO)[:, :3, 3]
        uniform = uniform[np.linalg.norm(p - centre, axis=1) <= 0.9 * self.reach[receiver][1]][: n // 4]
        families = self.families[receiver, grasp.object]
        free = [
            self._draw_grasp(receiver, grasp.object, int(f)) for f in self.rng.integers(len(families), size=len(uniform))
        ]
        aimed = self._receiving_grasps(receiver, grasp, n)
        gap = float(np.linalg.norm(centre - own))
        where = (own + centre) / 2 + self.rng.normal(scale=0.08 + 0.08 * gap, size=(n, 3))
        X_OG1 = inverse(grasp.X_PO)
        X_OG2 = inverse(np.array([g.X_PO for g in aimed]))
        across = _palms(X_OG2) - _palms(X_OG1)
        ahead = (centre - own) / max(gap, 1e-9)
        turn = _rotations_about(ahead, self.rng.uniform(-np.pi, np.pi, size=n))
        R = _random_rotations(self.rng, n, 0.4) @ turn @ np.swapaxes(_rotations_to(across), 1, 2)
        middle = (X_OG1[:3, 3] + X_OG2[:, :3, 3]) / 2
        X_WO = matrix(R, where - np.einsum("nij,nj->ni", R, middle))
        q, solved = self._ik(giver, X_WO @ X_OG1, mixed_seeds(tool, self.rng, n, self._near(giver)))
        qa = np.concatenate([q[solved], uniform])
        grasps = [*(g for g, ok in zip(aimed, solved, strict=True) if ok), *free]
        clear = ~world.hits(world.rows(qa, grasp, {}))
        return qa[clear], [g for g, ok in zip(grasps, clear, strict=True) if ok]

    def _receiving_grasps(self, receiver: str, given: Attachment, n: int) -> list[Attachment]:
        """n grasps that keep the two hands apart, each the best of a few drawn: mostly of those that lead on to the goal."""
        item = given.object
        families = self.families[receiver, item]
        pool = self._pools.get((receiver, item), [])
        other = _palms(inverse(given.X_PO))
        out = []
        for _ in range(n):
            if pool and self.rng.random() < 0.8:
                drawn = [pool[int(k)] for k in self.rng.integers(len(pool), size=_GRASP_DRAWS)]
            else:
                drawn = [
                    self._draw_grasp(receiver, item, int(f)) for f in self.rng.integers(len(families), size=_GRASP_DRAWS)
                ]
            apart = np.linalg.norm(_palms(inverse(np.array([g.X_PO for g in drawn]))) - other, axis=1)
            out.append(drawn[int(np.argmax(np.minimum(apart, _ROOM)))])
        return out

    def _room(self, item: str, robot: str, grasps: Sequence[Attachment]) -> np.ndarray:
        """Largest distance (m) from the palm of each grasp to that of another robot's grasp that leads on; at most _ROOM."""
        others = [g for (name, o), pool in self._pools.items() if o == item and name != robot for g in pool]
        palms = _palms(inverse(np.array([g.X_PO for g in others or grasps])))
        own = _palms(inverse(np.array([g.X_PO for g in grasps])))
        return np.minimum(np.linalg.norm(own[:, None] - palms, axis=2).max(axis=1), _ROOM)

    def _grow_pool(self, mode: Mode, robot: str, item: str, n: int = 32) -> None:
        """Draw grasps with which `robot` can put the object down at its goal, however it comes by it."""
        pool = self._pools.setdefault((robot, item), [])
        families = self.families[robot, item]
        if len(pool) >= _POOL or not families or not self.goal_supports[item]:
            return
        drawn = self.rng.integers(len(families), size=n)
        grasps = [self._draw_grasp(robot, item, int(f)) for f in drawn]
        world = self.roadmaps[robot].world
        reward = self._look_ahead(mode, robot, item, grasps, np.tile(world.home, (n, 1)))
        pool += [g for g, r in zip(grasps, reward, strict=True) if np.isfinite(r)]

    def _draw_grasp(self, robot: str, item: str, f: int) -> Attachment:
        family = self.families[robot, item][f]
        return self._grasp(robot, item, family, f, self.rng.uniform(family.lower, family.upper))

    def _contact(
        self,
        robot: str,
        placement: Attachment,
        chain: tuple[Attachment, ...],
        grasp: Attachment,
        q: np.ndarray,
        stats: Outcome,
        mode: Mode | None = None,
    ) -> int | None:
        """Check a contact configuration alone and put it, with its approach and lift chains, on the roadmap."""
        roadmap = self.roadmaps[robot]
        world = roadmap.world
        item = grasp.object
        slot = world.slot_of[item]
        below = {a.object: self.validity.world_pose(chain[k:]) for k, a in enumerate(chain) if k > 0}
        around = dict(below)
        if mode is not None:
            # What stands at the place now is a reason not to put the object there now; the counts tell the guidance who.
            around.update({r.name: r.X_WO for r in self.validity.resting(mode) if r.name != item})
        holding = world.rows(q[None], grasp, around)
        if world.first_hit(holding, placement.parent, slot) >= 0:
            self._blame(stats, world.culprits(holding[0], placement.parent, slot), {robot, slot})
            return None
        open_hand = world.rows(q[None], None, {**below, item: self.validity.world_pose(chain)})
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
        v = roadmap.add_vertex(q, connect=False)
        roadmap.contact[roadmap.edge(v, v)] = (item, placement.parent)
        exits = self._attach(roadmap, v, approach, (item, placement.parent) if same else None)
        if not same:
            exits += self._attach(roadmap, v, lift, (item, placement.parent))
        roadmap.exits[v] = exits
        return v

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
        targets = np.tile(X_WG, (len(distances), 1, 1))
        targets[:, :3, 3] += np.outer(distances, direction)
        found, solved = self._ik(robot, targets, np.tile(q, (len(distances), 1)))
        out: list[np.ndarray] = []
        last = q
        for x, ok in zip(found, solved, strict=True):
            if not ok or np.abs(x - last).max() > _CHAIN_JUMP:
                break
            out.append(x)
            last = x
        return out

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

    def _exchange(
        self,
        mode: Mode,
        giver: str,
        receiver: str,
        given: Attachment,
        taken: Attachment,
        qa: np.ndarray,
        qb: np.ndarray,
        stats: Outcome,
    ) -> dict[str, int] | None:
        """Check a handover configuration before and after, and put both contact vertices on their roadmaps."""
        worlds = [self.roadmaps[r].world for r in (giver, receiver)]
        for world, q, grasp in ((worlds[0], qa, given), (worlds[1], qb, taken)):
            for held in (grasp, None):
                rows = world.rows(q[None], held, {})
                if world.first_hit(rows) >= 0:
                    self._blame(stats, world.culprits(rows[0]), {world.name, *world.slot_of.values()})
                    return None
        pair, swapped = self.collision.pair(giver, receiver)
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
            hit = pair.first_hit(b, hb, a, ha, w[::-1]) if swapped else pair.first_hit(a, ha, b, hb, w)
            return hit < 0

        if not all(apart(qa[None], ha, qb[None], hb, widths) for ha, hb, widths in stages):
            stats.collisions["each other"] += 1
            return None
        chains = []
        for robot, q, world in ((giver, qa, worlds[0]), (receiver, qb, worlds[1])):
            X_WG = world.tool.matrix(q[None])[0]
            chain = self._chain(robot, q, X_WG, -X_WG[:3, 2], APPROACH[:2])
            if not chain:
                stats.collisions["no approach"] += 1
                return None
            chains.append((robot, q, chain))
        # The receiver comes in while the giver holds, the giver leaves while the receiver holds.
        leave = np.linspace(qa, chains[0][2][0], _EXCHANGE_SAMPLES)
        enter = np.linspace(qb, chains[1][2][0], _EXCHANGE_SAMPLES)
        stay_a, stay_b = np.tile(qa, (_EXCHANGE_SAMPLES, 1)), np.tile(qb, (_EXCHANGE_SAMPLES, 1))
        if not (apart(stay_a, given, enter, None) and apart(leave, None, stay_b, taken)):
            stats.collisions["no approach"] += 1
            return None
        at: dict[str, int] = {}
        for robot, q, chain in chains:
            roadmap = self.roadmaps[robot]
            v = roadmap.add_vertex(q, connect=False)
            roadmap.exits[v] = self._attach(roadmap, v, chain, None)
            at[robot] = v
        return at


def _goal_supports(problem: Problem, item: str) -> list[Support]:
    out: list[Support] = []
    for condition in problem.goal:
        if isinstance(condition, InRegion) and condition.object == item:
            out.append(problem.support(condition.region))
        elif isinstance(condition, AtPose) and condition.object == item:
            out += [
                s
                for s in problem.supports
                if s.body == condition.on and _serves(s, condition, item)
            ]
    return out


def _serves(support: Support, goal: AtPose, item: str) -> bool:
    """Whether putting `item` on `support` achieves the pose goal."""
    if support.objects is not None and item not in support.objects:
        return False
    if goal.X_BO is None:
        return True
    return support.X_BO is not None and support.X_BO.IsNearlyEqualTo(goal.X_BO, 1e-6)


def _random_rotations(rng: np.random.Generator, n: int, scale: float | None = None) -> np.ndarray:
    """Uniform rotations (n, 3, 3); with `scale`, small ones of about that angle (rad)."""
    q = rng.normal(size=(n, 4))
    if scale is not None:
        q = np.column_stack([np.ones(n), rng.normal(scale=scale / 2, size=(n, 3))])
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    w, x, y, z = q.T
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], axis=1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], axis=1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1),
        ],
        axis=1,
    )


def _palms(X_OG: np.ndarray) -> np.ndarray:
    """Where the bulk of the hand is (..., 3) for grasps (..., 4, 4)."""
    return X_OG[..., :3, 3] - _PALM * X_OG[..., :3, 2]


def _rotations_to(directions: np.ndarray) -> np.ndarray:
    """Rotations (n, 3, 3) whose third columns are along `directions` (n, 3)."""
    norm = np.linalg.norm(directions, axis=1, keepdims=True)
    z = np.where(norm > 1e-9, directions / np.maximum(norm, 1e-9), _UP)
    helper = np.where(np.abs(z[:, 2:]) < 0.9, _UP, [1.0, 0.0, 0.0])
    x = np.cross(helper, z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=2)


def _rotations_about(z: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Rotations (n, 3, 3) whose third column is the unit vector `z`, turned about it by `angles`."""
    R = _rotations_to(z[None])[0]
    c, s = np.cos(angles)[:, None], np.sin(angles)[:, None]
    return np.stack([c * R[:, 0] + s * R[:, 1], c * R[:, 1] - s * R[:, 0], np.tile(z, (len(angles), 1))], axis=2)
