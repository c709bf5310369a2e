"""Realising a skeleton in space and time: one robot's motion after the other is inserted among those already timed.

Stops whose transitions stand on roadmap vertices go in; timed segments and transitions come out.  Every leg is the
shortest roadmap path of its robot past static and resting things; the timing, and if need be the other robots' stepping
aside, keeps robots apart.  Idle and finished robots may always move (DESIGN section 9).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mrtamp.collision import Collision
from mrtamp.modes import Mode
from mrtamp.plan import Segment, Transition
from mrtamp.roadmap import Roadmap
from mrtamp.roadmap_rows import RoadmapRows
from mrtamp.space_time import STEP, Leg, Move, SpaceTime
from mrtamp.steering import Steering
from mrtamp.transitions.candidate import Candidate
from mrtamp.validity import Validity

_DEPTH = 2
"""How many robots may have to move for one another in a chain."""
_AROUND = 12
"""Lazy searches for a way past standing robots."""
_ASIDE = 6
"""Random vertices offered to a robot that is in the way."""
_ORDERS = 6
"""Orders that are tried in which robots go to their goals in the end."""


@dataclass(frozen=True)
class _Effort:
    """How hard a next stop is tried.

    depth : how many robots may have to move for one another in a chain.
    around : whether to look for ways past robots that stand in the way, too.
    anywhere : whether these may go anywhere; most of the many such places are no better than those that they have a
        reason to go to.
    """

    depth: int
    around: bool = False
    anywhere: bool = False


_EFFORTS = (
    *(_Effort(depth) for depth in range(_DEPTH + 1)),
    _Effort(0, around=True),
    *(_Effort(depth, anywhere=True) for depth in range(1, _DEPTH + 1)),
)

Stand = Callable[[int, Mode], Candidate | None]
"""Number of a stop, mode -> its transition there; None while something is in its way."""


@dataclass(eq=False)
class _State:
    """A schedule so far, the roadmap vertex where each robot stands at its end, and the stops still to come."""

    time: SpaceTime
    at: dict[str, int]
    mode: Mode
    pending: tuple[int, ...]
    transitions: tuple[Transition, ...] = ()

    def copy(self) -> _State:
        return _State(self.time.copy(), dict(self.at), self.mode, self.pending, self.transitions)


class Insertion:
    """Builds timed plans for skeletons.

    Each robot's stops keep their order; among robots, the stop that can happen soonest happens next, or else the most
    urgent one, and only where none can, robots step aside for one another.  What attempts learn about moves is kept for
    later ones.

    Attributes
    ----------
    stuck : number of a stop that could not be reached when the last attempt failed; None if it did not.
    schedule : of the last attempt, if it succeeded.
    """

    def __init__(
        self,
        roadmaps: Mapping[str, Roadmap],
        collision: Collision,
        validity: Validity,
        steering: Steering,
        rng: np.random.Generator,
    ) -> None:
        self.roadmaps = roadmaps
        self.names = list(roadmaps)
        self.validity = validity
        self.steering = steering
        self.rng = rng
        self.stuck: int | None = None
        self.schedule: SpaceTime | None = None
        self._rows = RoadmapRows(roadmaps, collision, validity)
        # Of one attempt: the transitions at its stops as far as they were asked for, the ways between vertices that
        # need not keep clear of other robots, and its `variety`.
        self._known: dict[tuple[int, Mode], Candidate | None] = {}
        self._ways: dict[tuple[str, int, int, Mode], list[int]] = {}
        self._variety = 0.0
        self._effort = _EFFORTS[-1]

    def realise(
        self,
        root: Mode,
        start: Mapping[str, int],
        robots: Sequence[Sequence[str]],
        before: Sequence[Sequence[int]],
        stand: Stand,
        goal: Mapping[str, int],
        variety: float = 0.0,
        *,
        alone: bool = False,
        latest: Sequence[float] | None = None,
    ) -> tuple[list[Segment], list[Transition]] | None:
        """Motions that bring about the stops and end at the goal vertices, or None.

        Parameters
        ----------
        root : the mode in the beginning.
        start, goal : robot -> vertex; robots without a goal end anywhere.
        robots : who takes part in every stop, in an order of stops that is possible for every robot.
        before : numbers of the stops that have to happen earlier than each.
        stand : transitions at the stops.
        variety : how often (0 to 1) a stop that can happen next does so although another could happen sooner, and a
            leg takes another way than the shortest.
        alone : robots keep clear of all but each other: a draft, as cheap as the skeleton promises where it is free.
        latest : when each stop has to happen at the latest: the most urgent one that can happen next does, instead of
            the soonest.

        Raises
        ------
        TimeIsUp : the deadline of `steering` has passed.
        """
        self.stuck = self.schedule = None
        self._variety = variety
        self._known.clear()
        self._ways.clear()
        self._rows.forget_if_full()
        q = {r: self.roadmaps[r].q[v] for r, v in start.items()}
        time = SpaceTime(self._rows.clearances, q, [root], alone=alone)
        state = _State(time, dict(start), root, tuple(range(len(robots))))
        while state.pending:
            ready = self._ready(state, robots, before)
            targets = self._targets(state, robots, goal)
            if latest is None:
                after = self._soonest_next(state, ready, stand, targets)
            else:
                after = self._most_urgent_next(state, ready, stand, targets, latest)
            if after is None:
                self.stuck = ready[0] if ready else state.pending[0]
                return None
            state = after
        home = self._go_home(state, goal)
        if home is None:
            self.stuck = len(robots) - 1
            return None
        self.schedule = home.time
        return home.time.segments(), list(state.transitions)

    def _soonest_next(
        self, state: _State, ready: Sequence[int], stand: Stand, targets: Mapping[str, int]
    ) -> _State | None:
        """The schedule in which that of the stops happens next that can happen soonest; None: none can."""
        soonest = self._soonest(state, ready, stand)
        for self._effort in _EFFORTS:
            done: list[_State] = []
            for k in sorted(ready, key=lambda k: soonest[k]):
                if done and self._variety == 0.0 and min(x.time.events[-1] for x in done) <= soonest[k]:
                    break
                trial = self._happen(state, k, stand, targets, self._effort.depth)
                if trial is not None:
                    done.append(trial)
            if done and self.rng.random() < self._variety:
                return done[int(self.rng.integers(len(done)))]
            if done:
                return min(done, key=lambda x: x.time.events[-1])
        return None

    def _most_urgent_next(
        self, state: _State, ready: Sequence[int], stand: Stand, targets: Mapping[str, int], latest: Sequence[float]
    ) -> _State | None:
        """The schedule in which the most urgent of the stops happens next, others moved out of its way; None: none can.

        What others do so as not to be in the way comes before places that are only one of many.
        """
        for efforts in (_EFFORTS[: _DEPTH + 1], _EFFORTS[_DEPTH + 1 :]):
            for k in sorted(ready, key=lambda k: latest[k]):
                for self._effort in efforts:
                    done = self._happen(state, k, stand, targets, self._effort.depth)
                    if done is not None:
                        return done
        return None

    def edge_of(self, robot: str, move: Move) -> tuple[int, int] | None:
        """The roadmap edge (from, to) that a move of a robot is a part of, as long as it is remembered."""
        return self._rows.edge_of(robot, move.a, move.b)

    @staticmethod
    def _ready(state: _State, robots: Sequence[Sequence[str]], before: Sequence[Sequence[int]]) -> list[int]:
        """Stops that are next for all their robots and wait for nothing."""
        busy: set[str] = set()
        out = []
        for k in state.pending:
            if not busy & set(robots[k]) and not set(before[k]) & set(state.pending):
                out.append(k)
            busy |= set(robots[k])
        return out

    def _targets(self, state: _State, robots: Sequence[Sequence[str]], goal: Mapping[str, int]) -> dict[str, int]:
        """Where each robot goes next, as far as that stands on a roadmap already."""
        out = dict(goal)
        for k in reversed(state.pending):
            for r in robots[k]:
                candidate = self._known.get((k, state.mode))
                out.pop(r, None)
                if candidate is not None:
                    out[r] = candidate.at[r]
        return out

    def _soonest(self, state: _State, ready: Sequence[int], stand: Stand) -> dict[int, float]:
        """When each stop could happen at the earliest, were its robots alone."""
        out = {}
        for k in ready:
            candidate = self._stand(k, state.mode, stand)
            latest = float(max([0, *state.time.events[-1:]]))
            for r, v in candidate.at.items() if candidate is not None else ():
                q = self.roadmaps[r].q
                way = np.linalg.norm(q[v] - q[state.at[r]]) / STEP
                latest = max(latest, state.time.free_from[r] + float(np.ceil(way - 1e-9)))
            out[k] = latest if candidate is not None else np.inf
        return out

    def _stand(self, k: int, mode: Mode, stand: Stand) -> Candidate | None:
        if (k, mode) not in self._known:
            self._known[k, mode] = stand(k, mode)
        return self._known[k, mode]

    def _happen(self, state: _State, k: int, stand: Stand, targets: Mapping[str, int], depth: int) -> _State | None:
        """The schedule in which stop k happens next, or None."""
        candidate = self._stand(k, state.mode, stand)
        if candidate is None:
            return None
        trial: _State | None = state
        for robot, v in candidate.at.items():
            partners = frozenset(r for r, w in candidate.at.items() if r != robot and trial and trial.at[r] == w)
            trial = self._bring(trial, robot, v, targets, depth, partners) if trial is not None else None
        if trial is None or any(trial.at[r] != v for r, v in candidate.at.items()):
            return None
        transition = Transition((candidate.action,))
        trial = trial.copy()
        trial.mode = state.mode.after(transition)
        trial.time.modes.append(trial.mode)
        if not all(self.validity.edge(r, self.roadmaps[r].edge(v, v), trial.mode) for r, v in candidate.at.items()):
            return None
        if not trial.time.happen(transition.active):
            return self._after_others_left(state, k, stand, targets, depth)
        trial.pending = tuple(x for x in state.pending if x != k)
        trial.transitions = (*state.transitions, transition)
        return trial

    def _after_others_left(
        self, state: _State, k: int, stand: Stand, targets: Mapping[str, int], depth: int
    ) -> _State | None:
        """The schedule in which stop k happens once a robot has gone from where an object will rest, or None."""
        candidate = self._stand(k, state.mode, stand)
        if depth == 0 or candidate is None:
            return None
        mode = state.mode.after(Transition((candidate.action,)))
        for other in self.names:
            v = state.at[other]
            if other in candidate.at or self.validity.edge(other, self.roadmaps[other].edge(v, v), mode):
                continue
            for moved in self._asides(state, other, targets, depth):
                done = self._happen(moved, k, stand, targets, depth - 1)
                if done is not None:
                    return done
        return None

    def _go_home(self, state: _State, goal: Mapping[str, int]) -> _State | None:
        """The schedule in which all robots end at their goals, or None; the first order that works is taken."""
        self._effort = _EFFORTS[-1]
        for order in itertools.islice(itertools.permutations(goal), _ORDERS):
            trial: _State | None = state
            for robot in order:
                trial = self._bring(trial, robot, goal[robot], goal, _DEPTH) if trial is not None else None
            # Who had to step aside for others comes back.
            for robot in order:
                trial = self._bring(trial, robot, goal[robot], goal, 0) if trial is not None else None
            if trial is not None:
                return trial
        return None

    def _bring(
        self,
        state: _State,
        robot: str,
        v: int,
        targets: Mapping[str, int],
        depth: int,
        partners: frozenset[str] = frozenset(),
        *,
        aside: bool = False,
    ) -> _State | None:
        """The schedule with a leg to vertex v inserted, others moved out of the way first where they stand in it.

        `aside`: the robot only has to get out of the way, and vertex v is one of many that may do.
        """
        if state.at[robot] == v:
            return state
        self.steering.deadline.check()
        leg = self._leg(state, robot, v, connect=not aside)
        if leg is None:
            return None
        trial = state.copy()
        if trial.time.insert(leg):
            trial.at[robot] = v
            return trial
        blockers = state.time.in_the_way(leg)
        past = frozenset(blockers) if self._effort.around and not aside else partners & set(blockers)
        if past:
            # Those it is to meet stay where they are: another way, past them.
            around = self._leg(state, robot, v, past | partners)
            if around is not None and trial.time.insert(around):
                trial.at[robot] = v
                return trial
        if depth == 0:
            return None
        for other in blockers:
            for moved in self._asides(state, other, targets, depth, leg):
                done = self._bring(moved, robot, v, targets, depth - 1)
                if done is not None:
                    return done
        return None

    def _asides(
        self, state: _State, robot: str, targets: Mapping[str, int], depth: int, leg: Leg | None = None
    ) -> Iterator[_State]:
        """Schedules in which a robot has gone elsewhere, with `leg` to where it leaves that free."""
        for w in self._ways_out(state, robot, targets):
            if leg is None or self._clears(state, robot, w, leg):
                moved = self._bring(state, robot, w, targets, depth - 1, aside=True)
                if moved is not None:
                    yield moved

    def _ways_out(self, state: _State, robot: str, targets: Mapping[str, int]) -> list[int]:
        """Vertices a robot may go to: its next stop, the start, back from where it stands, and it may be anywhere."""
        roadmap = self.roadmaps[robot]
        vertices = roadmap.open_vertices()
        random = [vertices[i] for i in self.rng.integers(len(vertices), size=_ASIDE if self._effort.anywhere else 0)]
        here = state.at[robot]
        onward = [targets[robot]] if robot in targets else []
        return [v for v in dict.fromkeys([*onward, 0, *roadmap.exits.get(here, [])[::-1], *random]) if v != here]

    def _clears(self, state: _State, robot: str, v: int, leg: Leg) -> bool:
        """Whether a robot that stands at v leaves the leg of another free."""
        trial = state.time.copy()
        trial.at[robot] = self._rows.vertex(robot, v)
        return robot not in trial.in_the_way(leg)

    def _leg(
        self, state: _State, robot: str, v: int, around: frozenset[str] = frozenset(), *, connect: bool = True
    ) -> Leg | None:
        """The shortest way past the world, objects as they lie, and the robots `around` where they stand; or None."""
        at = tuple(state.at[r] for r in self.names)
        others = {r for r in self.names if r != robot} - around
        if around:
            path, _ = self.steering.path(state.mode, at, robot, v, ignore=others, rounds=_AROUND, seek=True)
        else:
            key = (robot, state.at[robot], v, state.mode)
            detour = self.rng.random() < self._variety
            path = None if detour else self._ways.get(key)
            if path is None:
                path, _ = self.steering.path(state.mode, at, robot, v, ignore=others, detour=detour, connect=connect)
                if path is not None and not detour:
                    self._ways[key] = path
        if path is None:
            return None
        return Leg({robot: self._rows.path(robot, path, state.time.at[robot])}, state.mode)
