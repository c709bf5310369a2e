"""Several plans under refinement at once: the one that starts dearest may end cheapest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from mrtamp.collision import RESOLUTION
from mrtamp.plan import Plan
from mrtamp.refine import Refiner

SIZE = 3
CHANCE = 600
"""Proposals after which plans are compared by cost."""
WORTH_CHECKING = 0.005
"""Relative gain over the incumbent that is worth a check."""


@dataclass
class _Candidate:
    refiner: Refiner
    checked: Plan
    resolution: float


class Portfolio:
    """Up to SIZE refiners that take turns.

    Parameters
    ----------
    make : a refiner for a plan at a sampling resolution (m).
    assemble : turns a refiner's polyline into a plan.
    accept : whether the judge accepts a plan.
    """

    def __init__(
        self,
        make: Callable[[Plan, float], Refiner],
        assemble: Callable[[Refiner], Plan],
        accept: Callable[[Plan], bool],
    ) -> None:
        self._make, self._assemble, self._accept = make, assemble, accept
        self._candidates: list[_Candidate] = []

    def add(self, plan: Plan, resolution: float = RESOLUTION) -> None:
        """Put a checked plan under refinement; when there are too many, the dearest goes."""
        self._candidates.append(_Candidate(self._make(plan, resolution), plan, resolution))
        if len(self._candidates) > SIZE:
            self._candidates.remove(max(self._candidates, key=lambda c: c.refiner.cost))

    def improve(self, proposals: int, incumbent: float) -> Plan | None:
        """Give one candidate its turn; a checked plan when it is clearly cheaper than `incumbent`."""
        if not self._candidates or not proposals:
            return None
        # The newest first gets as many proposals as the others have had, then the cheapest is favoured.
        candidate = min(self._candidates, key=lambda c: (c.refiner.proposals // CHANCE, c.refiner.cost))
        candidate.refiner.improve(proposals)
        if candidate.refiner.cost > incumbent * (1 - WORTH_CHECKING):
            return None
        plan = self._assemble(candidate.refiner)
        if self._accept(plan):
            candidate.checked = plan
            return plan
        # Something slipped between the samples: go back to what was checked and look more closely.
        self._candidates.remove(candidate)
        self.add(candidate.checked, candidate.resolution / 2)
        return None
