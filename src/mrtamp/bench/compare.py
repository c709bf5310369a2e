"""Two planners on the same runs: ratios of what they needed, pair by pair, with bootstrap intervals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from mrtamp.bench.cells import Column, Table
from mrtamp.bench.records import Record
from mrtamp.bench.statistics import Interval, geometric_mean_ratio
from mrtamp.bench.suite import Suite
from mrtamp.problem import MrtampError
from mrtamp.reading import choices

SEED = 0
"""Of the resampling: the same records give the same intervals."""


@dataclass(frozen=True)
class Measure:
    """Something that is compared: its value in a run, None where the run has none and its pair is left out."""

    title: str
    of: Callable[[Record], float | None]


def time_to_first(record: Record) -> float:
    """Seconds to the first plan; without one the limit, which is the least that it would have been."""
    return record.first.time_s if record.first else record.limit_s


def first_checks(record: Record) -> float | None:
    """Collision checks made before the first plan."""
    return float(record.first_counts["collision_checks"]) if record.first and record.first_counts else None


MEASURES = (
    Measure("T_first", time_to_first),
    Measure("J_first", lambda record: record.first.cost if record.first else None),
    Measure("J_final", lambda record: record.final.cost if record.final else None),
    Measure("checks to first plan", first_checks),
)


@dataclass(frozen=True)
class Comparison:
    """What came of a measure: the interval of the ratio (None: no pair), pairs it is made of, pairs left out."""

    ratio: Interval | None
    pairs: int
    left_out: int


def pairs(records: Sequence[Record], a: str, b: str) -> dict[tuple[str, int | None], list[tuple[Record, Record]]]:
    """Runs of planners `a` and `b` with the same problem, layout and seed, by problem and layout."""
    other = {(r.case, r.layout, r.seed): r for r in records if r.planner == b}
    out: dict[tuple[str, int | None], list[tuple[Record, Record]]] = {}
    for record in records:
        partner = other.get((record.case, record.layout, record.seed))
        if record.planner == a and partner is not None:
            out.setdefault((record.case, record.layout), []).append((record, partner))
    return out


def compared(instances: Sequence[Sequence[tuple[Record, Record]]], measure: Measure) -> Comparison:
    """The ratio of a measure, the first of each pair over the second; one list of pairs per problem and layout."""
    ratios: list[list[float]] = []
    total = 0
    for instance in instances:
        values = [(measure.of(one), measure.of(two)) for one, two in instance]
        total += len(values)
        ratios.append([x / y for x, y in values if x is not None and y is not None and x > 0 and y > 0])
    used = sum(len(group) for group in ratios)
    return Comparison(geometric_mean_ratio(ratios, np.random.default_rng(SEED)), used, total - used)


def comparison(suite: Suite, records: Sequence[Record], a: str, b: str) -> Table:
    """The table of `mrtamp bench compare`: a row per problem, and one for all of them.

    Raises
    ------
    MrtampError : a label is unknown, both are the same, or no run of one has its partner.
    """
    labels = [entrant.label for entrant in suite.entrants]
    for label in (a, b):
        if label not in labels:
            raise MrtampError(
                f"{suite.name}: found the unknown planner {label!r}, {choices(labels, label, 'planners')}"
            )
    if a == b:
        raise MrtampError(f"found {a!r} twice, expected two different planners of: {', '.join(labels)}")
    by_instance = pairs(records, a, b)
    if not by_instance:
        raise MrtampError(f"{suite.name}: no problem was planned by both {a!r} and {b!r} with the same seed yet")
    rows = []
    names = [case.name for case in suite.cases]
    for name in [*names, None]:
        instances = [found for (case, _), found in by_instance.items() if name in (case, None)]
        if not instances or (name is None and len({case for case, _ in by_instance}) == 1):
            continue
        found = [compared(instances, measure) for measure in MEASURES]
        solved = [sum(r.first is not None for pair in instances for r in [p[side] for p in pair]) for side in (0, 1)]
        cells = [(c.ratio, f"{c.pairs}/{c.pairs + c.left_out}") for c in found]
        row = (name or "all", len(instances), f"{solved[0]}, {solved[1]}", *(x for cell in cells for x in cell))
        rows.append(row)
    columns = [Column("problem", text=True), Column("instances"), Column("runs with a plan")]
    for measure in MEASURES:
        columns += [Column(measure.title, "down"), Column("pairs")]
    return Table(
        label="comparison",
        caption=f"{a} divided by {b}: geometric means of ratios of runs with the same problem, layout and seed",
        columns=tuple(columns),
        rows=tuple(rows),
        rules=frozenset({len(rows) - 1} if len(rows) > 1 else ()),
        notes=NOTES,
    )


NOTES = (
    "Below 1 the first planner needs less. In brackets 95 % bootstrap intervals of the geometric mean (percentiles "
    "expanded for small numbers; where there are several instances, these are resampled, each with all its runs, else "
    "runs; from less than five of them intervals are too narrow all the same). In T_first a run without a plan counts "
    "as its limit, so that the true ratio is farther from 1, and a pair without any plan as equal. Costs and checks "
    "are compared where both runs have a plan; `pairs` says how many these are, and they are the easier ones."
)
