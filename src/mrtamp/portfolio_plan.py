"""Portfolio planning: one problem planned with several seeds side by side, on this machine or on others.

Seeds differ much in what they find within a time, and little in the long run.  Every seed has a worker of its own
(`mrtamp.cluster`); whichever finds a better plan sends it, and from then on its cost bounds what the others work on.
"""

from __future__ import annotations

import json
import threading
import time
import uuid
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np

from mrtamp.cluster import Link, Outcome, Pool, link, pool
from mrtamp.plan import Plan
from mrtamp.plan_file import plan_from_dict, plan_to_dict
from mrtamp.planner import Planner
from mrtamp.planners import make_planner, planner_options
from mrtamp.problem import MrtampError, Problem
from mrtamp.problem_file import problem_from_dict, problem_to_dict

if TYPE_CHECKING:
    from mrtamp.planners import PlannerOptions

_PERIOD_S = 0.3
"""Seconds between two looks of a seed at the bound, and between two plans that it sends."""
_PULSE_S = 1.0
"""Seconds between two reports of a seed that has no news."""
_GRACE_S = 30.0
"""Seconds beyond the budget after which a seed is given up: until then it has built its planner, planned, and said how
that went, however busy its machine is."""


@dataclass(frozen=True)
class Order:
    """What a seed is to do; `problem` is the content of a problem file, `bound` the name of the shared bound."""

    problem: dict[str, Any]
    seed: int
    planner: str
    options: PlannerOptions
    budget_s: float | None
    iterations: int | None
    first: bool
    bound: str


@dataclass(frozen=True)
class SeedReport:
    """What a seed says at its end, apart from the plans it has sent.

    Attributes
    ----------
    cost : of its own best plan, which may be worse than another seed's; None if it has none.
    explanation : why it has none.
    sampled_bound : see `mrtamp.skeleton_guidance`; None where the planner knows none.
    refused : why the problem cannot be planned at all; None if it can.
    """

    cost: float | None
    explanation: str = ""
    sampled_bound: float | None = None
    counts: dict[str, int] = field(default_factory=dict)
    refused: str | None = None


# -- on the worker ----------------------------------------------------------------------------------------------------


class _Unwanted(Exception):
    """Nobody waits for this seed any more."""


class SharedBound:
    """The cost of the best plan of all seeds; a thread reads it now and then, so that asking for it costs nothing."""

    def __init__(self, name: str) -> None:
        from distributed import Variable, get_client

        self.cost = np.inf
        self._variable = Variable(name, get_client())
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> SharedBound:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()

    def _run(self) -> None:
        while not self._over.is_set():
            with suppress(OSError, RuntimeError):  # the scheduler is busy or gone; the last bound is still one
                self.cost = min(self.cost, self._variable.get(timeout=_PERIOD_S))
            self._over.wait(_PERIOD_S)


class Messenger:
    """Sends the plans of a seed that beat the bound, not too often, and the last of them in any case."""

    def __init__(self, link: Link, bound: Callable[[], float]) -> None:
        self._link = link
        self._bound = bound
        self._waiting: Plan | None = None
        self._sent = self._told = -np.inf

    def offer(self, plan: Plan) -> None:
        """A better plan of this seed."""
        self._waiting = plan
        self.send()

    def send(self, *, last: bool = False) -> None:
        """Send the plan that waits, if it is time and nobody has a better one by now."""
        plan, now = self._waiting, time.monotonic()
        if plan is None or (now - self._sent < _PERIOD_S and not last):
            return
        self._waiting = None
        if plan.cost < self._bound():
            self._sent = now
            content = zlib.compress(json.dumps(plan_to_dict(plan)).encode())
            self._link.tell({"cost": plan.cost, "plan": content})

    def pulse(self, cost: float | None) -> None:
        """A sign of life with the cost of this seed's own best plan."""
        if time.monotonic() - self._told >= _PULSE_S:
            self._told = time.monotonic()
            self._link.tell({"cost": cost})


