"""Measuring: time to the first checked plan on the paper's tasks, as one table (`mrtamp bench first`).

Every row runs in a process of its own, so that nothing is warm and its peak memory is its own.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass

from mrtamp.bench.run import Task, Tell, apart, peak_mb, pick_place
from mrtamp.bench.table import Line, header, median, number, table_row

FIRST_BUDGET_S = 60.0


@dataclass(frozen=True)
class Row:
    """One problem of the table: what to load, the median aimed for (s), and what the paper needed (24 cores)."""

    task: Task
    aim_s: float
    paper: str

    @property
    def name(self) -> str:
        """The name of the problem."""
        return self.task.name


FIRST = (
    Row(Task("box"), 1.0, "10 s"),
    Row(Task("handover"), 1.0, "12 s"),
    Row(Task("stacking"), 2.0, "47 s"),
    Row(pick_place(2, 2), 0.5, "4 s"),
    Row(pick_place(2, 4), 1.0, "30 s"),
    Row(pick_place(2, 6), 1.5, "53 s"),
    Row(pick_place(3, 3), 1.0, "7 s"),
    Row(pick_place(3, 6), 2.0, "111 s"),
    Row(pick_place(4, 4), 2.0, "57 s"),
    Row(pick_place(4, 6), 3.0, "176 s (80 %)"),
    Row(pick_place(8, 24), 60.0, "-"),
)


@dataclass(frozen=True)
class Result:
    """Seconds from the loaded problem to the first checked plan, its cost (None: no plan), per seed; peak memory."""

    seconds: list[float | None]
    costs: list[float | None]
    peak_mb: float


def measure(task: Task, seeds: Sequence[int], budget_s: float, tell: Tell) -> Result:
    """Run one row in this process."""
    from mrtamp.planner import Planner

    seconds: list[float | None] = []
    costs: list[float | None] = []
    for seed in seeds:
        tell(f"seed {seed}")
        problem = task.load()
        start = time.perf_counter()
        planner = Planner(problem, seed=seed)
        found = next(planner.improve(budget_s, first=True), None)
        seconds.append(time.perf_counter() - start if found else None)
        costs.append(found.cost if found else None)
    return Result(seconds, costs, peak_mb())


def start_to_exit() -> float:
    """Seconds of `mrtamp plan pick_place --robots 2 --objects 2 --first`, start to exit."""
    command = [sys.executable, "-m", "mrtamp", "plan", "pick_place", "--robots", "2", "--objects", "2", "--first"]
    start = time.perf_counter()
    subprocess.run([*command, "--quiet"], check=True)
    return time.perf_counter() - start


def first_plans(seeds: int, rows: Sequence[Row], line: Line) -> bool:
    """Print the table of first plans, row by row; returns whether every row succeeded within its aim."""
    line.say(
        header(
            *("problem", "success", "median first plan", "slowest", "aim", "median cost", "peak memory", "the paper")
        )
    )
    good = True
    for row in rows:
        result: Result = apart(measure, row.task, range(seeds), FIRST_BUDGET_S, tell=_shown(line, row.name))
        times = [t for t in result.seconds if t is not None]
        # A run without a plan counts as the whole budget.
        middle = median([t if t is not None else FIRST_BUDGET_S for t in result.seconds])
        good &= len(times) == seeds and middle <= row.aim_s
        line.say(
            table_row(
                row.name,
                f"{len(times)}/{seeds}",
                number(middle, ".2f", " s"),
                number(max(times, default=None), ".2f", " s"),
                f"{row.aim_s:g} s",
                number(median([c for c in result.costs if c is not None]), ".1f"),
                f"{result.peak_mb:.0f} MB",
                row.paper,
            )
        )
    line.show("a whole command, start to exit")
    whole = median([start_to_exit() for _ in range(seeds)])
    line.say(
        f"\n`mrtamp plan pick_place --robots 2 --objects 2 --first`, start to exit: median {whole:.2f} s (aim 4 s)"
    )
    return good and whole < 4.0


def _shown(line: Line, name: str) -> Tell:
    return lambda text: line.show(f"{name}, {text}")
