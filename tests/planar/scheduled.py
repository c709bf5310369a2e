"""Plans for discs made from a timetable: every robot follows its shortest path at full speed, except where it is held.

This is the other half of an optimum: the timetable is a lower bound, and a plan that attains it is a proof of it.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from mrtamp.modes import start_mode
from mrtamp.plan import Action, Plan, Segment, Transition, plan_cost
from mrtamp.problem import Problem
from mrtamp.timetable import Timetable

Hold = tuple[float, float]
"""How far along its path (m) a robot stands, and until when."""


class Schedule:
    """Where a robot is at which time: its path, and the holds on it, in order; by default it starts at once."""

    def __init__(
        self, legs: Sequence[np.ndarray], lengths: Sequence[float], arrivals: Sequence[float], holds: Sequence[Hold]
    ) -> None:
        self.points = np.concatenate(legs)
        ends = np.cumsum(lengths)
        # A leg's polyline is a little longer than its length: it runs around the arcs.
        self.along = np.concatenate([e + _along(x, d) for x, e, d in zip(legs, ends - lengths, lengths, strict=True)])
        # A subgoal is a hold too: until it is due.
        due = [(float(s), t) for s, t in zip(ends, arrivals, strict=False)]
        self.times, self.distances = [0.0], [0.0]
        for s, t in sorted([*due, *holds]):
            self._reach(s)
            if t > self.times[-1]:
                self.times.append(t)
                self.distances.append(s)
        self._reach(float(self.along[-1]))

    def _reach(self, s: float) -> None:
        if s > self.distances[-1]:
            self.times.append(self.times[-1] + s - self.distances[-1])
            self.distances.append(s)

    @property
    def end(self) -> float:
        """When the robot is at its end."""
        return self.times[-1]

    def at(self, t: np.ndarray) -> np.ndarray:
        """Positions (T, 2) at times t (T,)."""
        s = np.interp(t, self.times, self.distances)
        return np.column_stack([np.interp(s, self.along, x) for x in self.points.T])

    def knots(self) -> np.ndarray:
        """The times at which the robot turns, stops or starts."""
        turns = np.interp(self.along, self.distances, self.times)
        return np.concatenate([self.times, turns])


def _along(points: np.ndarray, length: float) -> np.ndarray:
    """How far (k,) along a leg of the given length each of its points is."""
    far = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    return far * (length / far[-1] if far[-1] > 0 else 0.0)


def scheduled_plan(problem: Problem, table: Timetable, holds: Mapping[str, Sequence[Hold]]) -> Plan:
    """The plan in which every robot follows its path of the timetable, held where `holds` says.

    Subgoals are reached when the timetable says.
    """
    robots = {
        name: Schedule(table.legs[name], table.lengths[name], [table.arrival[s] for s in order], holds.get(name, ()))
        for name, order in table.order.items()
    }
    end = max(r.end for r in robots.values())
    moments = sorted({*table.arrival.values()} - {0.0})
    knots = np.unique(np.concatenate([[0.0, end], moments, *(r.knots() for r in robots.values())]).round(12))
    mode = start_mode(problem)
    segments, transitions = [], []
    for a, b in itertools.pairwise([0.0, *moments, end]):
        t = np.concatenate([[a], knots[(knots > a + 1e-9) & (knots < b - 1e-9)], [b]])
        segments.append(Segment(mode, {name: r.at(t) for name, r in robots.items()}))
        # Things may follow each other in no time, in the order of their predecessors.
        pending = [s for s in problem.subgoals if table.arrival[s.name] == b and s.name not in mode.done]
        while pending:
            ready = [s for s in pending if all(name in mode.done for name in s.after)]
            for n, s in enumerate(ready):
                transition = Transition((Action("reach", tuple(s.targets), None, None, s.name),))
                mode = mode.after(transition)
                transitions.append(transition)
                pending.remove(s)
                if pending or n + 1 < len(ready):
                    segments.append(Segment(mode, {name: r.at(np.array([b])) for name, r in robots.items()}))
    if len(segments) == len(transitions):
        segments.append(Segment(mode, {name: r.at(np.array([end])) for name, r in robots.items()}))
    return Plan(problem, segments, transitions, plan_cost(segments, transitions, problem.cost))
