"""Where a planner stands, for people who wait, and what reports look at in any planner."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Protocol

from mrtamp.graphs import Graphs
from mrtamp.guidance import ModalGuidance
from mrtamp.incumbent import Incumbent
from mrtamp.modes import Mode
from mrtamp.plan import Plan
from mrtamp.problem import Problem
from mrtamp.transitions.sampler import TransitionSampler


class Reporting(Protocol):
    """A planner as `status_of` and `mrtamp.explain.explain` see it."""

    problem: Problem
    iteration: int
    graphs: Graphs
    guidance: ModalGuidance
    sampler: TransitionSampler
    incumbent: Incumbent

    @property
    def best(self) -> Plan | None:
        """The cheapest plan so far; None before there is one."""
        ...

    @property
    def trouble(self) -> Mapping[tuple[str, str], int]:
        """(robot, what was in its way) -> number of motions that failed for it."""
        ...

    def modes(self) -> Iterator[Mode]:
        """One discovered mode per modal state."""
        ...


@dataclass(frozen=True)
class Status:
    """How far a planner has come.

    Attributes
    ----------
    phase : "first plan" until there is one, then "improving".
    elapsed_s : seconds spent planning, over all calls.
    modes, orbits : how many the graphs have discovered; modes that differ in poses alone count once.
    nodes : how much the planner has built, in units of its own.
    remaining : optimistic number of transitions to the goal from the nearest mode; 0 once there is a plan.
    cost : of the best plan; None before there is one.
    """

    phase: str
    iteration: int
    elapsed_s: float
    modes: int
    orbits: int
    nodes: int
    remaining: int
    cost: float | None


def status_of(planner: Reporting, nodes: int, elapsed_s: float) -> Status:
    """A snapshot of a planner that has built so many nodes in that time."""
    best, remaining = planner.best, 0
    if best is None:
        nearest = min(planner.modes(), key=planner.guidance.remaining, default=None)
        remaining = planner.guidance.transitions_to_go(nearest) if nearest is not None else 0
    return Status(
        phase="first plan" if best is None else "improving",
        iteration=planner.iteration,
        elapsed_s=elapsed_s,
        modes=len(planner.graphs.modal),
        orbits=len(planner.graphs.orbital),
        nodes=nodes,
        remaining=remaining,
        cost=None if best is None else best.cost,
    )
