"""Plan: segments of synchronous motion, the transitions between them, what it costs and how it was found.

A plan file stands alone: it carries its problem, so `mrtamp check` needs nothing else (paper, equation 1).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mrtamp.modes import Attachment, Mode
from mrtamp.problem import CostWeights, Problem


@dataclass(frozen=True, eq=False)
class Segment:
    """Motion inside one mode: K synchronous waypoints; every robot moves linearly from each to the next.

    `q` maps robot name to (K, n) joint positions, the same K >= 1 for all robots.
    """

    mode: Mode
    q: dict[str, np.ndarray]

    @property
    def length(self) -> int:
        """Number of waypoints K."""
        return len(next(iter(self.q.values())))


@dataclass(frozen=True)
class Action:
    """One elementary change by `robots` (receiver last): pick, place, handover, or reach.

    The first three change an object's attachment from `before` to `after`; reach reaches `subgoal`, and changes an
    attachment where the subgoal says so.
    """

    kind: str
    robots: tuple[str, ...]
    before: Attachment | None
    after: Attachment | None
    subgoal: str | None = None

    @property
    def object(self) -> str | None:
        """The object whose attachment changes; None where none does."""
        return self.after.object if self.after is not None else None


@dataclass(frozen=True)
class Transition:
    """A change of mode at one composite configuration: simultaneous actions of disjoint sets of robots."""

    actions: tuple[Action, ...]

    @property
    def active(self) -> tuple[str, ...]:
        """The active set A, sorted."""
        return tuple(sorted({r for a in self.actions for r in a.robots}))

    @property
    def kind(self) -> str:
        """The kind of the action, or 'simultaneous'."""
        return self.actions[0].kind if len(self.actions) == 1 else "simultaneous"


@dataclass(eq=False)
class Plan:
    """A solution pi_0, t_1, pi_1, ..., t_K, pi_K.  `segments[k]` ends where `transitions[k]` happens."""

    problem: Problem
    segments: list[Segment]
    transitions: list[Transition]
    cost: float
    history: list[dict[str, float]] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)
    seed: int | None = None
    versions: dict[str, str] = field(default_factory=dict)
    found_by: dict[str, str] = field(default_factory=dict)
    """What there is to say about how it was found, beyond the seed."""

    def save(self, path: str | Path) -> None:
        """Write the plan with its problem to a file; see `mrtamp.plan_file.save_plan`."""
        from mrtamp.plan_file import save_plan  # here, because the file format is built on this module

        save_plan(self, path)

    @classmethod
    def load(cls, path: str | Path) -> Plan:
        """Read a plan file; see `mrtamp.plan_file.load_plan`."""
        from mrtamp.plan_file import load_plan

        return load_plan(path)


def motion_lengths(segment: Segment) -> np.ndarray:
    """Euclidean joint length of every robot (rows) in every synchronous step (columns)."""
    return np.array([np.linalg.norm(np.diff(q, axis=0), axis=1) for q in segment.q.values()])


def segment_cost(segment: Segment, weights: CostWeights) -> float:
    """Cost of the motion of one segment: sum over steps of makespan * max_r |dq_r| + path_length * sum_r |dq_r|."""
    steps = motion_lengths(segment)
    if not steps.size:
        return 0.0
    return float(weights.makespan * steps.max(axis=0).sum() + weights.path_length * steps.sum())


def plan_cost(segments: list[Segment], transitions: list[Transition], weights: CostWeights) -> float:
    """J of a whole plan (paper, equation 2)."""
    motion = sum(segment_cost(s, weights) for s in segments)
    changes = weights.of_changes(a.kind for t in transitions for a in t.actions)
    return motion + changes


def without_detours(steps: Sequence[tuple[Action, ...]]) -> list[int]:
    """Indices of the transitions that are left when picks put back where they came from are dropped, pair by pair.

    A pick and the next action of the same robot cancel when that puts the object back to the very same attachment.
    """
    kept = list(range(len(steps)))
    again = True
    while again:
        again = False
        for n, i in enumerate(kept):
            if len(steps[i]) != 1 or steps[i][0].kind != "pick":
                continue
            [pick] = steps[i]
            later = (j for j in kept[n + 1 :] if any(set(a.robots) & set(pick.robots) for a in steps[j]))
            j = next(later, None)
            if j is not None and len(steps[j]) == 1 and steps[j][0].after is pick.before:
                kept = [k for k in kept if k not in (i, j)]
                again = True
                break
    return kept


def measures(segments: list[Segment]) -> Mapping[str, float]:
    """Makespan and path length of a plan (rad)."""
    makespan = sum(float(motion_lengths(s).max(axis=0).sum()) for s in segments if s.length > 1)
    path = sum(float(motion_lengths(s).sum()) for s in segments)
    return {"makespan": makespan, "path_length": path}
