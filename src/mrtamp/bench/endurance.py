"""One long run per problem: how its memory grows and what the cost still gains (`mrtamp bench endurance`)."""

from __future__ import annotations

import statistics
from collections.abc import Sequence

from mrtamp.bench.costs import Job
from mrtamp.bench.run import Run, Stopped, measure
from mrtamp.bench.table import Line, header, number, table_row, yes_or_no

LIMIT_MB = 2048.0
"""More memory no run may take."""
_EVERY_S = 10.0
"""Seconds between two samples of memory."""
_FASTER, _NOISE_MB = 1.25, 5.0
"""Memory grows no faster than linearly: in the second half at most `_FASTER` times the rate of the first, or less than
`_NOISE_MB` per minute."""
_LOOKS = 10
"""Moments at which cost and memory are printed."""


def endurance(job: Job, minutes: float, line: Line) -> bool:
    """Print the table, run by run, and the course of each; whether memory stays bounded and no plan is wrong.

    Raises
    ------
    Stopped : Ctrl-C came; what the last run had come to is in the table.
    """
    line.say(
        header(
            "problem",
            "seed",
            "planned",
            "plans",
            "first plan",
            "at the end",
            "above best known",
            "memory in the middle",
            "at the end",
            "growth, first half",
            "second half",
            f"peak (limit {LIMIT_MB:.0f} MB)",
            "never rises",
            "checked",
        )
    )
    good = True
    for row in job.rows:
        for seed in range(job.seeds):
            stopped = None
            try:
                run: Run | None = measure(row.task, seed, 60 * minutes, line, salvage=True)
            except Stopped as stop:
                stopped, run = stop, stop.run
            if run is not None:
                better = job.take(row, run)
                text, ok = endurance_row(run, job.known.cost(row.task))
                good &= ok
                line.say(text)
                line.say(course(run))
                if better is not None:
                    line.say(f"better than the best known ({job.written})")
            if stopped is not None:
                raise stopped
    return good


def sampled(run: Run) -> list[tuple[float, float]]:
    """Memory (s, MB) every `_EVERY_S`, and at the end."""
    out: list[tuple[float, float]] = []
    for t, mb in run.memory:
        if not out or t - out[-1][0] >= _EVERY_S - 0.5:
            out.append((t, mb))
    if run.memory and out[-1] != run.memory[-1]:
        out.append(run.memory[-1])
    return out


def growth(samples: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Growth of memory (MB per minute) in the first and in the second half of a run; 0 where too little is known."""
    if not samples:
        return 0.0, 0.0
    middle = samples[-1][0] / 2
    first, second = ([s for s in samples if (s[0] > middle) == late] for late in (False, True))
    return _slope(first), _slope(second)


def _slope(samples: Sequence[tuple[float, float]]) -> float:
    if len(samples) < 2:
        return 0.0
    times, megabytes = zip(*samples, strict=True)
    return 60 * statistics.linear_regression(times, megabytes).slope


def endurance_row(run: Run, best: float) -> tuple[str, bool]:
    """The line of a run, and whether all is well."""
    samples = sampled(run)
    first, second = growth(samples)
    bounded = second <= max(_FASTER * first, _NOISE_MB) and run.peak_mb < LIMIT_MB
    end = samples[-1] if samples else (0.0, float("inf"))
    middle = next((mb for t, mb in samples if t >= end[0] / 2), float("inf"))
    text = table_row(
        run.name,
        str(run.seed),
        f"{end[0] / 60:.1f} min{', stopped' if run.stopped else ''}",
        str(len(run.points)),
        number(run.first.cost if run.first else None),
        number(run.best.cost if run.best else None),
        number(100 * (run.best.cost / best - 1) if run.best else None, "+.2f", " %"),
        number(middle, ".0f", " MB"),
        number(end[1], ".0f", " MB"),
        f"{first:.1f} MB/min",
        f"{second:.1f} MB/min",
        f"{run.peak_mb:.0f} MB",
        yes_or_no(run.never_rises),
        yes_or_no(not run.refused),
    )
    return text, bounded and run.flawless and bool(run.points)


def course(run: Run) -> str:
    """Memory and cost at some moments, as one line; what the judge said against plans, if anything."""
    samples = sampled(run)
    shown = samples[:: max(1, len(samples) // _LOOKS)]
    shown += samples[-1:] if samples and shown[-1] != samples[-1] else []
    moments = "; ".join(f"{t:.0f} s: {mb:.0f} MB, cost {number(run.cost_at(t))}" for t, mb in shown)
    return "\n".join([f"{run.name}, seed {run.seed}: {moments or 'no samples'}", *run.refused])
