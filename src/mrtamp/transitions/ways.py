"""Dense sets of whole ways to bring an object where it belongs: pick and place together, with a handover if need be.

A transition is cheap or dear only together with the ones before and after it.  A *way* is a chain of transition
configurations with one grasp per robot, solved in batches by IK and checked at the stops alone; guidance that knows
costs chooses among many of them, and only the chosen ones become roadmap vertices.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from mrtamp.kinematics import inverse
from mrtamp.modes import Attachment, Mode
from mrtamp.problem import Support
from mrtamp.transitions.candidate import Candidate, SolvedHandover
from mrtamp.transitions.families import FixedFamily, PlacementFamily, placement_families
from mrtamp.transitions.sampler import TransitionSampler

_PLACES = 3
"""Places drawn per grasp."""
_AFTER = 24
"""Places drawn after a handover: those are dear, so each is followed up."""
_CHECKED = 0.6
"""Share of the solved ways, shortest first for the most part, that are checked for collisions."""
BLOCKED = 1.5
"""Added to the estimated cost of a way (rad) per resting object that stands in its way where things are now."""
_ALIKE = 0.02
"""Largest difference of a joint (rad) between ways that are held to be alike."""


@dataclass(eq=False)
class Stop:
    """One transition of a way: where its robots stand.

    `candidate` is set once it is on the roadmaps.  To reach a subgoal is a stop at the vertices `at`; what it changes
    depends on the mode it happens in.
    """

    kind: str
    robots: tuple[str, ...]
    before: Attachment | None
    after: Attachment | None
    q: Mapping[str, np.ndarray]
    candidate: Candidate | None = None
    subgoal: str | None = None
    at: Mapping[str, int] | None = None


@dataclass(eq=False)
class Way:
    """A chain of stops.  `penalty` is what experience adds to its estimated cost (rad).

    `shortened` : whether it has been made shorter, or was found to be no longer than it has to be.
    """

    stops: tuple[Stop, ...]
    penalty: float = 0.0
    failures: int = field(default=0)
    shortened: bool = False

    @property
    def robots(self) -> tuple[str, ...]:
        """Who takes part, in the order in which they do."""
        return tuple(dict.fromkeys(r for stop in self.stops for r in stop.robots))

    def flat(self) -> np.ndarray:
        """The configurations of all its stops, one after the other."""
        return np.concatenate([stop.q[r] for stop in self.stops for r in stop.robots])


Slid = tuple[Sequence[Mapping[str, np.ndarray]], Sequence[Attachment]]
"""What a way has become: for every stop the configurations of its robots, and what is attached after it."""


class _Place(NamedTuple):
    """A family of goal poses on a support, what that rests on, and the pose of its body."""

    support: Support
    chain: tuple[Attachment, ...]
    family: PlacementFamily
    X_WB: np.ndarray
    planned: Attachment | None = None


def stop_of(candidate: Candidate, sampler: TransitionSampler) -> Stop:
    """A candidate that stands on the roadmaps already, as a stop."""
    q = {r: sampler.roadmaps[r].q[v].copy() for r, v in candidate.at.items()}
    return Stop(candidate.kind, candidate.robots, candidate.before, candidate.after, q, candidate)


class Ways:
    """Grows the sets of ways of every object, per robots involved.

    Attributes
    ----------
    of : (object, robots) -> ways; one robot carries, of two the first hands over to the second.
    """

    def __init__(self, sampler: TransitionSampler) -> None:
        self.sampler = sampler
        self.rng = sampler.rng
        self.of: dict[tuple[str, tuple[str, ...]], list[Way]] = {}
        self.tries: dict[tuple[str, tuple[str, ...]], int] = {}
        self.planned: dict[str, Attachment] = {}

    # -- where things will be -------------------------------------------------------------------------------------

    def settle(
        self, mode: Mode, item: str, chains: Mapping[str, tuple[Attachment, ...]]
    ) -> tuple[Attachment, ...] | None:
        """The chain by which an object is planned to rest at its goal, for what will be put on it; None: not planned.

        `chains` holds those of the objects below it.
        """
        planned = self.planned.get(item)
        if planned is None:
            return None
        return (planned, *(chains.get(planned.parent, mode.chain(planned.parent)) if planned.parent in mode.of else ()))

    def plan_placement(self, item: str) -> bool:
        """Fix where an object that others will rest on is to stand, as its shortest way so far puts it; True if new.

        Ways that put it elsewhere are dropped: the others are solved for this very placement.
        """
        ways = [w for (name, _), known in self.of.items() if name == item for w in known]
        if item in self.planned or not ways:
            return False
        planned = min(ways, key=self.length).stops[-1].after
        assert planned is not None
        self.planned[item] = planned
        for key, known in self.of.items():
            if key[0] == item:
                self.of[key] = [w for w in known if w.stops[-1].after is planned]
        return True

    def length(self, way: Way) -> float:
        """What the robots of a way travel from home and back (rad), and its penalty."""
        length, last = way.penalty, {r: self._home(r) for s in way.stops for r in s.robots}
        for stop in way.stops:
            for r, q in stop.q.items():
                length += float(np.linalg.norm(q - last[r]))
                last[r] = q
        return length + sum(float(np.linalg.norm(q - self._home(r))) for r, q in last.items())

    def _home(self, robot: str) -> np.ndarray:
        return self.sampler.roadmaps[robot].q[0]

    # -- growing --------------------------------------------------------------------------------------------------

    def carry(
        self, mode: Mode, robot: str, item: str, chains: Mapping[str, tuple[Attachment, ...]], n: int, keep: int
    ) -> list[Way]:
        """New ways in which one robot picks a resting object up and puts it down at its goal.

        `chains` maps objects that serve as supports to how they will rest then.
        """
        sampler = self.sampler
        key = (item, (robot,))
        self.tries[key] = self.tries.get(key, 0) + 1
        places = self._goal_places(mode, item, chains)
        strata = sampler.strata(mode, "pick", (robot,), item)
        if not strata or not places or not self._near(robot, places):
            return []
        placement = mode.of[item]
        stats = sampler.outcome(("pick", (robot,), item, placement.place))
        drawn = sampler.draw(robot, strata, n, stats)
        if drawn is None:
            return []
        q, family, c = drawn
        grasps = [
            sampler.grasp(robot, item, sampler.families[robot, item][f], int(f), x)
            for f, x in zip(family.tolist(), c, strict=True)
        ]
        fits = self._picks_free(mode, robot, grasps, q)
        rows = np.flatnonzero(np.isfinite(fits))
        if not len(rows):
            return []
        rows = np.repeat(rows, _PLACES)
        q2, which, poses, solved = self._places(robot, [grasps[i] for i in rows], q[rows], places)
        home = self._home(robot)
        length = np.linalg.norm(q[rows] - home, axis=1) + np.linalg.norm(q2 - home, axis=1)
        length += np.linalg.norm(q2 - q[rows], axis=1)
        order = np.flatnonzero(solved)
        order = order[sampler.mixed_order(length[order])][: max(keep, int(_CHECKED * len(order)))]
        out: list[Way] = []
        for k in order.tolist():
            grasp = grasps[rows[k]]
            after = self._attachment(item, places[which[k]], poses[k])
            penalty = self._place_free(mode, robot, grasp, after, places[which[k]].chain, q2[k])
            if not np.isfinite(penalty):
                continue
            pick = Stop("pick", (robot,), placement, grasp, {robot: q[rows[k]]})
            place = Stop("place", (robot,), grasp, after, {robot: q2[k]})
            out.append(Way((pick, place), BLOCKED * (fits[rows[k]] + penalty)))
            if len(out) == keep:
                break
        self._keep(key, out)
        return out

    def hand_over(
        self,
        mode: Mode,
        giver: str,
        receiver: str,
        item: str,
        chains: Mapping[str, tuple[Attachment, ...]],
        n: int,
        keep: int,
    ) -> list[Way]:
        """New ways in which one robot picks an object up and another takes it over and puts it down at its goal."""
        sampler = self.sampler
        key = (item, (giver, receiver))
        self.tries[key] = self.tries.get(key, 0) + 1
        start = sampler.validity.world_pose(mode.chain(item))[:3, 3]
        places = self._goal_places(mode, item, chains)
        if not places or not self._near(receiver, places) or not sampler.in_reach(giver, start):
            return []
        picks = sampler.picks(mode, giver, item) if self.tries[key] == 1 else []
        picks = picks or sampler.sample_pick(mode, giver, item, n) or sampler.picks(mode, giver, item)
        picks = [p for p in picks if p.promising] or picks
        out: list[Way] = []
        for pick in [picks[int(i)] for i in self.rng.permutation(len(picks))[:2]]:
            held = mode.replace(*([pick.after] if pick.after else []))
            handovers = sampler.sample_handover(held, giver, receiver, n, directly=True)
            out += self._followed_up(mode, stop_of(pick, sampler), handovers, places)
            if len(out) >= keep:
                break
        self._keep(key, out)
        return out

    def _followed_up(self, mode: Mode, pick: Stop, handovers: list[Candidate], places: list[_Place]) -> list[Way]:
        """Ways from a pick through each of the handovers to up to two places."""
        sampler = self.sampler
        out: list[Way] = []
        if not handovers:
            return out
        receiver = handovers[0].robots[-1]
        into = [h.after for h in handovers if h.after is not None]
        stands = np.array([sampler.roadmaps[receiver].q[h.at[receiver]] for h in handovers])
        grasps = [taken for taken in into for _ in range(_AFTER)]
        q2, which, poses, solved = self._places(receiver, grasps, np.repeat(stands, _AFTER, axis=0), places)
        length = np.where(solved, np.linalg.norm(q2 - np.repeat(stands, _AFTER, axis=0), axis=1), np.inf)
        for i, (handover, taken) in enumerate(zip(handovers, into, strict=True)):
            mine = np.arange(i * _AFTER, (i + 1) * _AFTER)
            mine = mine[solved[mine]]
            found = 0
            for k in mine[np.argsort(length[mine])].tolist():
                after = self._attachment(taken.object, places[which[k]], poses[k])
                penalty = self._place_free(mode, receiver, taken, after, places[which[k]].chain, q2[k])
                if not np.isfinite(penalty):
                    continue
                place = Stop("place", (receiver,), taken, after, {receiver: q2[k]})
                out.append(Way((pick, stop_of(handover, sampler), place), BLOCKED * penalty))
                found += 1
                if found == 2:
                    break
        return out

    def admit(
        self,
        mode: Mode,
        key: tuple[str, tuple[str, ...]],
        ways: Sequence[Way],
        stages: Sequence[Sequence[Slid]],
        chains: Mapping[str, tuple[Attachment, ...]],
        most: int,
    ) -> None:
        """Add up to `most` ways to a set that were made from others by sliding their stops along their strata.

        Of each of the `ways`, the most welcome first, `stages` are what it has become, the best first; the first one
        free of collision is kept.  Those like another one that was shortened are left out.
        """
        known = self.of.setdefault(key, [])
        shortened = [_flat([s.q for s in w.stops]) for w in known if w.shortened]
        enough = len(shortened) + most
        handovers = [self._handovers(way, found[0]) for way, found in zip(ways, stages, strict=True)]
        for way, found, first in zip(ways, stages, self._with_retreats(handovers), strict=True):
            flat = _flat(found[0][0])
            if any(np.abs(flat - other).max() < _ALIKE for other in shortened):
                continue
            slid = (self._slid(mode, way, stage, chains, first if stage is found[0] else None) for stage in found)
            free = next((s for s in slid if s is not None), None)
            if free is not None:
                known.append(free)
                shortened.append(_flat([s.q for s in free.stops]))
                if len(shortened) == enough:
                    return

    def _handovers(self, way: Way, stage: Slid) -> dict[int, SolvedHandover]:
        """The handovers of a way, by the numbers of its stops, once its stops have slid."""
        q, after = stage
        return {
            k: SolvedHandover(after[k - 1], after[k], q[k]) for k, s in enumerate(way.stops) if s.kind == "handover"
        }

    def _with_retreats(self, handovers: Sequence[dict[int, SolvedHandover]]) -> list[dict[int, SolvedHandover]]:
        """The handovers of ways with the same kinds of stops, each number's retreats in one batch."""
        found = {k: self.sampler.contacts.with_retreats([h[k] for h in handovers]) for k in (handovers or [{}])[0]}
        return [{k: found[k][i] for k in found} for i in range(len(handovers))]

    def _slid(
        self,
        mode: Mode,
        way: Way,
        stage: Slid,
        chains: Mapping[str, tuple[Attachment, ...]],
        handovers: dict[int, SolvedHandover] | None,
    ) -> Way | None:
        """A way as it has become, its handovers as far as they are known; None where it collides."""
        q, after = stage
        first, last = way.stops[0].robots[0], way.stops[-1].robots[-1]
        placement, grasp = after[-1], after[-2]
        base = chains.get(placement.parent, ())
        penalty = self._picks_free(mode, first, [after[0]], q[0][first][None])[0]
        penalty += self._place_free(mode, last, grasp, placement, base, q[-1][last])
        if not np.isfinite(penalty):
            return None
        handovers = self._handovers(way, stage) if handovers is None else handovers
        candidates = {k: self.sampler.meet(h) for k, h in handovers.items()}
        if None in candidates.values():
            return None
        before = [way.stops[0].before, *after[:-1]]
        stops = (Stop(s.kind, s.robots, before[k], after[k], q[k], candidates.get(k)) for k, s in enumerate(way.stops))
        return Way(tuple(stops), BLOCKED * penalty, shortened=True)

    def _keep(self, key: tuple[str, tuple[str, ...]], ways: list[Way], most: int = 160) -> None:
        """Add ways to a set; the longest go when it grows too large, a random part of it is spared."""
        known = self.of.setdefault(key, [])
        known += ways
        if len(known) > most:
            order = np.argsort([self.length(w) for w in known], kind="stable")
            lucky = self.rng.choice(order[most // 2 :], size=most // 4, replace=False)
            chosen = {*order[: most // 2].tolist(), *lucky.tolist()}
            self.of[key] = [w for i, w in enumerate(known) if i in chosen]

    # -- places ---------------------------------------------------------------------------------------------------

    def _goal_places(self, mode: Mode, item: str, chains: Mapping[str, tuple[Attachment, ...]]) -> list[_Place]:
        """Every way to rest at the goal; on an object only if `chains` says how that will rest."""
        sampler = self.sampler
        out = []
        for support in sampler.goal_supports[item]:
            chain: tuple[Attachment, ...] = ()
            if support.body in mode.of:
                if support.body not in chains:
                    continue
                chain = chains[support.body]
            X_WB = sampler.validity.world_pose(chain) if chain else sampler.validity.X_WB[support.body]
            planned = self.planned.get(item)
            if planned is not None and planned.support == support.name:
                # Others count on this very placement.
                out.append(_Place(support, chain, FixedFamily(support.name, planned.X_PO), X_WB, planned))
                continue
            families = placement_families(sampler.problem.object(item), support, sampler.problem.package_paths)
            out += [_Place(support, chain, f, X_WB) for f in families]
        return out

    def _attachment(self, item: str, place: _Place, X_BO: np.ndarray) -> Attachment:
        if place.planned is not None:
            return place.planned
        fixed = isinstance(place.family, FixedFamily)
        return self.sampler.placement(item, place.support.body, place.support.name, X_BO, fixed)

    def _near(self, robot: str, places: list[_Place]) -> bool:
        """Whether any place lies inside the ball that the robot was seen to reach, its region's size allowed for."""
        centre, radius = self.sampler.reach[robot]
        for support, _, family, X_WB, _ in places:
            p = (X_WB @ family.pose((family.lower + family.upper)[None] / 2)[0])[:3, 3]
            slack = 0.0 if isinstance(family, FixedFamily) else float(np.hypot(*support.size)) / 2
            if np.linalg.norm(p - centre) <= radius + slack:
                return True
        return False

    def _places(
        self, robot: str, grasps: list[Attachment], q: np.ndarray, places: list[_Place]
    ) -> tuple[np.ndarray, list[int], np.ndarray, np.ndarray]:
        """Configurations (N, n) that put what is grasped at one of the places each, which place, X_BO, and solved."""
        sampler = self.sampler
        n = len(grasps)
        which = self.rng.integers(len(places), size=n).tolist()
        X_BO = np.empty((n, 4, 4))
        X_WO = np.empty((n, 4, 4))
        for i, k in enumerate(which):
            family, X_WB = places[k].family, places[k].X_WB
            X_BO[i] = family.pose(self.rng.uniform(family.lower, family.upper)[None])[0]
            X_WO[i] = X_WB @ X_BO[i]
        X_WG = X_WO @ inverse(np.array([g.X_PO for g in grasps]))
        q2, solved = sampler.ik(robot, X_WG, sampler.seeds_from(robot, X_WG, q, 0.2))
        return q2, which, X_BO, solved

    # -- collisions at the stops ----------------------------------------------------------------------------------

    def _picks_free(self, mode: Mode, robot: str, grasps: list[Attachment], q: np.ndarray) -> np.ndarray:
        """Number of resting objects in the way of each pick (N,); infinite where the world itself is."""
        validity = self.sampler.validity
        chain = mode.chain(grasps[0].object)
        below = {a.object: validity.world_pose(chain[k:]) for k, a in enumerate(chain)}
        others = {r.name: r.X_WO for r in validity.resting(mode) if r.name not in below}
        return np.array([self._open_hand(robot, x, below, others) for x in q])

    def _open_hand(
        self, robot: str, q: np.ndarray, fixed: Mapping[str, np.ndarray], others: Mapping[str, np.ndarray]
    ) -> float:
        world = self.sampler.roadmaps[robot].world
        if world.first_hit(world.rows(q[None], None, fixed)) >= 0:
            return np.inf
        rows = world.rows(q[None], None, {**fixed, **others})
        if not others or world.first_hit(rows) < 0:
            return 0.0
        return float(len({x for pair in world.culprits(rows[0]) for x in pair if x in others}))

    def _place_free(
        self,
        mode: Mode,
        robot: str,
        grasp: Attachment,
        after: Attachment,
        chain: tuple[Attachment, ...],
        q: np.ndarray,
    ) -> float:
        """Number of objects in the way of a place where they rest now; infinite where the world itself is."""
        validity = self.sampler.validity
        world = self.sampler.roadmaps[robot].world
        below = {a.object: validity.world_pose(chain[k:]) for k, a in enumerate(chain)}
        slot = world.slot_of[grasp.object]
        holding = world.rows(q[None], grasp, below)
        if world.first_hit(holding, after.parent, slot) >= 0:
            return np.inf
        X_WB = validity.world_pose(chain) if chain else validity.X_WB[after.parent]
        open_hand = world.rows(q[None], None, {**below, grasp.object: X_WB @ after.X_PO})
        if world.first_hit(open_hand) >= 0:
            return np.inf
        others = {r.name: r.X_WO for r in validity.resting(mode) if r.name not in below and r.name != grasp.object}
        # Those that still have to move may have done so by then.
        rows = world.rows(q[None], grasp, {**below, **others})
        if not others or world.first_hit(rows, after.parent, slot) < 0:
            return 0.0
        return float(len({x for pair in world.culprits(rows[0], after.parent, slot) for x in pair if x in others}))


def _flat(q: Sequence[Mapping[str, np.ndarray]]) -> np.ndarray:
    """All configurations of a way, one after the other."""
    return np.concatenate([x for stop in q for x in stop.values()])
