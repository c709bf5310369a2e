"""Beam search and local moves over orderings of stages, for what dynamic programming does not cover (DESIGN section 9).

A state of the beam has some stages appended, each with the best candidate for where its robots stand; events wait for
predecessors that are not appended yet, and robots that wait take nothing on.  States are compared by a completion
estimate: the busiest robot, or the remaining work shared evenly.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mrtamp.schedule import END, START, Ordering, Place, Schedules, Stage


@dataclass(frozen=True, eq=False)
class _State:
    options: tuple[int, ...]
    progress: tuple[int, ...]
    choice: tuple[int, ...]
    stages: tuple[Stage, ...]
    at: tuple[tuple[Place, int], ...]
    clock: tuple[float, ...]
    travelled: float
    extra: float
    times: dict[tuple[int, int], float]
    pending: tuple[tuple[int, int], ...]
    courses: tuple[tuple[Stage, ...], ...]


class _Fit(NamedTuple):
    candidate: int
    ways: dict[tuple[str, int], float]
    length: float


class _Beam:
    """What all states of one beam share."""

    def __init__(self, plan: Schedules) -> None:
        self.plan = plan
        self.robots = plan.robots
        self.index = {r: i for i, r in enumerate(plan.robots)}
        self._fits: dict[tuple, _Fit] = {}
        self._homes: dict[tuple, float] = {}
        self.work = np.zeros(len(plan.tasks))
        self.extra = np.array([min(float(x.min()) for x in extras) for extras in plan.extra])
        for t, task in enumerate(plan.tasks):
            inner = []
            for o, option in enumerate(task.options):
                total = np.sum(list(self._inner(t, o, range(len(option.stages))).values()), axis=0)
                approach = sum(plan.between(r, START, 0, (t, o, self._first(t, o, r)), None) for r in option.robots)
                inner.append(float(np.min(total + 0.5 * approach)))
            self.work[t] = min(inner)

    def _first(self, t: int, o: int, robot: str) -> int:
        return next(e for e, event in enumerate(self.plan.tasks[t].options[o].events) if robot in event.stops)

    def _inner(self, t: int, o: int, stages: range) -> dict[tuple[str, int], np.ndarray]:
        """Way (M,) of each robot to each event of the stages except its first one in each stage."""
        option = self.plan.tasks[t].options[o]
        out: dict[tuple[str, int], np.ndarray] = {(option.robots[0], -1): np.zeros(option.candidates)}
        for k in stages:
            last: dict[str, int] = {}
            for e in option.stages[k]:
                for robot in option.events[e].stops:
                    if robot in last:
                        out[robot, e] = self.plan.between(robot, (t, o, last[robot]), None, (t, o, e), None)
                    last[robot] = e
        return out

    def start(self) -> _State:
        N, R = len(self.plan.tasks), len(self.robots)
        return _State(
            (-1,) * N, (0,) * N, (-1,) * N, (), ((START, 0),) * R, (0.0,) * R, 0.0, 0.0, {}, (), ((),) * R
        )  # fmt: skip

    def home(self, r: int, at: tuple[Place, int]) -> float:
        """How far the robot has to go to where it must finish."""
        key = (r, at)
        if key not in self._homes:
            there = self.plan.ends_somewhere(self.robots[r])
            self._homes[key] = float(self.plan.between(self.robots[r], *at, END, 0)) if there else 0.0
        return self._homes[key]

    def fit(self, state: _State, t: int, o: int, k: int) -> _Fit:
        """The candidate that suits the robots best where they stand (later stages keep it), and its ways."""
        plan, option = self.plan, self.plan.tasks[t].options[o]
        robots = dict.fromkeys(r for e in option.stages[k] for r in option.events[e].stops)
        key = (t, o, k, state.choice[t], *((r, state.at[self.index[r]]) for r in robots))
        if key not in self._fits:
            ways: dict[tuple[str, int], np.ndarray] = {}
            for robot in robots:
                e = next(e for e in option.stages[k] if robot in option.events[e].stops)
                ways[robot, e] = plan.between(robot, *state.at[self.index[robot]], (t, o, e), None)
            ways |= self._inner(t, o, range(k, k + 1))
            total = np.sum(list(ways.values()), axis=0)
            m = state.choice[t]
            if m < 0:
                share = plan.weights.makespan / len(self.robots) + plan.weights.path_length
                later = np.sum(list(self._inner(t, o, range(k + 1, len(option.stages))).values()), axis=0)
                m = int(np.argmin(share * (total + later) + plan.extra[t][o]))
            self._fits[key] = _Fit(m, {w: float(x[m]) for w, x in ways.items()}, float(total[m]))
        return self._fits[key]

    def moves(self, state: _State) -> list[tuple[int, int, int]]:
        """Stages (task, option, stage) that can be appended.

        Those that would wait for something not appended yet (two objects changing places) only where nothing else can.
        """
        plan = self.plan
        busy = {r for t, e in state.pending for r in plan.tasks[t].options[state.options[t]].events[e].stops}
        out, waiting = [], []
        for t, task in enumerate(plan.tasks):
            chosen = state.options[t]
            for o in range(len(task.options)) if chosen < 0 else [chosen]:
                option, k = task.options[o], state.progress[t]
                if k == len(option.stages):
                    continue
                stage = option.stages[k]
                if any(r in busy for e in stage for r in option.events[e].stops):
                    continue
                missing = [e for e in stage if any(not self._appended(state, a) for a in self._before(state, t, o, e))]
                if not missing:
                    out.append((t, o, k))
                elif stage[0] not in missing:
                    waiting.append((t, o, k))
        return out or waiting

    def _before(self, state: _State, t: int, o: int, e: int) -> list[tuple[int, int]]:
        """Predecessors (task, event) of an event; the event number is -1 where the option is not chosen yet."""
        count = len(self.plan.tasks[t].options[o].events)
        out = []
        for (a, i), (b, j) in self.plan.precedence:
            if b == t and j % count == e:
                chosen = state.options[a]
                out.append((a, i % len(self.plan.tasks[a].options[chosen].events) if chosen >= 0 else -1))
        return out

    def _appended(self, state: _State, event: tuple[int, int]) -> bool:
        return event in state.times or event in state.pending

    def append(self, state: _State, t: int, o: int, k: int) -> _State:
        """The state with one more stage, and everything that can then happen."""
        plan, option = self.plan, self.plan.tasks[t].options[o]
        fit = self.fit(state, t, o, k)

        def put(values: tuple, value: object) -> tuple:
            return (*values[:t], value, *values[t + 1 :])

        robots = {r for e in option.stages[k] for r in option.events[e].stops}
        fresh = _State(
            put(state.options, o),
            put(state.progress, k + 1),
            put(state.choice, fit.candidate),
            (*state.stages, (t, k)),
            state.at,
            state.clock,
            state.travelled,
            state.extra + (float(plan.extra[t][o][fit.candidate]) if k == 0 else 0.0),
            dict(state.times),
            (*state.pending, *((t, e) for e in option.stages[k])),
            tuple((*c, (t, k)) if r in robots else c for r, c in zip(self.robots, state.courses, strict=True)),
        )
        return self._happen(fresh)

    def _happen(self, state: _State) -> _State:
        plan = self.plan
        at, clock, travelled = list(state.at), list(state.clock), state.travelled
        pending, times = list(state.pending), state.times
        moved = True
        while moved:
            moved = False
            for event in pending:
                t, e = event
                o = state.options[t]
                before = self._before(state, t, o, e)
                if (e > 0 and (t, e - 1) not in times) or any(x not in times for x in before):
                    continue
                time = max([times[x] for x in before] + [times[t, e - 1] if e > 0 else 0.0])
                for robot in plan.tasks[t].options[o].events[e].stops:
                    r = self.index[robot]
                    here: Place = (t, o, e)
                    way = float(plan.between(robot, *at[r], here, state.choice[t]))
                    time = max(time, clock[r] + way)
                    travelled += way
                    at[r] = (here, state.choice[t])
                for robot in plan.tasks[t].options[o].events[e].stops:
                    clock[self.index[robot]] = time
                times[event] = time
                pending.remove(event)
                moved = True
                break
        return _State(
            state.options, state.progress, state.choice, state.stages, tuple(at), tuple(clock),
            travelled, state.extra, times, tuple(pending), state.courses,
        )  # fmt: skip

    def estimate(self, state: _State) -> float:
        """What the state will come to if the remaining work is shared evenly."""
        homes = [self.home(r, at) for r, at in enumerate(state.at)]
        finish = [c + h for c, h in zip(state.clock, homes, strict=True)]
        left = extra = 0.0
        for t, o in enumerate(state.options):
            if o < 0:
                left += self.work[t]
                extra += self.extra[t]
            elif state.progress[t] < len(self.plan.tasks[t].options[o].stages):
                left += 0.5 * self.work[t]
        weights = self.plan.weights
        makespan = max(*finish, (sum(finish) + left) / len(finish))
        return (
            weights.makespan * makespan
            + weights.path_length * (state.travelled + sum(homes) + left)
            + state.extra
            + extra
        )


def beam(plan: Schedules, width: int) -> list[tuple[Ordering, list[int]]]:
    """Complete orderings with their candidates, best estimates first: `width` states are kept after every stage."""
    shared = _Beam(plan)
    states = [shared.start()]
    done: list[tuple[float, _State]] = []
    while states:
        children: dict[tuple, tuple[float, _State]] = {}
        for state in states:
            for t, o, k in shared.moves(state):
                child = shared.append(state, t, o, k)
                value = shared.estimate(child)
                key = (child.courses, child.options)
                if key not in children or value < children[key][0]:
                    children[key] = (value, child)
        ranked = sorted(children.values(), key=lambda x: x[0])
        complete = [
            all(n == len(t.options[o].stages) for n, o, t in zip(s.progress, s.options, plan.tasks, strict=True))
            if min(s.options, default=0) >= 0
            else False
            for _, s in ranked
        ]
        done += [x for x, c in zip(ranked, complete, strict=True) if c and not x[1].pending][:width]
        states = [s for (_, s), c in zip(ranked, complete, strict=True) if not c][:width]
    done.sort(key=lambda x: x[0])
    return [(Ordering(s.options, s.stages), list(s.choice)) for _, s in done]


def neighbours(
    plan: Schedules, ordering: Ordering, choice: list[int], rng: np.random.Generator
) -> tuple[Ordering, list[int]] | None:
    """One random change: a task is done in another way or at another time, with its best candidate there.

    None when things would wait for each other for ever.
    """
    t = int(rng.integers(len(plan.tasks)))
    o = int(rng.integers(len(plan.tasks[t].options)))
    stages = [s for s in ordering.stages if s[0] != t]
    cuts = np.sort(rng.integers(len(stages) + 1, size=len(plan.tasks[t].options[o].stages)))
    for k in range(len(cuts) - 1, -1, -1):
        stages.insert(int(cuts[k]), (t, k))
    fresh = Ordering((*ordering.options[:t], o, *ordering.options[t + 1 :]), tuple(stages))
    steps = plan.steps(fresh)
    if steps is None:
        return None
    open_: list[int | None] = list(choice)
    open_[t] = None
    costs = np.broadcast_to(plan.run(fresh.options, steps, open_).cost, (plan.tasks[t].options[o].candidates,))
    return fresh, [*choice[:t], int(np.argmin(costs)), *choice[t + 1 :]]
