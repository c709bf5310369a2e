"""What the judge says: violations, each naming what is wrong and where, collected in a report.

Violations are data as well as text, so that a planner can repair the interval in which two bodies met.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

Kind = Literal[
    "structure",
    "limits",
    "start",
    "continuity",
    "attachment",
    "grasp",
    "rest",
    "transition",
    "contact",
    "collision",
    "goal",
    "cost",
    "history",
]
"""structure: shapes, names and numbers; limits: joint limits; start, goal: not those of the problem; continuity: a jump
between segments or an object that jumps at a transition; attachment: no rigid transform, or an unknown parent; grasp:
not a legal grasp; rest: not at rest on its support; transition: an illegal change of mode; contact: a picked or placed
object that penetrates or slides; collision: two bodies meet; cost, history: numbers that do not fit the motion."""


@dataclass(frozen=True)
class Side:
    """One of two colliding bodies: `kind` is robot, object or static; `owner` its name in the problem."""

    kind: str
    owner: str
    body: str

    def __str__(self) -> str:
        return self.owner if self.body == self.owner else f"{self.owner}/{self.body}"


@dataclass(frozen=True)
class Violation:
    """One thing that is wrong with a plan.

    `segment` is the index of the segment (of a transition: the one that ends there).  Where it is about motion, it
    happens between the waypoints `step` and `step + 1`, at `fraction` in [0, 1] of the way.  `value` is the size of
    what is wrong: a penetration depth or a distance (m), an excess (rad), a difference in cost.
    """

    kind: Kind
    message: str
    segment: int | None = None
    step: int | None = None
    fraction: float | None = None
    value: float | None = None
    sides: tuple[Side, Side] | None = None

    def guilty(self, carriers: Mapping[str, str], robots: Collection[str]) -> tuple[tuple[str, ...], str | None]:
        """The one or two of `robots` that a collision is about, and what a single one hit: maybe itself.

        `carriers` maps objects that are held to who holds them; a load counts with its carrier.
        """
        owners = [carriers.get(s.owner, s.owner) for s in self.sides or ()]
        found = tuple(dict.fromkeys(o for o in owners if o in robots))
        obstacles = [o for o in owners if o not in robots]
        if not found or self.kind != "collision":
            return found, None
        return found, obstacles[0] if obstacles else found[0]

    def __str__(self) -> str:
        return f"{self.kind}: {self.message}{self._where()}"

    def _where(self) -> str:
        if self.segment is None:
            return ""
        if self.step is None:
            return f" (segment {self.segment})"
        return (
            f" (segment {self.segment}, {self.fraction or 0.0:.0%} between waypoints {self.step} and {self.step + 1})"
        )


class FirstViolation(Exception):
    """Ends the judgement after the first violation, when no more are asked for."""


@dataclass
class Report:
    """The verdict on a plan.

    `samples` counts the configurations whose distances were computed, `min_clearance_m` is the smallest distance among
    bodies that may not touch, as far as it was seen (infinite when nothing came near), `elapsed` is in seconds.
    """

    violations: list[Violation] = field(default_factory=list)
    samples: int = 0
    min_clearance_m: float = float("inf")
    elapsed: float = 0.0
    first_only: bool = False

    @property
    def ok(self) -> bool:
        """Whether nothing is wrong."""
        return not self.violations

    @property
    def kinds(self) -> set[str]:
        """The kinds of violations found."""
        return {v.kind for v in self.violations}

    def add(self, violation: Violation) -> None:
        """Record a violation; ends the judgement if only the first is wanted."""
        self.violations.append(violation)
        if self.first_only:
            raise FirstViolation

    def clearance(self, distances: np.ndarray) -> None:
        """Take note of distances (E,) between bodies that may not touch."""
        self.min_clearance_m = min(self.min_clearance_m, float(distances.min(initial=float("inf"))))

    def collisions(self) -> Iterator[Violation]:
        """The violations that lie on a stretch of motion between two bodies, for repair."""
        return (v for v in self.violations if v.sides is not None)

    def __str__(self) -> str:
        if self.ok:
            clearance = (
                f"clearance {self.min_clearance_m * 1e3:.1f} mm" if self.min_clearance_m < np.inf else "all far apart"
            )
            return f"ok: {self.samples} configurations in {self.elapsed:.3f} s, {clearance}"
        return "\n".join([f"{len(self.violations)} violations", *(f"  {v}" for v in self.violations)])
