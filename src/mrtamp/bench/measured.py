"""One run of a suite: any planner on any problem, in a process of its own, measured the same way for all of them.

Times are read here, not from what planners say of themselves; the first and the cheapest plan within the limit are
saved, loaded again and judged from their files.
"""

from __future__ import annotations

import os
import resource
import time
from collections.abc import Sequence
from dataclasses import replace
from multiprocessing import current_process
from typing import TYPE_CHECKING

from mrtamp.bench.machine import this_machine
from mrtamp.bench.records import Record, Times
from mrtamp.bench.run import Point, Pulse, Tell, apart, peak_mb, refusals
from mrtamp.bench.suite import Assignment

if TYPE_CHECKING:
    from mrtamp.plan import Plan

START_S, OVERRUN_S, JUDGE_S = 120.0, 10.0, 120.0
"""Seconds after which a run is killed: while it starts, planning beyond its limit, having its plans judged."""
_PLANNING, _JUDGING = "planning", "judging"
_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
_WHY = 2000
"""Characters kept of what a planner says why there is no plan."""


def run_assignment(assignment: Assignment, tell: Tell) -> Record:
    """Run it in a process of its own; whatever goes wrong there is in the record.

    Raises
    ------
    Stopped : Ctrl-C came.
    """
    patience = {"": START_S, _PLANNING: assignment.case.limit_s + OVERRUN_S, _JUDGING: JUDGE_S}
    machine = this_machine()
    began = time.perf_counter()
    heard: dict[str, float] = {}

    def hear(text: str) -> None:
        heard.setdefault(text, time.perf_counter() - began)
        tell(text)

    # With more threads times would depend on what else the machine does; whoever sets these wants it otherwise.
    threads = {name: os.environ.get(name, "1") for name in _THREADS}
    try:
        record: Record = apart(plan_assignment, assignment, tell=hear, patience=patience, environment=threads)
    except (TimeoutError, RuntimeError) as error:
        return replace(blank(assignment), error=str(error).strip(), machine=machine)
    assert record.times is not None
    times = replace(record.times, start=heard[_PLANNING], wall=time.perf_counter() - began)
    return replace(record, times=times, machine=machine)


def run_on_worker(assignment: Assignment) -> Record:
    """The same as a task of `mrtamp.cluster`, which hears how far it is and may cancel it."""
    from mrtamp.cluster import link

    # A worker with a nanny is a daemon, which may have no children; a run ends by itself when its worker is gone.
    current_process().daemon = False
    here = link()

    def tell(text: str) -> None:
        if here.cancelled:
            raise KeyboardInterrupt
        here.tell(text)

    return run_assignment(assignment, tell)


def plan_assignment(assignment: Assignment, tell: Tell) -> Record:
    """Plan once, in this process, and have the plans judged; how long it took to get here is seen from outside."""
    from mrtamp.plan import measures
    from mrtamp.planners import make_planner, planner_options

    entrant, limit_s = assignment.entrant, assignment.case.limit_s
    problem = assignment.case.task(assignment.layout).load()
    # What is loaded with the first use of a planner or of the judge belongs to the start.
    import mrtamp.check  # noqa: F401

    options = planner_options(entrant.planner, entrant.options())

    tell(_PLANNING)
    plans: list[Plan] = []
    points: list[Point] = []
    first_counts: dict[str, int] = {}
    started = time.perf_counter()
    with Pulse(tell) as pulse:
        planner = make_planner(entrant.planner, problem, assignment.seed, options)
        for plan in planner.improve(max(limit_s - (time.perf_counter() - started), 0.0)):
            points.append(Point(time.perf_counter() - started, plan.cost, **measures(plan.segments)))
            first_counts = first_counts or dict(planner.counts())
            plans.append(plan)
            pulse.cost = plan.cost
    planned = time.perf_counter()
    peak = peak_mb()
    tell(_JUDGING)
    refused = refusals(_that_count(plans, points, limit_s))
    why = "" if plans else planner.explain()[:_WHY]
    judged = time.perf_counter()
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return replace(
        blank(assignment),
        points=tuple(points),
        first_counts=first_counts,
        counts=dict(planner.counts()),
        times=Times(
            start=0.0,
            planning=planned - started,
            judging=judged - planned,
            wall=judged - started,
            cpu=usage.ru_utime + usage.ru_stime,
        ),
        peak_mb=peak,
        refused=tuple(refused),
        why=why,
    )


def _that_count(plans: Sequence[Plan], points: Sequence[Point], limit_s: float) -> list[Plan]:
    """The plans that tables are made of: the first and the cheapest of those within the limit, each once."""
    within = [k for k, point in enumerate(points) if point.time_s <= limit_s]
    if not within:
        return []
    return [plans[k] for k in sorted({within[0], min(within, key=lambda k: points[k].cost)})]


def blank(assignment: Assignment) -> Record:
    """What is known of a run before it begins."""
    case = assignment.case
    return Record(
        key=assignment.key,
        case=case.name,
        parameters=case.task(assignment.layout).parameters,
        planner=assignment.entrant.label,
        seed=assignment.seed,
        limit_s=case.limit_s,
    )