def plan_seed(order: Order) -> SeedReport:
    """Plan with one seed; plans are sent as they are found.  A task of `mrtamp.cluster`."""
    own = link()
    try:
        planner = make_planner(order.planner, problem_from_dict(order.problem), order.seed, order.options)
    except MrtampError as error:
        return SeedReport(None, refused=str(error))
    with SharedBound(order.bound) as bound:
        if isinstance(planner, Planner):
            planner.bound = lambda: bound.cost
        messenger = Messenger(own, lambda: bound.cost)

        def progress(_: object) -> None:
            if own.cancelled:
                raise _Unwanted
            messenger.send()
            messenger.pulse(planner.best.cost if planner.best is not None else None)

        with suppress(_Unwanted):
            for plan in planner.improve(
                order.budget_s, iterations=order.iterations, first=order.first, progress=progress
            ):
                messenger.offer(plan)
        messenger.send(last=True)
    best = planner.best
    return SeedReport(
        None if best is None else best.cost,
        planner.explain() if best is None else "",
        planner.sampled_bound,
        planner.counts(),
    )


# -- here -------------------------------------------------------------------------------------------------------------


class SeedPortfolio:
    """A planner that is several planners: one for every seed, each with a worker of its own.

    Parameters
    ----------
    problem : what to plan.
    seeds : of the planners, all different.
    scheduler : address of a Dask scheduler with at least as many workers; None: processes of this machine.
    planner, options : name and settings of the planners, see `mrtamp.planners.make_planner`.

    Attributes
    ----------
    best : the cheapest plan so far, checked; its `seed` is the one that found it, its history that of all seeds.
    reports : by seed, what it said at its end; a seed that was cut short said nothing.
    failures : by seed, why it came to no end: lost workers or a programming error.

    Raises
    ------
    MrtampError : there is no seed, or one twice; no planner or option has that name.
    """

    def __init__(
        self,
        problem: Problem,
        seeds: Sequence[int],
        *,
        scheduler: str | None = None,
        planner: str = "guided",
        options: Mapping[str, Any] | PlannerOptions | None = None,
    ) -> None:
        self.problem = problem
        self.seeds = tuple(seeds)
        if not self.seeds or len(set(self.seeds)) != len(self.seeds):
            raise MrtampError(f"found the seeds {list(seeds)}, expected at least one, all different")
        self.scheduler = scheduler
        self.planner = planner
        self.options = planner_options(planner, options)
        self.best: Plan | None = None
        self.reports: dict[int, SeedReport] = {}
        self.failures: dict[int, str] = {}
        self._costs: dict[int, float | None] = {}
        self._history: list[dict[str, float]] = []

    def improve(
        self,
        budget_s: float | None = None,
        *,
        iterations: int | None = None,
        first: bool = False,
        progress: Callable[[str], None] | None = None,
    ) -> Iterator[Plan]:
        """Plan, yielding every plan that is better than all before it, whichever seed it is from.

        Parameters
        ----------
        budget_s : seconds of planning of every seed.  They count from when all workers have started (which takes a few
            seconds for processes of this machine) and the seed has built its planner; the call takes that much longer.
        iterations : of every seed.
        first : stop after the first plan of any seed.  A plan of cost 0 ends the call in any case.
        progress : called with a line that says how far the seeds are.

        Raises
        ------
        MrtampError : the problem cannot be planned, or there are not enough workers.
        RuntimeError : all seeds failed; the message has the traceback of one.
        """
        self.reports.clear()
        self.failures.clear()
        self._costs = dict.fromkeys(self.seeds)
        with pool(self.scheduler, len(self.seeds)) as workers:
            if workers.size < len(self.seeds):
                raise MrtampError(
                    f"{len(self.seeds)} seeds side by side need as many workers; {self.scheduler} has {workers.size}"
                )
            for plan in self._found(workers, budget_s, iterations, first):
                if plan is not None:
                    yield plan
                    if first or plan.cost == 0:
                        return
                if progress is not None:
                    progress(self.status())
        if len(self.failures) == len(self.seeds) and self.best is None:
            raise RuntimeError(next(iter(self.failures.values())))

    def _found(
        self, workers: Pool, budget_s: float | None, iterations: int | None, first: bool
    ) -> Iterator[Plan | None]:
        """Every better plan, and None whenever there is other news."""
        from distributed import Variable

        bound = Variable(f"mrtamp-bound-{uuid.uuid4().hex}", workers.client)
        bound.set(self.best.cost if self.best is not None else np.inf)
        problem, began = problem_to_dict(self.problem), time.monotonic()
        tasks = (
            (str(s), (Order(problem, s, self.planner, self.options, budget_s, iterations, first, bound.name),))
            for s in self.seeds
        )
        limit = None if budget_s is None else budget_s + _GRACE_S
        try:
            for event in workers.follow(plan_seed, tasks, limit_s=limit):
                seed = int(event.key)
                if isinstance(event, Outcome):
                    self._ended(seed, event)
                    yield None
                    continue
                self._costs[seed] = event.message["cost"]
                plan = None
                if "plan" in event.message and self._better(event.message["cost"]):
                    plan = self._take(event.message["plan"], time.monotonic() - began)
                    bound.set(plan.cost)
                yield plan
        finally:
            with suppress(OSError, RuntimeError):
                bound.delete()

    def _better(self, cost: float) -> bool:
        return self.best is None or cost < self.best.cost

    def _take(self, content: bytes, time_s: float) -> Plan:
        plan = plan_from_dict(json.loads(zlib.decompress(content)))
        self._history.append({"time_s": time_s, "cost": plan.cost})
        plan.problem, plan.history = self.problem, list(self._history)
        plan.found_by = {"portfolio": _listed(self.seeds)}
        self.best = plan
        return plan

    def _ended(self, seed: int, outcome: Outcome) -> None:
        if outcome.error is not None:
            self.failures[seed] = outcome.error
            return
        report: SeedReport = outcome.value
        if report.refused is not None:
            raise MrtampError(report.refused)
        self.reports[seed] = report
        self._costs[seed] = report.cost

    def status(self) -> str:
        """How far the seeds are, in one line."""
        solved = sum(cost is not None for cost in self._costs.values())
        if self.best is None:
            return f"first plan: {len(self.seeds)} seeds side by side"
        return (
            f"improving: cost {self.best.cost:.3f} (seed {self.best.seed}), {solved} of {len(self.seeds)} seeds have "
            "plans"
        )

    @property
    def sampled_bound(self) -> float | None:
        """The least of the seeds' sampled bounds; None as long as no seed has reported one."""
        known = [r.sampled_bound for r in self.reports.values() if r.sampled_bound is not None]
        return min(known, default=None)

    def counts(self) -> dict[str, int]:
        """What all seeds did together, as far as they have reported it."""
        names = list(dict.fromkeys(name for report in self.reports.values() for name in report.counts))
        return {name: sum(report.counts.get(name, 0) for report in self.reports.values()) for name in names}

    def explain(self) -> str:
        """Why there is no plan: the account of every seed that gave one, and what became of the others."""
        parts = [f"seed {seed}: {report.explanation}" for seed, report in self.reports.items() if report.explanation]
        parts += [f"seed {seed} failed: {error.splitlines()[0]}" for seed, error in self.failures.items()]
        silent = [s for s in self.seeds if s not in self.reports and s not in self.failures]
        if silent:
            parts.append(f"cut short, without an account: {_listed(silent)}")
        return "\n\n".join(parts)


