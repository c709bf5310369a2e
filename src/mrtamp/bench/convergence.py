"""Convergence to known optima: the shipped problems of discs, planned with many seeds, as a table and as a plot.

The optimum of each problem is exact (`mrtamp.timetable`); the plot shows every run, their mean and the optimum (paper,
figure on the 2D environment).  A run happens in a process of its own, so that nothing is warm.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path

from mrtamp.bench.table import header, number, table_row
from mrtamp.problem import MrtampError


@dataclass(frozen=True)
class KnownOptimum:
    """A problem whose optimum is known, the seconds it is given, and how far the mean may then be from the optimum."""

    problem: str
    budget_s: float
    within: float


ROUNDING = 1e-6
"""How far, relative to the optimum, a cost may be below it: robots reach their targets up to a tolerance."""
KNOWN = (
    KnownOptimum("square_sequence", 5.0, 0.002),
    KnownOptimum("square_free", 5.0, 0.002),
    KnownOptimum("planar_passages", 10.0, 0.01),
    KnownOptimum("planar_doorway", 10.0, 0.01),
    KnownOptimum("planar_meetings", 10.0, 0.01),
)


@dataclass(frozen=True)
class Curve:
    """One run: when its incumbents were found (s), and what they cost, both empty when there was no plan."""

    seed: int
    times: tuple[float, ...]
    costs: tuple[float, ...]

    def cost_at(self, time_s: float) -> float:
        """Cost of the incumbent at a time; infinite when there was none yet."""
        return min((c for t, c in zip(self.times, self.costs, strict=True) if t <= time_s), default=math.inf)


def run(problem: str, seed: int, budget_s: float) -> Curve:
    """Plan once, in this process."""
    from mrtamp.planner import Planner
    from mrtamp.problem_file import load_problem

    planner = Planner(load_problem(problem), seed=seed)
    for _ in planner.improve(budget_s):
        pass
    history = planner.best.history if planner.best else []
    return Curve(seed, tuple(h["time_s"] for h in history), tuple(h["cost"] for h in history))


def optimum(problem: str) -> float:
    """The optimal cost of one of the problems `KNOWN`."""
    from mrtamp.problem_file import load_problem
    from mrtamp.timetable import timetable

    return timetable(load_problem(problem)).cost


def convergence(
    seeds: int,
    rows: Sequence[KnownOptimum] = KNOWN,
    say: Callable[[str], None] = print,
    plot: Path | None = None,
) -> bool:
    """Print the table, row by row, and draw the plot; returns whether every row is as near its optimum as it should be.

    Parameters
    ----------
    seeds : number of runs per problem.
    plot : the SVG file to write.
    """
    say(
        header(
            *("problem", "optimum", "success", "first plan, mean", "at the end: mean", "worst", "best", "budget", "aim")
        )
    )
    good = True
    panels = []
    for row in rows:
        best = optimum(row.problem)
        curves = []
        for seed in range(seeds):
            with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
                curves.append(pool.submit(run, row.problem, seed, row.budget_s).result())
        panels.append(Panel(row.problem, best, row.budget_s, tuple(curves)))
        firsts, ends = ([curve.costs[k] / best for curve in curves if curve.costs] or [math.nan] for k in (0, -1))
        mean = sum(ends) / len(ends)
        found = sum(bool(curve.costs) for curve in curves)
        # A plan that costs less than the optimum would mean that one of the two is wrong.
        good &= found == seeds and mean <= 1 + row.within and min(ends) >= 1 - ROUNDING
        cells = [number(sum(firsts) / len(firsts)), *(number(x, ".4f") for x in (mean, max(ends), min(ends)))]
        success = f"{found}/{seeds}"
        say(table_row(row.problem, number(best, ".4f"), success, *cells, f"{row.budget_s:g} s", f"{1 + row.within:g}"))
    say("\nCosts are divided by the optimum.")
    if plot is not None:
        plot.write_text(drawing(panels), encoding="utf-8")
        say(f"wrote {plot}")
    return good


# -- the plot --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Panel:
    """What one diagram shows: the runs of one problem, and its optimum."""

    title: str
    optimum: float
    budget_s: float
    curves: tuple[Curve, ...]


_WIDTH, _HEIGHT = 380, 280
_LEFT, _RIGHT, _TOP, _BOTTOM = 52, 14, 34, 40
_EARLIEST_S = 0.05
_STYLE = (
    "text{font-family:sans-serif;font-size:11px;fill:#333}.t{font-size:13px;font-weight:bold}"
    "path{fill:none}.g{stroke:#e4e4e4}.r{stroke:#7a9cc6;stroke-width:1;opacity:.55}"
    ".m{stroke:#1f4e8c;stroke-width:2.2}.o{stroke:#c0392b;stroke-width:1.6;stroke-dasharray:6 4}"
)


def drawing(panels: Sequence[Panel], most: float = 1.5) -> str:
    """The plot as SVG text: one diagram per panel, cost over time (logarithmic), up to `most` times the optimum.

    Raises
    ------
    MrtampError : there is nothing to draw.
    """
    if not panels:
        raise MrtampError("a convergence plot needs at least one problem")
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH * len(panels)} {_HEIGHT}" '
        f'width="{_WIDTH * len(panels)}" height="{_HEIGHT}"><style>{_STYLE}</style>'
        '<rect width="100%" height="100%" fill="white"/>'
    ]
    for i, panel in enumerate(panels):
        parts.append(f'<g transform="translate({i * _WIDTH} 0)">{_diagram(panel, most)}</g>')
    return "\n".join([*parts, "</svg>\n"])


def _diagram(panel: Panel, most: float) -> str:
    low, high = math.log(_EARLIEST_S), math.log(panel.budget_s)
    least = 1 - 0.06 * (most - 1)

    def x(time_s: float) -> float:
        share = (math.log(min(max(time_s, _EARLIEST_S), panel.budget_s)) - low) / (high - low)
        return _LEFT + share * (_WIDTH - _LEFT - _RIGHT)

    def y(ratio: float) -> float:
        share = (min(ratio, most) - least) / (most - least)
        return _HEIGHT - _BOTTOM - share * (_HEIGHT - _TOP - _BOTTOM)

    def steps(points: Sequence[tuple[float, float]], kind: str) -> str:
        """A curve that stays where it is until the next point."""
        if not points:
            return ""
        path = f"M{x(points[0][0]):.1f} {y(points[0][1]):.1f}"
        for _, (time_s, ratio) in pairwise(points):
            path += f"H{x(time_s):.1f}V{y(ratio):.1f}"
        return f'<path class="{kind}" d="{path}H{x(panel.budget_s):.1f}"/>'

    parts = [f'<text class="t" x="{_LEFT}" y="20">{panel.title}: optimum {panel.optimum:.3f}</text>']
    for k in range(6):
        ratio = 1 + k * (most - 1) / 5
        parts.append(f'<path class="g" d="M{_LEFT} {y(ratio):.1f}H{_WIDTH - _RIGHT}"/>')
        parts.append(f'<text x="{_LEFT - 6}" y="{y(ratio) + 4:.1f}" text-anchor="end">{ratio:.2f}</text>')
    for time_s in (0.1, 0.3, 1, 3, 10, 30, 60, 100, 300, 600):
        if time_s <= panel.budget_s:
            parts.append(f'<path class="g" d="M{x(time_s):.1f} {_TOP}V{_HEIGHT - _BOTTOM}"/>')
            label = f'<text x="{x(time_s):.1f}" y="{_HEIGHT - _BOTTOM + 15}" text-anchor="middle">{time_s:g}</text>'
            parts.append(label)
    parts.append(f'<text x="{(_LEFT + _WIDTH) / 2}" y="{_HEIGHT - 8}" text-anchor="middle">time (s)</text>')
    turned = f'transform="translate(13 {(_HEIGHT - _BOTTOM + _TOP) / 2}) rotate(-90)"'
    parts.append(f'<text {turned} text-anchor="middle">cost / optimum</text>')
    for curve in panel.curves:
        parts.append(steps([(t, c / panel.optimum) for t, c in zip(curve.times, curve.costs, strict=True)], "r"))
    parts.append(steps(mean_curve(panel), "m"))
    parts.append(f'<path class="o" d="M{_LEFT} {y(1.0):.1f}H{_WIDTH - _RIGHT}"/>')
    return "".join(parts)


def mean_curve(panel: Panel) -> list[tuple[float, float]]:
    """Time (s) and mean of cost / optimum over all runs that found a plan, from when all of these had one."""
    found = [curve for curve in panel.curves if curve.times]
    if not found:
        return []
    begin = max(curve.times[0] for curve in found)
    times = sorted({begin, *(t for curve in found for t in curve.times if t > begin)})
    return [(t, sum(c.cost_at(t) for c in found) / len(found) / panel.optimum) for t in times]
