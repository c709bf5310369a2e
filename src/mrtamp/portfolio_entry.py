"""A plan or draft under refinement, and how much work it gets (see `mrtamp.portfolio`)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mrtamp.collision import RESOLUTION
from mrtamp.effort import Effort
from mrtamp.optimise import LocalSearch, Optimiser
from mrtamp.optimise.yielding import Draft
from mrtamp.plan import Plan
from mrtamp.refine import Refiner
from mrtamp.transitions.ways import Way

_TRIAL, _FAST, _SLOWLY = 5, 0.03, 0.01
"""Conic programs that a plan gets before it is compared with the others, and more as long as each makes it cheaper by
that share, or at least by that of them (see `Patience`)."""
_CRAWL = 0.01
"""Share that a first round has to gain in so many programs as `Patience` says to go on."""
_CREEP, _LATELY = 0.004, 4
"""The same for later rounds where there is no choice of ways, and in how many programs: another motion of the same
ways, from the start, gains more than the last of their programs."""
_PACE, _FURTHER = 3, 6
"""A first round is expected to go on at the pace of its last programs for so many more."""
NEARLY = 0.97
"""A plan whose current iterate costs less than the incumbent times this goes on until it is free of collision."""
FIRST_SEARCH = 2
"""Rounds that have converged before the first that is local search."""
FIRST, LATER = "first rounds", "later rounds"
"""What turns go to: plans that have not converged, and those that are shaken and refined again."""


@dataclass(frozen=True)
class Patience:
    """How much work a plan gets.

    slow : number of programs up to which its trial goes on even if it becomes cheaper slowly.
    hopeless : if it costs so many times the best after its trial it waits until nothing else is left to do.
    lately : number of programs in which a first round has to gain something to go on.
    shares : least shares of first and of later rounds; as long as neither gains anything first ones have what is left.
    same_ways : whether there is no choice of ways.
    local : whether, from the third on, every other round is local search.
    """

    slow: int
    hopeless: float
    lately: int
    shares: tuple[float, float]
    same_ways: bool = False
    local: bool = True

    def effort(self) -> Effort:
        """Shares out turns to first and later rounds."""
        first, later = self.shares
        return Effort({FIRST: first, LATER: later}, {FIRST: 1.0, LATER: 0.0})


OTHER_WAYS = Patience(slow=0, hopeless=1.12, lately=5, shares=(0.5, 0.2))
SAME_WAYS = Patience(slow=12, hopeless=1.02, lately=3, shares=(0.5, 0.06), same_ways=True)
"""Where there is no choice of ways, most plans come near to each other, but with many robots a few end far below."""


@dataclass(frozen=True, eq=False)
class Sketch:
    """A draft, what its skeleton was to cost, the ways it takes, those of them that have most of the conflict, and
    whether that is so much that they may not come free."""

    estimate: float
    draft: Draft
    ways: frozenset[Way] = frozenset()
    guilty: frozenset[Way] = frozenset()
    doubtful: bool = False


@dataclass(eq=False)
class Entry:
    """A checked plan and what works on it: convex programming, in later rounds after some shortening.

    A draft is no plan yet: its robots still collide with each other, and convex programs have to pull them apart.
    """

    plan: Plan
    draft: bool = False
    sketch: Sketch | None = None
    """What it began as, if that was a draft."""
    resolution: float = RESOLUTION
    refiner: Refiner | None = None
    optimiser: Optimiser | LocalSearch | None = None
    proposals: int = 0
    done: bool = False
    rounds: int = 0
    """How often refinement has converged."""
    fruitless: int = 0
    """How often since it last gained anything."""
    before: float = np.inf
    """Cost when this round began."""
    trail: list[float] = field(default_factory=list)
    """Outlook after every conic program of this round."""
    patience: Patience = OTHER_WAYS
    waiting: int = 0
    """Conic programs since it has been worth a check."""
    retimings: int = 0
    """How often it has been timed anew, as a draft."""
    coarse: float = np.nan
    """What it cost after its first round."""

    @property
    def cost(self) -> float:
        work = self.optimiser or self.refiner
        return work.cost if work is not None else self.plan.cost

    @property
    def outlook(self) -> float:
        """What the plan is likely to cost soon."""
        return self.optimiser.outlook if self.optimiser is not None else self.cost

    @property
    def expected(self) -> float:
        """What it is likely to cost after its first round, where there is no choice of ways; else the outlook."""
        trail = self.trail[-_PACE - 1 :]
        if self.rounds or not self.patience.same_ways or len(trail) <= _PACE:
            return self.outlook
        return self.outlook - _FURTHER * max(trail[0] - trail[-1], 0.0) / _PACE

    @property
    def slow(self) -> bool:
        """Whether a round gains so little that other plans are worth more.

        Where there is a choice of ways, and in local search, later rounds go on to the end.
        """
        if self.rounds and self.patience.same_ways and isinstance(self.optimiser, Optimiser):
            return self._gained_less(_CREEP, _LATELY)
        # What has not been checked has to be good by then to go on.
        lately = self.patience.lately * (2 if self.unchecked else 1)
        clean = self.optimiser is not None and self.optimiser.cost <= (1 + _CRAWL) * self.outlook
        return self.rounds == 0 and clean and self._gained_less(_CRAWL, lately)

    def _gained_less(self, share: float, programs: int) -> bool:
        """Whether there were so many programs in this round, and the last of them gained less than that share."""
        trail = self.trail[-programs:]
        return len(trail) == programs and trail[0] - min(trail) < share * trail[-1]

    @property
    def over(self) -> bool:
        """Whether convex programming has come to the end of this round."""
        return self.optimiser is not None and (self.optimiser.converged or self.optimiser.stuck or self.slow)

    @property
    def on_trial(self) -> bool:
        """Whether it has begun only just, or gains much with every program of its first round."""
        if self.rounds or self.done:
            return False
        if self.optimiser is None:
            return True
        steps = self.optimiser.steps
        least = _SLOWLY if steps < self.patience.slow else _FAST
        return steps < _TRIAL or (len(self.trail) > 1 and self.trail[-1] < (1 - least) * self.trail[-2])

    @property
    def began_as_draft(self) -> bool:
        return self.sketch is not None

    @property
    def estimate(self) -> float:
        """What its skeleton was to cost, if it began as a draft."""
        return self.sketch.estimate if self.sketch is not None else np.nan

    @property
    def unchecked(self) -> bool:
        """Whether it is free of collision as far as the planner knows, and the judge has not been asked."""
        return self.draft and not self.began_as_draft

    @property
    def size(self) -> int:
        """Number of knots that a turn works on."""
        return self.optimiser.knots if self.optimiser is not None else sum(s.length for s in self.plan.segments)

    @property
    def fresh(self) -> bool:
        """Whether it has not converged for the first time."""
        return self.rounds == 0 and not self.done

    @property
    def fresh_draft(self) -> bool:
        """Whether it began as a draft and has not converged yet."""
        return self.rounds == 0 and self.began_as_draft

    @property
    def goes_ahead(self) -> bool:
        """Whether, as the incumbent, it has its turns before others: from its trial to the end of its first round of
        finer steps, which with re-timing gain most, if it began as a draft or there is no choice of ways.
        """
        begun = self.rounds == 1 or (self.rounds == 0 and not self.on_trial)
        return begun and (self.began_as_draft or self.patience.same_ways)

    @property
    def fineness(self) -> int:
        """How often convex programs for the whole plan have converged."""
        return self.rounds - (max(self.rounds - 1, 0) // 2 if self.patience.local else 0)

    @property
    def searches(self) -> bool:
        """Whether its round is local search."""
        return self.patience.local and self.rounds >= FIRST_SEARCH and self.rounds % 2 == 0

    def is_near(self, incumbent: float) -> bool:
        """Whether it is about to beat the incumbent clearly."""
        return bool(self.trail) and self.outlook < NEARLY * incumbent