def _listed(seeds: Sequence[int]) -> str:
    if len(seeds) > 2 and list(seeds) == list(range(seeds[0], seeds[-1] + 1)):
        return f"seeds {seeds[0]} to {seeds[-1]}"
    return f"seed{'s' * (len(seeds) > 1)} {', '.join(map(str, seeds))}"


def plan_portfolio(
    problem: Problem,
    seeds: Sequence[int],
    budget_s: float,
    scheduler: str | None = None,
    on_better: Callable[[Plan], None] | None = None,
) -> Plan | None:
    """Plan with several seeds side by side and return the best plan of all, checked.

    Called from a script, it belongs under `if __name__ == "__main__":`, because workers are new processes.

    Parameters
    ----------
    seeds : of the planners, all different; each has a process of its own.
    budget_s : seconds of planning of every seed, the start of the workers not included, see `SeedPortfolio.improve`.
    scheduler : address of a Dask scheduler, as in `tcp://host:8786`; None: this machine.
    on_better : called with every plan that is better than all before it.

    Returns
    -------
    The best plan (`plan.seed` says which seed found it), or None if no seed has found any.

    Raises
    ------
    MrtampError : the problem cannot be planned, Dask is not installed, or the scheduler cannot be used.
    """
    portfolio = SeedPortfolio(problem, seeds, scheduler=scheduler)
    for plan in portfolio.improve(budget_s):
        if on_better is not None:
            on_better(plan)
    return portfolio.best
