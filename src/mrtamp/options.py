"""Tasks, the ways to do them, and the skeletons chosen from them: plain data (DESIGN section 9).

A task is done in one of several ways (options); an option is a sequence of events, and an event happens when all its
robots stand at their configurations and its predecessors have happened.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

Distance = Callable[[str, np.ndarray, np.ndarray], np.ndarray]
"""`distance(robot, A (m, n), B (k, n)) -> (m, k)`: how far (rad) the robot travels from each of A to each of B."""
Precedence = Sequence[tuple[tuple[str, int], tuple[str, int]]]
"""Pairs ((task a, event i), (task b, event j)): event i of a happens not after event j of b; -1 is the last event."""


@dataclass(frozen=True, eq=False)
class Event:
    """Something its robots do together at one instant: pick, place, handover, reach.

    `stops` maps robot name to (M, n): row m is where the robot stands in candidate m of the option.
    """

    kind: str
    stops: Mapping[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class Option:
    """One way to do a task: `events` in order, with M joint candidates (candidate m is row m of every event).

    `constant` is the cost of its transitions; `penalty` (M,) what is known to come on top of the estimate (learnt).
    """

    robots: tuple[str, ...]
    events: tuple[Event, ...]
    constant: float = 0.0
    penalty: np.ndarray | None = None

    @cached_property
    def candidates(self) -> int:
        """The number of candidates M."""
        return len(next(iter(self.events[0].stops.values())))

    @cached_property
    def stages(self) -> tuple[tuple[int, ...], ...]:
        """Runs of events between which some robot's hand is full: what no other task may interrupt."""
        out, run, holding = [], [], set[str]()
        for i, event in enumerate(self.events):
            run.append(i)
            givers = holding & set(event.stops)
            if event.kind == "pick":
                holding |= set(event.stops)
            elif event.kind == "handover":
                holding = (holding - givers) | (set(event.stops) - givers)
            else:
                holding -= givers
            if not holding:
                out.append(tuple(run))
                run = []
        return (*out, tuple(run)) if run else tuple(out)


@dataclass(frozen=True, eq=False)
class Task:
    """Something that has to be done once, in one of several ways."""

    name: str
    options: tuple[Option, ...]


@dataclass(frozen=True)
class Happening:
    """Event number `event` of the option chosen for `task` happens at `time` (rad of motion since the start)."""

    task: str
    event: int
    time: float


@dataclass(frozen=True, eq=False)
class Skeleton:
    """A proposal: who does what, with which transitions, in which order.

    Attributes
    ----------
    choices : task name -> (option, candidate).
    happenings : all events in the order in which they happen in the decoupled schedule.
    cost : makespan weight * schedule length + path weight * sum of path lengths + constants + penalties.
    bound : the same with each robot's own path length for its finishing time, that is without waiting.
    lengths : path length (rad) of every robot.
    order : per robot, the stages it takes part in: (task, stage, robots of the stage).  Skeletons with the same `order`
        differ in candidates alone.
    """

    choices: Mapping[str, tuple[int, int]]
    happenings: tuple[Happening, ...]
    cost: float
    bound: float
    lengths: Mapping[str, float]
    order: tuple = field(repr=False)
