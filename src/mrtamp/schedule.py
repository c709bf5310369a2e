"""Schedules of tasks: when things happen if every robot moves at unit speed and ignores the others (DESIGN section 9).

Given which option does each task and in which order, `Schedules` computes the cost of the decoupled schedule for chosen
transition candidates, for one task over all its candidates at once, and chooses candidates.  Pure arithmetic: no
geometry is checked here.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from mrtamp.options import Distance, Happening, Option, Precedence, Skeleton, Task

if TYPE_CHECKING:
    from mrtamp.problem import CostWeights

FAR = 1e9
"""Distance (rad) that stands for 'no way': a schedule this long is none."""
Stage = tuple[int, int]
"""Number of the task and number of the stage in its option."""
Place = tuple[int, int, int] | str
"""A set of stops of a robot: (task, option, event), "start" or "end"."""
START, END = "start", "end"


@dataclass(frozen=True)
class Ordering:
    """Number of the option that does each task, and all stages in an order; a robot's share of it is its course."""

    options: tuple[int, ...]
    stages: tuple[Stage, ...]


@dataclass(frozen=True)
class _Step:
    """One event: its robots with where each comes from, and the events that have to happen before."""

    task: int
    event: int
    comes_from: tuple[tuple[str, int | None, Place], ...]
    after: tuple[tuple[int, int], ...]


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a schedule comes to: floats, or arrays over the candidates of the task left open."""

    cost: np.ndarray
    bound: np.ndarray
    times: Mapping[tuple[int, int], np.ndarray]
    lengths: Mapping[str, np.ndarray]


def joint_distance(robot: str, A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Euclidean joint distance (m, k) from each of A (m, n) to each of B (k, n): straight motions."""
    squares = np.einsum("ij,ij->i", A, A)[:, None] + np.einsum("ij,ij->i", B, B) - 2.0 * (A @ B.T)
    return np.sqrt(np.maximum(squares, 0.0))


