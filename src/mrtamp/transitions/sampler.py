"""Conditional stratified transition sampling (paper, section IV-A): strata -> candidates standing on roadmap vertices.

A pick and a place with the same object, grasp and placement share one configuration, so both are labels on the same
*contact vertex*, reached through a chain of approach vertices.  A handover is a pair of contact vertices.  Samples
are kept: every candidate ever accepted stays available to the search, and new ones are added for ever.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from mrtamp.collision import Collision
from mrtamp.kinematics import inverse
from mrtamp.modes import Attachment, Mode
from mrtamp.problem import Problem
from mrtamp.roadmap import Roadmap
from mrtamp.transitions.candidate import Candidate, Outcome, SolvedHandover
from mrtamp.transitions.contacts import ContactBuilder
from mrtamp.transitions.estimates import Estimates
from mrtamp.transitions.families import FixedFamily, placement_families
from mrtamp.transitions.meetings import Meetings
from mrtamp.transitions.reach import ReachSampler
from mrtamp.transitions.stratum import Stratum
from mrtamp.transitions.workspace import Workspace
from mrtamp.validity import Validity

_SEEDS = 3
"""IK seeds per meeting place of a handover."""
_ROUNDS = 3
_ENOUGH = 8
"""Grasps that fit around the object which are enough to choose from; fewer call for another round of samples."""
_OUTSIDE = 0.02
_DRAWN, _PLACED = 0.1, 4.0
"""Weights as attempts in vain: of a sample of a pick, and of all samples of a place in one call."""
_NOT_MET, _EXCHANGED = 0.05, 0.5
"""The same of handovers: of one that IK did not solve, and of one that collided."""
_ROOMY = 0.85
"""Share of the largest room seen for a second hand that a promising grasp leaves."""
_NO_WAY_ON = 50.0
"""Ranks samples from which no way to the goal was seen behind those with one (rad)."""


class TransitionSampler(Workspace):
    """Samples strata, checks single-robot validity, and turns what is feasible into candidates on the roadmaps."""

    def __init__(
        self,
        problem: Problem,
        collision: Collision,
        roadmaps: Mapping[str, Roadmap],
        validity: Validity,
        rng: np.random.Generator,
    ) -> None:
        super().__init__(problem, collision, roadmaps, validity, rng)
        self.contacts = ContactBuilder(self)
        self.estimates = Estimates(self)
        self.meetings = Meetings(self, self.estimates)
        self.reaching = ReachSampler(self)
        self._picks: dict[tuple[str, tuple[Attachment, ...]], list[Candidate]] = {}
        self._places: dict[tuple[str, Attachment], list[Candidate]] = {}
        self._handovers: dict[tuple[Attachment, str], list[Candidate]] = {}
        self._fixed: dict[tuple[str, str], Attachment] = {}
        self._roomiest: dict[tuple[str, str], float] = {}

    # -- strata ---------------------------------------------------------------------------------------------------

    def strata(self, mode: Mode, kind: str, robots: tuple[str, ...], item: str, place: str = "") -> list[Stratum]:
        """The elementary strata of one kind, pair of robot(s) and object in `mode`; one per family of choices."""
        tools = tuple(self.roadmaps[r].world.tool for r in robots)
        if kind == "pick":
            base = self.validity.world_pose(mode.chain(item))
            return [Stratum("pick", robots, item, tools, f, base, np.eye(4)) for f in self.families[robots[-1], item]]
        held = mode.of[item]
        if kind == "place":
            support = self.problem.support(place)
            base = self.body_pose(mode, support.body)
            families = placement_families(self.problem.object(item), support, self.problem.package_paths)
            return [Stratum("place", robots, item, tools, f, base, held.X_PO) for f in families]
        return [
            Stratum("handover", robots, item, tools, f, np.eye(4), np.eye(4), held.X_PO)
            for f in self.families[robots[-1], item]
        ]

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
            if (support is None or (c.after is not None and c.after.support == support))
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
        before, tries = dict(stats.collisions), stats.tries.copy()
        parts, grasps, families = [], [], []
        for _ in range(_ROUNDS):
            drawn = self.draw(robot, strata, n, stats)
            if drawn is None:
                break
            q, family, c = drawn
            for k in np.flatnonzero(self.contacts.open_hand_fits(mode, robot, item, q, stats)).tolist():
                f = int(family[k])
                stats.fits[strata[f].family.name] += 1
                parts.append(q[k])
                families.append(f)
                grasps.append(self.grasp(robot, item, self.families[robot, item][f], f, c[k]))
            if len(grasps) >= _ENOUGH:
                break
        tried = {k: stats.tries[s.family.name] - tries[s.family.name] for k, s in enumerate(strata)}
        self.holds.note_families(robot, item, placement.place, tried, _DRAWN)
        self.holds.note_picks(robot, item, placement.place, grasps)
        if not grasps:
            self._note_blockers(mode, stats, before, False)
            return []
        q = np.array(parts)
        reward = self.look_ahead(mode, robot, item, grasps, q)
        near = np.linalg.norm(q - self.roadmaps[robot].world.home, axis=1)
        promising = np.isfinite(reward) if self.goal_supports[item] else np.ones(len(reward), dtype=bool)
        if not promising.any():
            # Somebody else will have to take it over: a grasp that leaves room for a second hand is worth a detour.
            for other in self.roadmaps:
                if other != robot:
                    self.meetings.grow_pool(mode, other, item)
            room = self.meetings.room(item, robot, grasps)
            self._roomiest[robot, item] = max(self._roomiest.get((robot, item), 0.0), float(room.max()))
            promising = room >= _ROOMY * self._roomiest[robot, item]
            near = near - 30.0 * room
        order = self.mixed_order(near + np.where(np.isfinite(reward), reward, _NO_WAY_ON), families)
        out: list[Candidate] = []
        for i in order[: 4 * keep]:
            v = self.contacts.contact(robot, placement, chain, grasps[i], q[i], stats, mode)
            if v is not None:
                candidate, _ = self.register(robot, v, placement, grasps[i], chain[1:], bool(promising[i]))
                out.append(candidate)
                stats.accepted += 1
                if len(out) == keep:
                    break
        self._note_blockers(mode, stats, before, bool(out))
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
        before = dict(stats.collisions)
        at_goal = any(s.name == support for s in self.goal_supports[item])
        drawn = self.draw(robot, strata, n, stats)
        if drawn is None:
            if at_goal:
                self.holds.note_place(grasp, False, _PLACED)
            return []
        q, family, c = drawn
        base = mode.chain(body) if on_object else ()
        order = self.mixed_order(np.linalg.norm(q - self.roadmaps[robot].world.home, axis=1))
        out: list[Candidate] = []
        for i in order[: 4 * keep]:
            fixed = isinstance(strata[family[i]].family, FixedFamily)
            X_BO = strata[family[i]].family.pose(c[i][None])[0]
            placement = self.placement(item, body, support, X_BO, fixed)
            v = self.contacts.contact(robot, placement, (placement, *base), grasp, q[i], stats, mode)
            if v is not None:
                _, candidate = self.register(robot, v, placement, grasp, base)
                out.append(candidate)
                stats.accepted += 1
                if len(out) == keep:
                    break
        self._note_blockers(mode, stats, before, bool(out))
        if at_goal:
            self.holds.note_place(grasp, bool(out), _PLACED)
        return out

    def sample_handover(
        self, mode: Mode, giver: str, receiver: str, n: int = 72, keep: int = 3, *, directly: bool = False
    ) -> list[Candidate]:
        """Sample handovers of what `giver` holds to `receiver`; returns the new candidates, up to `keep`.

        `directly` is as for `solve_handovers`.
        """
        return self._exchange(self.solve_handovers(mode, giver, receiver, n, directly=directly), keep)

    def solve_handovers(
        self, mode: Mode, giver: str, receiver: str, n: int, *, directly: bool = False
    ) -> list[SolvedHandover]:
        """Up to n handovers of what `giver` holds to `receiver` that IK has solved, those to look at first in front.

        Neither robot is known to be clear of the other.

        `directly`: mostly those from which the receiver can put the object down at its goal, however hard they are to
        find; else those from which it has to be handed on as well, where that seems the shorter way by now.
        """
        grasp = mode.held[giver]
        item = grasp.object
        stats = self.outcome(("handover", (giver, receiver), item, giver))
        stats.calls += 1
        if not self.strata(mode, "handover", (giver, receiver), item):
            return []
        self.meetings.grow_pool(mode, receiver, item)
        qa, grasps = self.meetings.propose(giver, receiver, grasp, n, directly=directly)
        if not len(qa):
            return []
        X_WG = self._received(giver, grasp, qa, grasps)
        # Most meeting places are near the edge of both arms' reach: several seeds each.
        X_WG = np.repeat(X_WG, _SEEDS, axis=0)
        found, each = (x.reshape(len(qa), _SEEDS, -1) for x in self.ik(receiver, X_WG, self.seeds(receiver, X_WG, 0.6)))
        solved = np.asarray(each[:, :, 0].any(axis=1))
        stats.samples += len(qa)
        stats.ik_solved += int(solved.sum())
        for i in np.flatnonzero(~solved).tolist():
            self.holds.note_exchange(grasp, grasps[i], False, _NOT_MET)
        rows = np.flatnonzero(solved)
        qa, qb, into = qa[rows], found[rows, np.argmax(each[rows, :, 0], axis=1)], [grasps[i] for i in rows.tolist()]
        reward = self.look_ahead(mode, receiver, item, into, qb)
        homes = [self.roadmaps[r].world.home for r in (giver, receiver)]
        near = np.linalg.norm(qa - homes[0], axis=1) + np.linalg.norm(qb - homes[1], axis=1)
        promising = np.isfinite(reward)
        order = self.mixed_order(near + np.where(promising, reward, _NO_WAY_ON))
        # Of those that are not on the shortest way to the goal, as far as that is known, a few are enough.
        leads = self.meetings.leads_on(grasp, into, promising, directly=directly)
        order = np.concatenate([order[leads[order]], order[~leads[order]][:2]])
        return [
            SolvedHandover(grasp, into[k], {giver: qa[k], receiver: qb[k]}, bool(promising[k]), bool(leads[k]))
            for k in order.tolist()
        ]

    def meet(self, handover: SolvedHandover) -> Candidate | None:
        """A solved handover as a candidate; None where it collides."""
        at = self.contacts.exchange(handover, self.outcome(handover.stratum))
        if at is None:
            return None
        given, taken = handover.given, handover.taken
        robots = (given.parent, taken.parent)
        candidate = Candidate("handover", robots, at, given, taken, promising=handover.promising)
        self._handovers.setdefault((given, taken.parent), []).append(candidate)
        return candidate

    def _received(self, giver: str, grasp: Attachment, qa: np.ndarray, grasps: Sequence[Attachment]) -> np.ndarray:
        """Poses X_WG (N, 4, 4) of the receiver's hand for each of its grasps, with the giver at qa (N, n)."""
        X_WO = self.roadmaps[giver].world.tool.matrix(qa) @ grasp.X_PO
        return X_WO @ inverse(np.array([g.X_PO for g in grasps]))

    def _exchange(self, solved: Sequence[SolvedHandover], keep: int) -> list[Candidate]:
        """Candidates of those solved handovers that are free of collision, up to `keep`."""
        out: list[Candidate] = []
        leading = [h for h in solved if h.leads_on]
        looked_at = [*leading[: 4 * keep], *(h for h in solved if not h.leads_on)]
        for handover in self.contacts.with_retreats(looked_at):
            candidate = self.meet(handover)
            self.holds.note_exchange(handover.given, handover.taken, candidate is not None, _EXCHANGED)
            if candidate is not None:
                out.append(candidate)
                self.outcome(handover.stratum).accepted += 1
                if len(out) == keep:
                    break
        return out

    def _note_blockers(self, mode: Mode, stats: Outcome, before: Mapping[str, int], found: bool) -> None:
        """Remember which resting objects a call without result ran into."""
        if found:
            stats.blockers.clear()
            return
        names = [n for n, k in stats.collisions.items() if n in mode.of and k > before.get(n, 0)]
        stats.blockers = {mode.of[n] for n in names if not mode.of[n].held}

    def register(
        self,
        robot: str,
        v: int,
        placement: Attachment,
        grasp: Attachment,
        base: tuple[Attachment, ...],
        promising: bool = True,
    ) -> tuple[Candidate, Candidate]:
        """Keep the pick and the place that one contact vertex stands for."""
        pick = Candidate("pick", (robot,), {robot: v}, placement, grasp, base, promising)
        place = Candidate("place", (robot,), {robot: v}, grasp, placement, base)
        self._picks.setdefault((robot, (placement, *base)), []).append(pick)
        self._places.setdefault((robot, grasp), []).append(place)
        return pick, place

    # -- steps ----------------------------------------------------------------------------------------------------

    def draw(
        self, robot: str, strata: Sequence[Stratum], n: int, stats: Outcome
    ) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]] | None:
        """n samples over `strata` with constant base: solved configurations, stratum index, choices."""
        names = [s.family.name for s in strata]
        family = self.rng.choice(len(strata), size=n, p=stats.weights(names))
        stats.tries.update(names[f] for f in family)
        choices = [strata[f].draw_choices(self.rng, 1)[0] for f in family]
        targets = np.concatenate(
            [strata[f].targets(strata[f].base, c[None]) for f, c in zip(family, choices, strict=True)]
        )
        centre, radius = self.reach[robot]
        near = np.linalg.norm(targets[:, :3, 3] - centre, axis=1) <= radius
        # The ball was seen, not proved: a few targets outside are tried all the same.
        near |= self.rng.random(n) < _OUTSIDE
        stats.samples += n
        if not near.any():
            stats.collisions["out of reach"] += 1
            return None
        family, targets = family[near], targets[near]
        choices = [c for c, ok in zip(choices, near, strict=True) if ok]
        q, solved = self.ik(robot, targets, self.seeds(robot, targets))
        stats.ik_solved += int(solved.sum())
        if not solved.any():
            return None
        rows = np.flatnonzero(solved)
        return q[rows], family[rows], [choices[i] for i in rows]

    def mixed_order(self, score: np.ndarray, family: Sequence[int] | None = None) -> np.ndarray:
        """Mostly the lowest scores first, every third one drawn at random, so that no sample is excluded.

        With `family` (N,) the random ones come from every family as often, however few samples it has.
        """
        ranked = np.argsort(score, kind="stable")
        if family is None or not len(family):
            shuffled = self.rng.permutation(len(score))
        else:
            share = 1.0 / np.bincount(family)[np.asarray(family)]
            shuffled = self.rng.choice(len(score), size=len(score), replace=False, p=share / share.sum())
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

    def placement(self, item: str, body: str, support: str, X_BO: np.ndarray, fixed: bool) -> Attachment:
        """An attachment that rests on a support; the same one every time where the pose is exact (`fixed`)."""
        if not fixed:
            return Attachment(item, body, X_BO, support)
        key = (item, support)
        if key not in self._fixed:
            self._fixed[key] = Attachment(item, body, X_BO, support)
        return self._fixed[key]

    def remember(self, mode: Mode) -> None:
        """Make the exact placements of the start mode the ones that later samples return to."""
        for a in mode.attachments:
            if a.support is not None and self._is_exact(a.support):
                self._fixed[a.object, a.support] = a

    def _is_exact(self, support: str) -> bool:
        return any(s.name == support and s.X_BO is not None for s in self.problem.supports)
