"""What each mechanism of the planner is worth: the same runs without it (`mrtamp bench ablation`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from mrtamp.bench_costs import Keep
from mrtamp.bench_run import Run, Setting, Task, measure, pick_place
from mrtamp.bench_table import Line, header, median, number, table_row, yes_or_no
from mrtamp.mechanisms import INTRA_ORBIT_NAMES, MECHANISMS

ALL_ON = "all on"
TASKS = (pick_place(2, 4), pick_place(3, 3), Task("handover"))


@dataclass(frozen=True)
class AblationRow:
    """A problem and how the planner is set for it."""

    task: Task
    what: str
    setting: Setting

    @property
    def name(self) -> str:
        """Problem and setting."""
        return f"{self.task.name}, {self.what}"


def _settings() -> dict[str, Setting]:
    settings = {ALL_ON: Setting()}
    settings |= {f"without {name}": Setting(without=(name,)) for name in MECHANISMS}
    # The first name is the default.
    settings |= {f"intra-orbit {name}": Setting(intra_orbit=name) for name in INTRA_ORBIT_NAMES[1:]}
    return settings


ABLATION = tuple(AblationRow(task, what, setting) for task in TASKS for what, setting in _settings().items())


def with_references(rows: Sequence[AblationRow]) -> list[AblationRow]:
    """The rows, and for each of their problems first the one with everything switched on."""
    tasks = list(dict.fromkeys(row.task.name for row in rows))
    out = []
    for name in tasks:
        out += [row for row in ABLATION if row.task.name == name and row.what == ALL_ON]
        out += [row for row in rows if row.task.name == name and row.what != ALL_ON]
    return out


def ablation(
    seeds: int,
    budget_s: float,
    rows: Sequence[AblationRow],
    line: Line,
    *,
    keep: Keep = lambda run: None,
) -> bool:
    """Print the table, row by row; whether every plan was right (switching something off may well cost plans).

    Raises
    ------
    Stopped : Ctrl-C came; the seeds finished until then are in the table.
    """
    line.say(
        header(
            "problem",
            "planner",
            "success",
            "first plan",
            "its cost",
            "relative",
            f"cost at {budget_s:g} s",
            "relative",
            "curves and checks",
        )
    )
    good = True
    reference: dict[str, tuple[float, float]] = {}
    for row in with_references(rows):
        runs: list[Run] = []
        try:
            for seed in range(seeds):
                runs.append(measure(row.task, seed, budget_s, line, row.setting))
                keep(runs[-1])
        finally:
            if runs:
                line.say(ablation_row(row, runs, budget_s, reference))
                good &= all(run.flawless for run in runs)
    line.say("\nMedians over the seeds; relative: to the same problem with everything switched on.")
    return good


def ablation_row(
    row: AblationRow, runs: Sequence[Run], budget_s: float, reference: dict[str, tuple[float, float]]
) -> str:
    """The line of a setting; with everything on it becomes the reference of its problem."""
    times = [run.first.time_s if run.first else budget_s for run in runs]
    first = median([run.first.cost if run.first else float("inf") for run in runs])
    last = median([run.cost_at(budget_s) for run in runs])
    if row.what == ALL_ON:
        reference[row.task.name] = first, last
    first_on, last_on = reference.get(row.task.name, (float("nan"), float("nan")))
    return table_row(
        row.task.name,
        row.what,
        f"{sum(bool(run.points) for run in runs)}/{len(runs)}",
        f"{median(times):.2f} s",
        number(first),
        number(first / first_on, ".2f"),
        number(last),
        number(last / last_on, ".3f"),
        yes_or_no(all(run.flawless for run in runs)),
    )
