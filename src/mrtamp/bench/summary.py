"""The tables of a report, in the forms of the paper, from the records of a suite."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from mrtamp.bench.cells import Cell, Column, Share, Table
from mrtamp.bench.compare import MEASURES, compared, first_checks, pairs
from mrtamp.bench.convergence import optimum
from mrtamp.bench.records import Record
from mrtamp.bench.statistics import summarise
from mrtamp.bench.suite import Case, Entrant, Suite

Groups = Mapping[tuple[str, str], Sequence[Record]]
"""Records by problem and planner."""

_MEANS = (
    "SR is the share of runs with a plan within the limit, T_first the time to the first plan, J_first its cost and "
    "J_final the cost of the best; mean ± sample standard deviation over the runs with a plan, which are the easier "
    "ones where there are others."
)


def grouped(records: Sequence[Record]) -> Groups:
    """Records by problem and planner."""
    out: dict[tuple[str, str], list[Record]] = {}
    for record in records:
        out.setdefault((record.case, record.planner), []).append(record)
    return out


def title(case: Case) -> str:
    """How a problem is called in tables and figures."""
    return case.title or case.name


# -- cells -----------------------------------------------------------------------------------------------------------


def success(runs: Sequence[Record]) -> Cell:
    """Runs with a plan."""
    return Share(sum(run.first is not None for run in runs), len(runs)) if runs else None


def first_time(runs: Sequence[Record]) -> Cell:
    """Seconds to the first plan."""
    return summarise([run.first.time_s for run in runs if run.first])


def first_cost(runs: Sequence[Record]) -> Cell:
    """Cost of the first plan."""
    return summarise([run.first.cost for run in runs if run.first])


def final_cost(runs: Sequence[Record]) -> Cell:
    """Cost of the best plan."""
    return summarise([run.final.cost for run in runs if run.final])


_SR, _T = Column("SR", "up"), Column("T_first (s)", "down")
_JF, _J = Column("J_first", "down"), Column("J_final", "down")
Measured = Callable[[Sequence[Record]], Cell]
_FOUR: tuple[Measured, ...] = (success, first_time, first_cost, final_cost)
_THREE: tuple[Measured, ...] = (success, first_time, final_cost)


# -- tables ----------------------------------------------------------------------------------------------------------


def main_table(suite: Suite, records: Sequence[Record]) -> Table:
    """A row per planner, four columns per problem (the paper's table on three tasks)."""
    groups = grouped(records)
    return Table(
        label=suite.name,
        caption=_caption(suite),
        columns=(Column("Method", text=True), *((_SR, _T, _JF, _J) * len(suite.cases))),
        groups=(("", 1), *((title(case), 4) for case in suite.cases)),
        rows=tuple(
            (
                entrant.label,
                *(cell(groups.get((case.name, entrant.label), ())) for case in suite.cases for cell in _FOUR),
            )
            for entrant in suite.entrants
        ),
        notes=_notes(suite),
    )


def scalability_table(suite: Suite, records: Sequence[Record]) -> Table:
    """A row per number of robots and objects, three columns per planner (the paper's table on scalability)."""
    groups = grouped(records)
    numbers = [(case.parameters["robots"], case.parameters["objects"]) for case in suite.cases]
    return Table(
        label=suite.name,
        caption=_caption(suite),
        columns=(Column("Robots"), Column("Objects"), *((_SR, _T, _J) * len(suite.entrants))),
        groups=(("", 2), *((entrant.label, 3) for entrant in suite.entrants)),
        rows=tuple(
            (*pair, *(cell(groups.get((case.name, e.label), ())) for e in suite.entrants for cell in _THREE))
            for case, pair in zip(suite.cases, numbers, strict=True)
        ),
        rules=frozenset(i for i in range(1, len(numbers)) if numbers[i][0] != numbers[i - 1][0]),
        bars=True,
        notes=_notes(suite),
    )


def ablation_table(suite: Suite, records: Sequence[Record]) -> Table:
    """A row per problem and planner; ratios are to the first planner of the suite, on the same layouts and seeds."""
    reference = suite.entrants[0].label

    def cells(runs: Sequence[Record], case: Case, entrant: Entrant) -> tuple[Cell, ...]:
        ratios: list[Cell] = [None] * 3
        if entrant.label != reference:
            both = [found for (name, _), found in pairs(records, entrant.label, reference).items() if name == case.name]
            ratios = [compared(both, measure).ratio for measure in MEASURES[:3]]
        means = [measured(runs) for measured in (first_time, first_cost, final_cost)]
        return success(runs), *(cell for pair in zip(means, ratios, strict=True) for cell in pair)

    columns = [_SR, _T, Column("ratio"), _JF, Column("ratio"), _J, Column("ratio")]
    return _by_problem(
        suite,
        records,
        columns,
        cells,
        f" Ratios are the planner of the row divided by {reference!r}: geometric means over pairs of runs with the "
        "same problem, layout and seed, and 95 % bootstrap intervals; a run without a plan counts as its limit in "
        "T_first, and its pair is left out of costs.",
    )


def optimum_table(suite: Suite, records: Sequence[Record]) -> Table:
    """A row per problem and planner, costs divided by the exact optimum of the problem."""
    best = {case.name: optimum(case.problem) for case in suite.cases}

    def cells(runs: Sequence[Record], case: Case, entrant: Entrant) -> tuple[Cell, ...]:
        firsts = [run.first.cost / best[case.name] for run in runs if run.first]
        ends = [run.final.cost / best[case.name] for run in runs if run.final]
        worst, least = (f"{f(ends):.4f}" if ends else None for f in (max, min))
        mean = f"{math.fsum(ends) / len(ends):.4f}" if ends else None
        return f"{best[case.name]:.4f}", success(runs), first_time(runs), summarise(firsts), mean, worst, least

    columns = [Column("optimum"), _SR, _T, Column("J_first / optimum", "down"), Column("J_final / optimum", "down")]
    return _by_problem(suite, records, [*columns, Column("worst"), Column("best")], cells, "")


def everything_table(suite: Suite, records: Sequence[Record]) -> Table:
    """A row per problem and planner that have run, with all that does not fit into the tables of the paper."""
    groups = grouped(records)
    suite = replace(suite, cases=tuple(c for c in suite.cases if any(c.name == name for name, _ in groups)))

    def cells(runs: Sequence[Record], case: Case, entrant: Entrant) -> tuple[Cell, ...]:
        checks = [n for run in runs if (n := first_checks(run)) is not None]
        calls = [float(run.first_counts["ik_calls"]) for run in runs if run.first and run.first_counts]
        peaks = [run.peak_mb for run in runs if run.peak_mb is not None]
        return (
            success(runs),
            first_time(runs),
            first_cost(runs),
            final_cost(runs),
            summarise([n / 1000 for n in checks]),
            summarise([n / 1000 for n in calls]),
            f"{max(peaks):.0f}" if peaks else None,
        )

    columns = [_SR, _T, _JF, _J, Column("checks (1000)", "down"), Column("IK calls (1000)", "down")]
    table = _by_problem(suite, records, [*columns, Column("peak memory (MB)", "down")], cells, "")
    return Table(
        label=f"{suite.name}-everything",
        caption="Every problem and planner; collision checks and IK calls are those before the first plan.",
        columns=table.columns,
        rows=table.rows,
        rules=table.rules,
        notes="Checks and calls do not depend on the machine: configurations asked of the collision checker, and "
        "seeds projected by inverse kinematics. Means and deviations as in the table above, of the runs with a plan; "
        "peak memory is the most of all runs.",
    )


FORMS: dict[str, Callable[[Suite, Sequence[Record]], Table]] = {
    "main": main_table,
    "scalability": scalability_table,
    "ablation": ablation_table,
    "optimum": optimum_table,
}


def suite_table(suite: Suite, records: Sequence[Record]) -> Table:
    """The table in the form that the suite asks for."""
    return FORMS[suite.table](suite, records)


def _by_problem(
    suite: Suite,
    records: Sequence[Record],
    columns: Sequence[Column],
    cells: Callable[[Sequence[Record], Case, Entrant], tuple[Cell, ...]],
    more: str,
) -> Table:
    groups = grouped(records)
    rows: list[tuple[Cell, ...]] = []
    rules = []
    for case in suite.cases:
        rules.append(len(rows))
        for entrant in suite.entrants:
            runs = groups.get((case.name, entrant.label), ())
            rows.append((title(case), entrant.label, *cells(runs, case, entrant)))
    return Table(
        label=suite.name,
        caption=_caption(suite),
        columns=(Column("problem", text=True), Column("planner", text=True), *columns),
        rows=tuple(rows),
        rules=frozenset(rules[1:]),
        notes=_notes(suite) + more,
    )


def _caption(suite: Suite) -> str:
    return " ".join(suite.description.split()) or suite.name


def _notes(suite: Suite) -> str:
    limits = sorted({case.limit_s for case in suite.cases})
    if len(limits) == 1:
        text = f"{limits[0]:g} s per run"
    else:
        by_limit = [f"{t:g} s ({', '.join(title(c) for c in suite.cases if c.limit_s == t)})" for t in limits]
        text = "limits per run " + ", ".join(by_limit)
    layouts = {len(case.layouts) for case in suite.cases if len(case.layouts) > 1}
    more = f", {' or '.join(str(n) for n in sorted(layouts))} layouts per generated problem" if layouts else ""
    seeds = "1 planner seed" if len(suite.seeds) == 1 else f"{len(suite.seeds)} planner seeds"
    return f"{_MEANS} {seeds}{more}; {text}, preparation included."