class Schedules:
    """Costs of orderings of one set of tasks.

    Parameters
    ----------
    starts : where every robot stands; the robots are its keys.
    ends : where robots have to finish; None or missing: anywhere.
    """

    def __init__(
        self,
        tasks: Sequence[Task],
        precedence: Precedence,
        starts: Mapping[str, np.ndarray],
        ends: Mapping[str, np.ndarray | None],
        weights: CostWeights,
        distance: Distance | None = None,
    ) -> None:
        self.tasks = tuple(tasks)
        self.robots = tuple(starts)
        self.weights = weights
        self.distance = distance
        number = {t.name: i for i, t in enumerate(tasks)}
        self.precedence = [((number[a], i), (number[b], j)) for (a, i), (b, j) in precedence]
        self._fixed: dict[tuple[str, str], np.ndarray] = {(r, START): np.atleast_2d(q) for r, q in starts.items()}
        self._fixed |= {(r, END): np.atleast_2d(q) for r, q in ends.items() if q is not None}
        self._rows: dict[tuple, np.ndarray] = {}
        self.extra = [[self._extra(o) for o in t.options] for t in tasks]

    @staticmethod
    def _extra(option: Option) -> np.ndarray:
        penalty = np.zeros(option.candidates) if option.penalty is None else np.minimum(option.penalty, FAR)
        return option.constant + penalty

    # -- distances ------------------------------------------------------------------------------------------------

    def stops(self, robot: str, place: Place) -> np.ndarray:
        """Configurations (M, n) of a robot at a place."""
        if isinstance(place, str):
            return self._fixed[robot, place]
        t, o, e = place
        return self.tasks[t].options[o].events[e].stops[robot]

    def ends_somewhere(self, robot: str) -> bool:
        """Whether it is prescribed where the robot finishes."""
        return (robot, END) in self._fixed

    def block(self, robot: str, A: np.ndarray, B: np.ndarray) -> np.ndarray:
        """Distances (m, k), `FAR` where there is no way."""
        return np.minimum((self.distance or joint_distance)(robot, A, B), FAR)

    def _pairs(self, robot: str, A: np.ndarray, B: np.ndarray) -> np.ndarray:
        """Distances of A to B where one of them is a single configuration, or row by row."""
        if self.distance is None:
            return np.linalg.norm(A - B, axis=1)
        if len(A) == 1 or len(B) == 1:
            return self.block(robot, A, B).ravel()
        return np.diagonal(self.block(robot, A, B))

    def between(self, robot: str, a: Place, i: int | None, b: Place, j: int | None) -> np.ndarray:
        """Distance from candidate i of one place to candidate j of another; None: each candidate (M,) of the task.

        Both are None only where the two places belong to one task, whose candidates go together.
        """
        key = (robot, a, i, b, j)
        row = self._rows.get(key)
        if row is None:
            A, B = self.stops(robot, a), self.stops(robot, b)
            row = self._pairs(robot, A if i is None else A[i : i + 1], B if j is None else B[j : j + 1])
            if i is not None and j is not None:
                row = row[0]
            self._rows[key] = row
        return row

    def inner(self, t: int, o: int) -> dict[str, np.ndarray]:
        """Path length (M,) of every robot inside an option that is one stage: from its first to its last event."""
        out = {}
        events = self.tasks[t].options[o].events
        for robot in self.tasks[t].options[o].robots:
            own = [e for e, event in enumerate(events) if robot in event.stops]
            out[robot] = np.zeros(self.tasks[t].options[o].candidates)
            for e, f in pairwise(own):
                out[robot] = out[robot] + self.between(robot, (t, o, e), None, (t, o, f), None)
        return out

    # -- one ordering ---------------------------------------------------------------------------------------------

    def courses(self, ordering: Ordering) -> dict[str, list[tuple[int, int]]]:
        """Per robot, the events (task, event) it takes part in, in order."""
        out: dict[str, list[tuple[int, int]]] = {r: [] for r in self.robots}
        for t, k in ordering.stages:
            option = self.tasks[t].options[ordering.options[t]]
            for e in option.stages[k]:
                for robot in option.events[e].stops:
                    out[robot].append((t, e))
        return out

    def order_of(self, ordering: Ordering) -> tuple:
        """What makes orderings distinct: per robot, its stages with the robots of each."""
        out: dict[str, list] = {r: [] for r in self.robots}
        for t, k in ordering.stages:
            option = self.tasks[t].options[ordering.options[t]]
            robots = tuple(sorted({r for e in option.stages[k] for r in option.events[e].stops}))
            for robot in robots:
                out[robot].append((self.tasks[t].name, k, robots))
        return tuple(tuple(course) for course in out.values())

    def steps(self, ordering: Ordering) -> list[_Step] | None:
        """The events in an order that respects courses and precedence; None when they wait for each other for ever."""
        events = {(t, e) for t, o in enumerate(ordering.options) for e in range(len(self.tasks[t].options[o].events))}
        comes_from: dict[tuple[int, int], list] = {e: [] for e in events}
        after: dict[tuple[int, int], set] = {e: set() for e in events}
        for robot, course in self.courses(ordering).items():
            at: tuple[int | None, Place] = (None, START)
            last = None
            for t, e in course:
                comes_from[t, e].append((robot, *at))
                if last is not None:
                    after[t, e].add(last)
                last, at = (t, e), (t, (t, ordering.options[t], e))
        waits: dict[tuple[int, int], list] = {e: [] for e in events}
        for event in events:
            if event[1] > 0:
                waits[event].append((event[0], event[1] - 1))
        count = [len(self.tasks[t].options[o].events) for t, o in enumerate(ordering.options)]
        for (a, i), (b, j) in self.precedence:
            waits[b, j % count[b]].append((a, i % count[a]))
        for event in events:
            after[event] |= set(waits[event])
        followers: dict[tuple[int, int], list] = {e: [] for e in events}
        for event, before in after.items():
            for x in before:
                followers[x].append(event)
        missing = {e: len(before) for e, before in after.items()}
        ready = sorted((e for e, n in missing.items() if n == 0), reverse=True)
        out = []
        while ready:
            event = ready.pop()
            out.append(_Step(*event, tuple(comes_from[event]), tuple(waits[event])))
            for f in followers[event]:
                missing[f] -= 1
                if missing[f] == 0:
                    ready.append(f)
        return out if len(out) == len(events) else None

    def run(self, options: Sequence[int], steps: Iterable[_Step], choice: Sequence[int | None]) -> Outcome:
        """The schedule when every task uses its chosen candidate; one task may be left open (None)."""
        zero = np.zeros(())
        at: dict[str, tuple[int | None, Place]] = dict.fromkeys(self.robots, (None, START))
        clock = dict.fromkeys(self.robots, zero)
        lengths = dict.fromkeys(self.robots, zero)
        times: dict[tuple[int, int], np.ndarray] = {}
        for step in steps:
            here: Place = (step.task, options[step.task], step.event)
            time = zero
            for robot, t, place in step.comes_from:
                way = self.between(robot, place, 0 if t is None else choice[t], here, choice[step.task])
                lengths[robot] = lengths[robot] + way
                time = np.maximum(time, clock[robot] + way)
                at[robot] = (step.task, here)
            for other in step.after:
                time = np.maximum(time, times[other])
            times[step.task, step.event] = time
            for robot, _, _ in step.comes_from:
                clock[robot] = time
        for robot in self.robots:
            if self.ends_somewhere(robot):
                t, place = at[robot]
                way = self.between(robot, place, 0 if t is None else choice[t], END, 0)
                lengths[robot], clock[robot] = lengths[robot] + way, clock[robot] + way
        extra = zero
        for t, m in enumerate(choice):
            extra = extra + (self.extra[t][options[t]] if m is None else self.extra[t][options[t]][m])
        a, b = self.weights.makespan, self.weights.path_length
        rest = b * sum(lengths.values(), start=zero) + extra
        latest, longest = zero, zero
        for robot in self.robots:
            latest, longest = np.maximum(latest, clock[robot]), np.maximum(longest, lengths[robot])
        return Outcome(a * latest + rest, a * longest + rest, times, lengths)

    def skeleton(self, ordering: Ordering, steps: Sequence[_Step], choice: Sequence[int]) -> Skeleton:
        """Everything about one choice of candidates in one ordering."""
        outcome = self.run(ordering.options, steps, choice)
        rank = {(s.task, s.event): n for n, s in enumerate(steps)}
        happenings = sorted(outcome.times, key=lambda e: (float(outcome.times[e]), rank[e]))
        return Skeleton(
            choices={t.name: (ordering.options[n], int(choice[n])) for n, t in enumerate(self.tasks)},
            happenings=tuple(Happening(self.tasks[t].name, e, float(outcome.times[t, e])) for t, e in happenings),
            cost=float(outcome.cost),
            bound=float(outcome.bound),
            lengths={r: float(x) for r, x in outcome.lengths.items()},
            order=self.order_of(ordering),
        )

    # -- candidates -----------------------------------------------------------------------------------------------

    def polish(
        self,
        ordering: Ordering,
        steps: Sequence[_Step],
        choice: Sequence[int],
        taboo: Mapping[int, Iterable[int]] | None = None,
        sweeps: int = 3,
    ) -> list[int]:
        """Better candidates for an ordering: shortest courses robot by robot, then task by task on the true cost.

        `taboo` maps tasks to candidates that must not be chosen.
        """
        barred = {t: np.fromiter(ms, int) for t, ms in (taboo or {}).items()}
        best = list(choice)
        value = np.inf
        if not any(best[t] in ms for t, ms in barred.items()):
            value = float(self.run(ordering.options, steps, best).cost)
        for _ in range(sweeps):
            before = value
            trial = self._shortest(ordering, best, barred)
            cost = float(self.run(ordering.options, steps, trial).cost)
            if cost < value - 1e-9:
                best, value = trial, cost
            for t in range(len(self.tasks)):
                open_: list[int | None] = list(best)
                open_[t] = None
                costs = np.broadcast_to(
                    self.run(ordering.options, steps, open_).cost, self.extra[t][ordering.options[t]].shape
                )
                if t in barred:
                    costs = costs.copy()
                    costs[barred[t]] = np.inf
                m = int(np.argmin(costs))
                if costs[m] < value - 1e-9:
                    best[t], value = m, float(costs[m])
            if not value < before - 1e-9:
                break
        return best

    def _shortest(self, ordering: Ordering, choice: Sequence[int], taboo: Mapping[int, np.ndarray]) -> list[int]:
        """Viterbi along every robot's course over the tasks it does alone and in one go; the others stay."""
        best = list(choice)
        scale = max(self.weights.makespan + self.weights.path_length, 1e-9)
        for robot, course in self.courses(ordering).items():
            nodes: list[tuple[int, Place, Place]] = []
            for t, e in course:
                place = (t, ordering.options[t], e)
                if nodes and nodes[-1][0] == t and self._alone(t, ordering.options[t]):
                    nodes[-1] = (t, nodes[-1][1], place)
                else:
                    nodes.append((t, place, place))
            if not nodes:
                continue
            last = self.stops(robot, START)
            value = np.zeros(1)
            back: list[np.ndarray] = []
            for t, first, end in nodes:
                if self._alone(t, ordering.options[t]):
                    entry, leave = self.stops(robot, first), self.stops(robot, end)
                    work = self.inner(t, ordering.options[t])[robot] + self.extra[t][ordering.options[t]] / scale
                    if t in taboo:
                        work = work.copy()
                        work[taboo[t]] = FAR
                else:
                    m = best[t]
                    entry, leave, work = (
                        self.stops(robot, first)[m : m + 1],
                        self.stops(robot, end)[m : m + 1],
                        np.zeros(1),
                    )
                total = value[:, None] + self.block(robot, last, entry)
                back.append(np.argmin(total, axis=0))
                value, last = total.min(axis=0) + work, leave
            if self.ends_somewhere(robot):
                value = value + self.block(robot, last, self.stops(robot, END))[:, 0]
            m = int(np.argmin(value))
            for (t, _, _), pointer in zip(reversed(nodes), reversed(back), strict=True):
                if self._alone(t, ordering.options[t]):
                    best[t] = m
                m = int(pointer[m])
        return best

    def _alone(self, t: int, o: int) -> bool:
        option = self.tasks[t].options[o]
        return len(option.robots) == 1 and len(option.stages) == 1
