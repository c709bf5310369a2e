"""Costs over time, relative to the best ever found (`mrtamp bench costs`)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from mrtamp.bench.best import Best, BestKnown, best_of
from mrtamp.bench.run import Run, Task, measure, pick_place
from mrtamp.bench.table import Line, header, median, number, table_row, yes_or_no

FIRST_AIM = 2.5
"""A first plan may cost at most so many times the best known."""
RATIO_AT_S = 20.0
"""Seconds after which the aim for makespan / path length holds."""


@dataclass(frozen=True)
class CostRow:
    """A problem, and how far its median cost may be above the best known after some seconds of planning.

    `ratio` is the aim for makespan / path length after `RATIO_AT_S`: arms move at the same time.
    """

    task: Task
    aims: Mapping[float, float] = field(default_factory=dict)
    ratio: float | None = None

    @property
    def name(self) -> str:
        """The name of the problem."""
        return self.task.name


COSTS = (
    CostRow(pick_place(2, 2), {10: 0.02, 60: 0.01}),
    CostRow(pick_place(2, 4), {10: 0.05, 60: 0.03}, ratio=0.65),
    CostRow(pick_place(3, 3), {10: 0.15, 60: 0.05}),
    CostRow(pick_place(4, 4), {10: 0.10, 60: 0.04}),
    CostRow(Task("box"), {10: 0.10, 60: 0.04}),
    CostRow(Task("handover"), {10: 0.10, 60: 0.04}),
    CostRow(Task("stacking"), {10: 0.10, 60: 0.04}),
)


@dataclass(frozen=True)
class Job:
    """What is measured, and what becomes of the runs.

    Attributes
    ----------
    rows, seeds : problems, and how many planner seeds each.
    known : the best known costs; written only with `update`.
    command : what was run, noted with costs that are better than the best known.
    keep : puts a run away, for the file of raw data.
    """

    rows: Sequence[CostRow]
    seeds: int
    known: BestKnown
    command: str
    update: bool = False
    keep: Callable[[Run], None] = lambda run: None

    def take(self, row: CostRow, run: Run) -> Best | None:
        """Put a run away; its best plan where it is cheaper than the best known, which it becomes."""
        self.keep(run)
        best = best_of(run, self.command)
        lower = self.known.update if self.update else self.known.see
        return best if best is not None and lower(row.task, best) else None

    @property
    def written(self) -> str:
        """Whether costs that are better than the best known are on the disk, in words."""
        return "written" if self.update else "not written: --update does"


def costs(job: Job, budgets: Sequence[float], line: Line) -> bool:
    """Print the table, row by row; returns whether every row is within its aims.

    Parameters
    ----------
    budgets : seconds after which costs are looked at, in ascending order; runs last as long as the last.

    Raises
    ------
    Stopped : Ctrl-C came; the seeds finished until then are in the table.
    """
    line.say(
        header(
            "problem",
            "best known",
            "success",
            f"first plan: median, worst (aim {FIRST_AIM:g})",
            *(f"at {t:g} s: median, worst (aim)" for t in budgets),
            "makespan",
            "path length",
            "makespan / path length",
            "peak memory",
            "never rises",
            "checked",
        )
    )
    good, notes = True, []
    for row in job.rows:
        runs: list[Run] = []
        before, better = job.known.cost(row.task), ""
        try:
            for seed in range(job.seeds):
                run = measure(row.task, seed, budgets[-1], line)
                runs.append(run)
                best = job.take(row, run)
                if best is not None:
                    was = f"the best known was {before:.4f}" if before < float("inf") else "none was known"
                    better = f"{row.name}, seed {best.seed}: a plan of cost {best.cost:.4f}; {was} ({job.written})"
        finally:
            if runs:
                text, within = cost_row(row, runs, job.known.cost(row.task), budgets)
                line.say(text)
                good &= within
                notes += [better] if better else []
                for run in runs:
                    notes += [f"{row.name}, seed {run.seed}: {refusal}" for refusal in run.refused]
            if len(runs) < job.seeds:
                _explain(line, notes)
    _explain(line, notes)
    return good


def _explain(line: Line, notes: Sequence[str]) -> None:
    line.say(
        "\nMedians over the seeds; costs of first plans are multiples of the best known, later ones in % above it."
    )
    if notes:
        line.say("\n".join(notes))


def cost_row(row: CostRow, runs: Sequence[Run], best: float, budgets: Sequence[float]) -> tuple[str, bool]:
    """The line of a problem, and whether it is within its aims."""
    within = [all(run.flawless and run.points for run in runs)]
    firsts = [run.first.cost / best if run.first else float("inf") for run in runs]
    first = _aimed(median(firsts), max(firsts), max(firsts) <= FIRST_AIM, ".2f", "")
    within.append(max(firsts) <= FIRST_AIM)
    later = []
    for t in budgets:
        above = [100 * (run.cost_at(t) / best - 1) for run in runs]
        aim = row.aims.get(t)
        within.append(aim is None or median(above) <= 100 * aim)
        text = _aimed(median(above), max(above), within[-1], "+.1f", " %")
        later.append(f"{text} ({100 * aim:g} %)" if aim is not None else text)
    ends = [point for run in runs if (point := run.at(budgets[-1]))]
    ratio = number(median([p.makespan / p.path_length for p in ends]), ".2f")
    if row.ratio is not None and budgets[-1] >= RATIO_AT_S:
        then = median([p.makespan / p.path_length for run in runs if (p := run.at(RATIO_AT_S))])
        within.append(then <= row.ratio)
        mark = "" if within[-1] else "**"
        ratio += f" (at {RATIO_AT_S:g} s: {mark}{number(then, '.2f')}{mark}, aim {row.ratio:g})"
    text = table_row(
        row.name,
        number(best),
        f"{sum(bool(run.points) for run in runs)}/{len(runs)}",
        first,
        *later,
        number(median([p.makespan for p in ends])),
        number(median([p.path_length for p in ends])),
        ratio,
        f"{max(run.peak_mb for run in runs):.0f} MB",
        yes_or_no(all(run.never_rises for run in runs)),
        yes_or_no(not any(run.refused for run in runs)),
    )
    return text, all(within)


def _aimed(value: float, worst: float, ok: bool, form: str, unit: str) -> str:
    """Median and worst; bold where the aim is missed."""
    mark = "" if ok else "**"
    return f"{mark}{number(value, form, unit)}{mark}, {number(worst, form, unit)}"
