"""What every baseline shares: the parts of the planner that it is given, the anytime loop and its reports.

Scene, collision queries, transition sampler, modal estimates and judge are those of `mrtamp.planner.Planner`, so that
a comparison is one of search and of nothing else.
"""

from __future__ import annotations

import itertools
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress

import numpy as np

from mrtamp.collision import RESOLUTION, Collision, Counts
from mrtamp.deadline import Deadline, TimeIsUp
from mrtamp.explain import explain
from mrtamp.graphs import Graphs
from mrtamp.guidance import ModalGuidance
from mrtamp.incumbent import Incumbent
from mrtamp.modes import Mode, start_mode
from mrtamp.plan import Plan
from mrtamp.problem import Problem
from mrtamp.refine import Refiner
from mrtamp.roadmap import add_stations, roadmaps_of
from mrtamp.status import Status, status_of
from mrtamp.transitions.sampler import TransitionSampler
from mrtamp.validity import Validity

_SLICE = 50
"""Proposals of shortening between two looks at the clock."""
_FINER = 3
"""How often shortening is repeated at half the resolution when the judge refuses its result."""


class Anytime(ABC):
    """A planner that is asked for better plans until time is up.

    Attributes
    ----------
    trouble : (robot, what was in its way) -> number of motions that failed for it; "world" is everything but robots.
    """

    def __init__(self, problem: Problem, seed: int, *, factored_cache: bool = True) -> None:
        self.problem = problem
        self.seed = seed
        self._clock = time.perf_counter()
        self._spent = 0.0
        self.deadline = Deadline()
        self.rng = np.random.default_rng(seed)
        self._counts = Counts()
        self.collision = Collision(problem, self._counts)
        self.roadmaps = roadmaps_of(problem, self.collision)
        self.names = list(self.roadmaps)
        self.validity = Validity(problem, self.collision, self.roadmaps, remember=factored_cache)
        self.sampler = TransitionSampler(problem, self.collision, self.roadmaps, self.validity, self.rng)
        self.graphs = Graphs()
        self.guidance = ModalGuidance(problem, self.sampler, self.graphs)
        self.incumbent = Incumbent(problem, seed, self._counts)
        self.incumbent.check_start()
        self.trouble: Counter[tuple[str, str]] = Counter()
        self.iteration = 0
        self.root = start_mode(problem)
        self.sampler.remember(self.root)
        self.graphs.discover(self.root.state)
        self._mode_of = {self.root.state: self.root}
        stations = add_stations(problem, self.roadmaps)
        self.start, self.home, self.goal = stations.start, stations.home, stations.goal

    @property
    def best(self) -> Plan | None:
        """The cheapest plan so far, checked; None before there is one."""
        return self.incumbent.best

    @property
    def sampled_bound(self) -> float | None:
        """Baselines know no bound."""
        return None

    @property
    def cost(self) -> float:
        """Cost of the best plan; infinite before there is one."""
        return self.best.cost if self.best is not None else np.inf

    def improve(
        self,
        budget_s: float | None = None,
        *,
        iterations: int | None = None,
        first: bool = False,
        progress: Callable[[Status], None] | None = None,
    ) -> Iterator[Plan]:
        """Search, yielding every better plan once it has been checked; see `mrtamp.planner.Planner.improve`."""
        self._clock = time.perf_counter() - self._spent
        self.deadline.set(budget_s)
        stop = np.inf if iterations is None else self.iteration + iterations
        try:
            while not self._late() and self.iteration < stop and self.cost > 0:
                before = self.cost
                with suppress(TimeIsUp):
                    self._iterate()
                self.iteration += 1
                self._spent = self._elapsed()
                if progress is not None:
                    progress(self.status())
                if self.cost < before:
                    assert self.best is not None
                    yield self.best
                    if first:
                        return
        finally:
            self._spent = self._elapsed()

    @abstractmethod
    def _iterate(self) -> None:
        """One iteration; it raises `TimeIsUp` or returns soon when the deadline has passed."""

    def _late(self) -> bool:
        """Whether the time of this call is over; never where a call is bounded by iterations."""
        return self.deadline.passed

    def _elapsed(self) -> float:
        return time.perf_counter() - self._clock

    def _offer(self, plan: Plan) -> bool:
        for one, two in itertools.pairwise(plan.segments):
            self._discover(two.mode, one.mode)
        return self.incumbent.offer(plan, self._elapsed())

    def _discover(self, mode: Mode, source: Mode | None = None) -> None:
        """Note a mode in the modal graph."""
        self.graphs.discover(mode.state, None if source is None else source.state)
        self._mode_of.setdefault(mode.state, mode)

    def _shortened(self, plan: Plan, proposals: int) -> Plan | None:
        """A checked plan made from `plan` by shortcuts robot by robot, where that is cheaper."""
        resolution = RESOLUTION
        for _ in range(_FINER):
            refiner = Refiner(plan, self.validity, self.rng, resolution)
            done = 0
            while done < proposals and not self._late():
                refiner.improve(min(_SLICE, proposals - done))
                done += _SLICE
            if refiner.cost >= plan.cost - 1e-9:
                return None
            better = self.incumbent.accepted(refiner.segments(), refiner.transitions)
            if better is not None or self._late():
                return better
            # Something slipped between the samples.
            resolution /= 2
        return None

    # -- reports --------------------------------------------------------------------------------------------------

    @property
    def nodes(self) -> int:
        """How much the planner has built, for the progress display."""
        return self._counts.nodes

    def modes(self) -> Iterator[Mode]:
        """One discovered mode per modal state."""
        yield from self._mode_of.values()

    def status(self) -> Status:
        """A snapshot for progress displays."""
        return status_of(self, self.nodes, self._spent)

    def counts(self) -> dict[str, int]:
        """What was done, in numbers that do not depend on the machine."""
        return self._counts.work()

    def explain(self) -> str:
        """Why there is no plan yet."""
        return explain(self)
