"""The report of a suite, from its raw records alone: Markdown, LaTeX, CSV and figures, written beside them."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Sequence
from pathlib import Path

from mrtamp.bench.cells import PREAMBLE, Table, comma_separated, latex, markdown, plain, table_csv
from mrtamp.bench.compare import comparison, pairs
from mrtamp.bench.figures import draw
from mrtamp.bench.machine import machines_text
from mrtamp.bench.records import Record, read_records
from mrtamp.bench.suite import Suite
from mrtamp.bench.summary import everything_table, suite_table

FIGURES = "figures"
_NARROW = ("ablation", "optimum")
"""Forms of tables that a terminal has room for."""
_BUSY = 0.9
"""Share of the time on the clock that a run with one thread computes, if it has a core for itself."""
_CAPTIONS = {
    "cost_over_time": "Cost over time: the median over all runs, a run without a plan counting as infinite; a curve "
    "begins when more than half of the runs have a plan. Bands are 95 % bootstrap percentile intervals of the median, "
    "drawn from where their upper end is finite.",
    "success_over_time": "Runs that have a plan, over time.",
    "scaling_time": "Time to the first plan over numbers of objects and robots: median, least and most of all runs. A "
    "run without a plan counts as its limit; hollow where at least half of them have none.",
    "scaling_checks": "Collision checks before the first plan: median, least and most of the runs with a plan.",
}


def report(folder: Path) -> tuple[str, list[Path]]:
    """Write everything anew into the folder of the records; returns what a terminal shows of it, and the files.

    Raises
    ------
    MrtampError : there are no records, or they are not what they should be.
    """
    suite, records = read_records(folder)
    table, everything = suite_table(suite, records), everything_table(suite, records)
    figures = draw(suite, records, folder / FIGURES)
    texts = {
        "report.md": report_text(suite, records, [table, everything, *_comparisons(suite, records)], figures),
        "tables.tex": "\n".join([PREAMBLE, latex(table), latex(everything)]),
        "table.csv": table_csv(table),
        "everything.csv": table_csv(everything),
        "runs.csv": runs_csv(records),
    }
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    shown = table if suite.table in _NARROW else everything
    return printed(suite, shown, table.notes), [*(folder / name for name in texts), *figures]


def _comparisons(suite: Suite, records: Sequence[Record]) -> list[Table]:
    """The last planner of the suite against each of the others, where they have planned the same."""
    last = suite.entrants[-1].label
    others = [entrant.label for entrant in suite.entrants[:-1] if pairs(records, entrant.label, last)]
    return [comparison(suite, records, label, last) for label in others] if suite.table not in _NARROW else []


def report_text(suite: Suite, records: Sequence[Record], tables: Sequence[Table], figures: Sequence[Path]) -> str:
    """The report in Markdown."""
    planned = sum(1 for _ in suite.assignments())
    machines = machines_text(r.machine for r in records if r.machine is not None)
    parts = [
        f"# {suite.name}",
        " ".join(suite.description.split()),
        f"{len(records)} of {planned} runs, each in a process of its own and with one thread.",
        "\n".join(f"- {line}" for line in machines.splitlines()),
        *(markdown(table) for table in tables),
        *(f"![{name.stem}]({FIGURES}/{name.name})\n\n{_CAPTIONS[name.stem]}" for name in figures),
        "## The harness",
        overhead_text(records),
        trouble_text(records),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def overhead_text(records: Sequence[Record]) -> str:
    """What measuring cost."""
    times = [record.times for record in records if record.times is not None]
    if not times:
        return "No run came to its end."
    wall = sum(t.wall for t in times)

    def part(values: Iterable[float]) -> str:
        total = sum(values)
        return f"{100 * total / wall:.1f} % ({total / len(times):.2f} s per run)"

    late = [max(r.times.planning - r.limit_s, 0.0) for r in records if r.times is not None]
    busy = sum(t.cpu for t in times) / wall
    planning, starting = part(t.planning for t in times), part(t.start for t in times)
    judging, harness = part(t.judging for t in times), part(t.harness for t in times)
    return (
        f"Of the time of the runs, {planning} went into planning, {starting} into starting processes and loading, "
        f"{judging} into saving, loading and judging the first and the cheapest plan, and {harness} into the harness. "
        f"Planners went on after their limit for {statistics.mean(late):.2f} s in the mean, {max(late):.2f} s at most; "
        f"plans found then do not count. Processor time was {100 * busy:.0f} % of the time on the clock"
        + (
            ": the machine was busy with other things, and times are longer than they would be."
            if busy < _BUSY
            else "."
        )
    )


def trouble_text(records: Sequence[Record]) -> str:
    """Runs in which something was wrong, as a list; nothing where nothing was."""
    lines = []
    for record in records:
        lines += [f"- {record.key}: {record.error.splitlines()[-1]}"] if record.error else []
        lines += [f"- {record.key}: refused by the judge: {text}" for text in record.refused]
    if not lines:
        return ""
    return "\n".join(["## What went wrong", "", "These runs count as runs without a plan.", "", *lines])


def runs_csv(records: Sequence[Record]) -> str:
    """One line per run."""
    lines: list[list[object]] = [
        [
            *("problem", "robots", "objects", "layout_seed", "planner", "seed", "limit_s"),
            *("first_s", "first_cost", "final_cost", "final_makespan", "final_path_length", "plans"),
            *("first_collision_checks", "first_ik_calls", "collision_checks", "ik_calls"),
            *("wall_s", "cpu_s", "start_s", "planning_s", "judging_s", "harness_s", "peak_mb", "refused", "error"),
        ]
    ]
    for r in records:
        first, final, times = r.first, r.final, r.times
        lines.append(
            [
                *(r.case, r.parameters.get("robots"), r.parameters.get("objects"), r.layout, r.planner, r.seed),
                *(r.limit_s, first.time_s if first else None, first.cost if first else None),
                *((final.cost, final.makespan, final.path_length) if final else (None,) * 3),
                *(len(r.curve), r.first_counts.get("collision_checks"), r.first_counts.get("ik_calls")),
                *(r.counts.get("collision_checks"), r.counts.get("ik_calls")),
                *((times.wall, times.cpu, times.start, times.planning) if times else (None,) * 4),
                *((times.judging, times.harness) if times else (None,) * 2),
                *(r.peak_mb, len(r.refused), r.error.splitlines()[-1] if r.error else None),
            ]
        )
    return comma_separated(lines)


def printed(suite: Suite, table: Table, notes: str) -> str:
    """A table for a terminal."""
    return f"{suite.name}: {table.caption}\n\n{plain(table)}\n\n{notes}"
