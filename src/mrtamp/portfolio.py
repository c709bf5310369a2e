"""Several plans under refinement at once: the one that starts dearest may end cheapest."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from mrtamp.collision import RESOLUTION, Collision
from mrtamp.incumbent import Incumbent
from mrtamp.plan import Plan
from mrtamp.problem import Problem
from mrtamp.refine import Refiner
from mrtamp.roadmap import Roadmap
from mrtamp.transitions.sampler import TransitionSampler
from mrtamp.validity import Validity

SIZE = 4
_SLICE = 60
"""Proposals of shortening per turn."""
_SHORTENING = 480
"""Proposals after which shortening ends at the latest."""
_STALE = 0.004
"""Relative gain of a turn below which shortening has done its part."""
WORTH_CHECKING = 0.003
"""Relative gain over the incumbent that is worth a check."""


@dataclass(eq=False)
class _Entry:
    """A checked plan and what works on it."""

    plan: Plan
    resolution: float = RESOLUTION
    refiner: Refiner | None = None
    proposals: int = 0
    done: bool = False
    costs: list[float] = field(default_factory=list)

    @property
    def cost(self) -> float:
        return self.refiner.cost if self.refiner is not None else self.plan.cost


class Portfolio:
    """Up to SIZE plans that take turns: the newest are shortened first, then the cheapest is optimised on."""

    def __init__(
        self,
        problem: Problem,
        collision: Collision,
        validity: Validity,
        roadmaps: Mapping[str, Roadmap],
        sampler: TransitionSampler,
        incumbent: Incumbent,
        rng: np.random.Generator,
        *,
        convex: bool = True,
        sliding: bool = True,
    ) -> None:
        self.problem = problem
        self.collision = collision
        self.validity = validity
        self.roadmaps = roadmaps
        self.sampler = sampler
        self.incumbent = incumbent
        self.rng = rng
        self.convex = convex
        self.sliding = sliding
        self._entries: list[_Entry] = []

    def add(self, plan: Plan) -> None:
        """Put a checked plan under refinement; when there are too many, the dearest that is finished goes."""
        self._entries.append(_Entry(plan))
        if len(self._entries) > SIZE:
            finished = [e for e in self._entries[:-1] if e.done] or self._entries[:-1]
            self._entries.remove(max(finished, key=lambda e: e.cost))

    def improve(self, incumbent: float) -> Plan | None:
        """Give one plan its turn; a checked plan when it is clearly cheaper than `incumbent`."""
        if not self._entries:
            return None
        entry = self._choose()
        if entry.refiner is None:
            entry.refiner = self._refiner(entry)
        gain = entry.refiner.improve(_SLICE)
        entry.proposals += _SLICE
        if entry.proposals >= _SHORTENING and gain < _STALE * entry.cost:
            entry.done = True
        if entry.refiner.cost > incumbent * (1 - WORTH_CHECKING):
            return None
        plan = self.incumbent.accepted(entry.refiner.segments(), entry.refiner.transitions)
        if plan is not None:
            entry.plan = plan
            return plan
        # Something slipped between the samples: go back to what was checked and look more closely.
        entry.resolution /= 2
        entry.refiner = None
        return None

    def _choose(self) -> _Entry:
        fresh = [e for e in self._entries if not e.done]
        return fresh[-1] if fresh else min(self._entries, key=lambda e: e.cost)

    def _refiner(self, entry: _Entry) -> Refiner:
        return Refiner(
            entry.plan.segments,
            entry.plan.transitions,
            self.problem.cost,
            self.collision,
            self.validity,
            self.roadmaps,
            self.rng,
            entry.resolution,
        )
