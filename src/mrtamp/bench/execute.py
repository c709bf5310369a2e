"""A suite is run: one run after the other in this process's care, or side by side on workers (`mrtamp.cluster`)."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from mrtamp.bench.measured import run_assignment, run_on_worker
from mrtamp.bench.records import Record, Records
from mrtamp.bench.suite import Assignment, Suite
from mrtamp.bench.table import Line

_START_S = 2.0
"""Seconds that a run takes beyond its limit, as long as none has been measured."""


def execute(
    suite: Suite,
    folder: Path,
    line: Line,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    again: bool = False,
    wanted: Callable[[Assignment], bool] = lambda assignment: True,
) -> list[str]:
    """Run what has not been run yet; returns what could not be run, in words.

    Parameters
    ----------
    folder : of the raw records, see `Records`.
    workers : runs at the same time; with one and without a scheduler they need no Dask.
    again : runs that failed (an error, not for lack of a plan) are run once more.
    wanted : whether a run is to be done.

    Raises
    ------
    MrtampError : the folder holds records of another suite; the workers cannot be used.
    Stopped : Ctrl-C came; what was finished is on the disk.
    """
    with Records(folder, suite) as records:
        done = {record.key for record in records.done if not (again and record.error is not None)}
        all_wanted = [a for a in suite.assignments() if wanted(a)]
        ahead = [a for a in all_wanted if a.key not in done]
        progress = Progress(ahead, len(all_wanted) - len(ahead), workers, line)
        lost: list[str] = []
        if not ahead:
            return lost
        if workers == 1 and scheduler is None:
            for assignment in ahead:
                progress.tell(assignment.key, "starting")
                record = run_assignment(assignment, partial(progress.tell, assignment.key))
                records.add(record)
                progress.finished(record)
            return lost
        from mrtamp.cluster import pool

        by_key = {assignment.key: assignment for assignment in ahead}
        with pool(scheduler, workers) as cluster:
            progress.workers = max(cluster.size, 1)
            tasks = ((key, (assignment,)) for key, assignment in by_key.items())
            for outcome in cluster.run(run_on_worker, tasks, hear=progress.tell):
                if outcome.error is not None:
                    lost.append(f"{outcome.key}: {outcome.error.splitlines()[0]}")
                    progress.lost(outcome.key)
                else:
                    records.add(outcome.value)
                    progress.finished(outcome.value)
        return lost


class Progress:
    """Says how many runs are done, how long the rest will take, and what the latest of them is at.

    Parameters
    ----------
    ahead : runs to do; `before` others are done already.
    workers : runs at the same time.
    """

    def __init__(self, ahead: Sequence[Assignment], before: int, workers: int, line: Line) -> None:
        self.workers = workers
        self._limits = {assignment.key: assignment.case.limit_s for assignment in ahead}
        self._total = len(ahead) + before
        self._began: dict[str, float] = {}
        self._extra: list[float] = []
        self._line = line

    def tell(self, key: str, text: str) -> None:
        """Something is heard of a run; it has begun when it is heard of first."""
        self._began.setdefault(key, time.monotonic())
        self._show(key, text)

    def finished(self, record: Record) -> None:
        """A run is over."""
        if record.times is not None:
            self._extra.append(record.times.wall - record.limit_s)
        self._drop(record.key, "done")

    def lost(self, key: str) -> None:
        """A run will not be done this time."""
        self._total -= 1
        self._drop(key, "lost")

    def _drop(self, key: str, text: str) -> None:
        self._limits.pop(key, None)
        self._began.pop(key, None)
        self._show(key, text)

    def _show(self, key: str, text: str) -> None:
        done = self._total - len(self._limits)
        self._line.show(f"{done}/{self._total} runs, {duration(self.left())} left; {key}: {text}")

    def left(self) -> float:
        """Seconds until the end, about."""
        extra, now = statistics.mean(self._extra) if self._extra else _START_S, time.monotonic()
        rest = [max(limit + extra - (now - self._began.get(key, now)), 0.0) for key, limit in self._limits.items()]
        # A run is not shared by workers, so that the longest of them has to be waited for.
        return max(sum(rest) / self.workers, max(rest, default=0.0))


def expected_s(suite: Suite) -> float:
    """Seconds that a suite takes, one run after the other."""
    return sum(assignment.case.limit_s + _START_S for assignment in suite.assignments())


def duration(seconds: float) -> str:
    """A time to wait, roughly."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    if seconds < 100 * 60:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"
