"""The figures of a report: cost over time, success over time, scaling with robots and objects.

Colours are those of Okabe and Ito, which people with every kind of colour vision tell apart; markers and dashes differ
with them, so that the figures are good in black and white too.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mrtamp.bench.compare import first_checks, time_to_first
from mrtamp.bench.convergence import optimum
from mrtamp.bench.records import Record
from mrtamp.bench.statistics import CONFIDENCE, median_band
from mrtamp.bench.suite import Case, Entrant, Suite
from mrtamp.bench.summary import grouped, title

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#999999")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
DASHES = ("-", "--", "-.", ":", (0, (5, 1)), (0, (3, 1, 1, 1)), (0, (1, 1)), (0, (7, 2, 1, 2)))
FORMATS = ("svg", "png")
_PANEL, _ACROSS = (3.7, 2.8), 4
"""Width and height of a diagram (inches), diagrams in a row."""
_MARGIN = 1.05
"""Around what is drawn on a logarithmic axis: without it a constant cost would leave no room for itself."""
_OPTIMUM = "known optimum"
_MOMENTS = 200
_EARLIEST_S = 0.1
_INCHES_PER_LETTER = 0.075
_SEED = 0


def draw(suite: Suite, records: Sequence[Record], folder: Path) -> list[Path]:
    """Draw every figure that the records have something for, as SVG and PNG; returns the files (PNG)."""
    folder.mkdir(parents=True, exist_ok=True)
    made = []
    for name, figure in _figures(suite, records):
        for ending in FORMATS:
            # Without dates and random names equal records make equal files.
            metadata = {"Date": None} if ending == "svg" else None
            figure.savefig(folder / f"{name}.{ending}", dpi=150, metadata=metadata)
        made.append(folder / f"{name}.png")
    return made


def _figures(suite: Suite, records: Sequence[Record]) -> Iterator[tuple[str, Any]]:
    import matplotlib as mpl

    with mpl.rc_context(
        {
            "svg.hashsalt": "mrtamp",
            "font.size": 9,
            "axes.spines.top": False,
            "axes.spines.right": False,
            "axes.grid": True,
            "grid.color": "#e6e6e6",
            "legend.frameon": False,
        }
    ):
        for name, make in (
            ("cost_over_time", cost_over_time),
            ("success_over_time", success_over_time),
            ("scaling_time", scaling_time),
            ("scaling_checks", scaling_checks),
        ):
            figure = make(suite, records)
            if figure is not None:
                yield name, figure


# -- over time -------------------------------------------------------------------------------------------------------


def cost_over_time(suite: Suite, records: Sequence[Record]) -> Any:
    """A diagram per problem: the median cost of each planner over time, and its bootstrap band.

    Runs without a plan count as infinite.  A curve begins when more than half of the runs have a plan; its band is
    drawn from where its upper end is finite.
    """
    groups = grouped(records)
    cases = [c for c in suite.cases if any(_mostly(groups.get((c.name, e.label), ())) for e in suite.entrants)]
    if not cases:
        return None
    figure, axes = _grid(len(cases))
    for axis, case in zip(axes, cases, strict=True):
        moments = _moments(case, records)
        shown = []
        for i, entrant in _styled(suite):
            runs = groups.get((case.name, entrant.label), ())
            if not _mostly(runs):
                continue
            values = np.array([[run.cost_at(t) for t in moments] for run in runs])
            band = median_band(values, np.random.default_rng(_SEED))
            there = np.isfinite(band.median)
            axis.plot(moments[there], band.median[there], label=entrant.label, **_style(i))
            whole = there & np.isfinite(band.high)
            shown += [*band.median[there], *band.low[whole], *band.high[whole]]
            if len(runs) > 1:
                axis.fill_between(
                    moments[whole], band.low[whole], band.high[whole], color=_color(i), alpha=0.18, lw=0, step="post"
                )
        if suite.table == "optimum":
            shown.append(optimum(case.problem))
            axis.axhline(shown[-1], color="#444444", lw=1, ls=(0, (1, 2)), label=_OPTIMUM)
        _time_axis(axis, case, moments)
        axis.set_yscale("log")
        axis.set_ylim(min(shown) / _MARGIN, max(shown) * _MARGIN)
        _plain_ticks(axis.yaxis)
        axis.set_ylabel("cost")
    text = (
        "cost in rad (joints that slide: m): "
        f"median of all runs and its {CONFIDENCE:.0%} bootstrap interval; a run without a plan counts as infinite"
    )
    return _finished(figure, axes, suite, text)


def _mostly(runs: Sequence[Record]) -> bool:
    """Whether more than half of the runs have a plan."""
    return 2 * sum(run.first is not None for run in runs) > len(runs)


def success_over_time(suite: Suite, records: Sequence[Record]) -> Any:
    """A diagram per problem: the share of runs that have a plan, over time."""
    cases = [case for case in suite.cases if any(r.case == case.name for r in records)]
    if not cases:
        return None
    figure, axes = _grid(len(cases))
    groups = grouped(records)
    for axis, case in zip(axes, cases, strict=True):
        moments = _moments(case, records)
        for i, entrant in _styled(suite):
            runs = groups.get((case.name, entrant.label), ())
            if runs:
                shares = [100 * sum(math.isfinite(run.cost_at(t)) for run in runs) / len(runs) for t in moments]
                axis.plot(moments, shares, label=entrant.label, **_style(i))
        _time_axis(axis, case, moments)
        axis.set_ylim(-4, 104)
        axis.set_ylabel("runs with a plan (%)")
    return _finished(figure, axes, suite, "")


def _moments(case: Case, records: Sequence[Record]) -> np.ndarray:
    """Moments (s) from a little before the first plan of all to the limit, evenly on a logarithmic axis."""
    firsts = [r.first.time_s for r in records if r.case == case.name and r.first]
    begin = max(min([*firsts, case.limit_s / 10]) / 1.5, _EARLIEST_S / 10)
    return np.geomspace(begin, case.limit_s, _MOMENTS)


def _time_axis(axis: Any, case: Case, moments: np.ndarray) -> None:
    axis.set_title(title(case), fontsize=9.5)
    axis.set_xscale("log")
    axis.set_xlabel("time (s)")
    axis.set_xlim(moments[0], moments[-1])
    _plain_ticks(axis.xaxis)


# -- scaling ---------------------------------------------------------------------------------------------------------


def scaling_time(suite: Suite, records: Sequence[Record]) -> Any:
    """Time to the first plan over the number of objects and of robots."""
    return _scaling(suite, records, time_to_first, "time to first plan (s)")


def scaling_checks(suite: Suite, records: Sequence[Record]) -> Any:
    """Collision checks before the first plan over the number of objects and of robots."""
    return _scaling(suite, records, first_checks, "collision checks to first plan")


def _scaling(suite: Suite, records: Sequence[Record], measure: Callable[[Record], float | None], label: str) -> Any:
    """A diagram per number of robots (objects on the axis) and per number of objects (robots on the axis)."""
    planned = {record.case for record in records}
    cases = [case for case in suite.cases if case.name in planned]
    panels = [*_panels(cases, "robots", "objects"), *_panels(cases, "objects", "robots")]
    if not panels or not any(run.first for run in records):
        return None
    figure, axes = _grid(len(panels), sharey=True)
    groups = grouped(records)
    for axis, (name, across, cases) in zip(axes, panels, strict=True):
        for i, entrant in _styled(suite):
            runs = [(case.parameters[across], groups.get((case.name, entrant.label), ())) for case in cases]
            _scaling_curve(axis, runs, measure, i, 1.02 ** (i - (len(suite.entrants) - 1) / 2), entrant.label)
        axis.set_title(name, fontsize=9.5)
        axis.set_xscale("log")
        axis.set_yscale("log")
        axis.set_xlabel(f"number of {across}")
        numbers = sorted({case.parameters[across] for case in cases})
        axis.set_xticks(numbers, [str(n) for n in numbers])
        axis.xaxis.set_minor_locator(_no_ticks())
        if axis.get_subplotspec().is_first_col():
            axis.set_ylabel(label)
        axis.xaxis.set_tick_params(labelbottom=True)
        _plain_ticks(axis.yaxis)
    text = "median, least and most of the runs with a plan"
    if measure is time_to_first:
        text = "median, least and most of all runs; a run without a plan counts as its limit, hollow: half have none"
    return _finished(figure, axes, suite, text)


def _panels(cases: Sequence[Case], fixed: str, across: str) -> Iterator[tuple[str, str, list[Case]]]:
    """For every number of what is `fixed` that comes with several numbers of what goes `across`: title, axis, cases."""
    cases = [case for case in cases if {fixed, across} <= set(case.parameters)]
    for number in sorted({case.parameters[fixed] for case in cases}):
        row = sorted((c for c in cases if c.parameters[fixed] == number), key=lambda c: c.parameters[across])
        if len({case.parameters[across] for case in row}) > 1:
            yield f"{number} {fixed}", across, row


def _scaling_curve(
    axis: Any,
    runs: Sequence[tuple[int, Sequence[Record]]],
    measure: Callable[[Record], float | None],
    i: int,
    aside: float,
    label: str,
) -> None:
    """One planner in one diagram; moved `aside` by a factor, or bars of several planners would hide each other."""
    points = []
    for number, found in runs:
        values = [value for run in found if (value := measure(run)) is not None]
        if values:
            half = 2 * sum(run.first is not None for run in found) <= len(found)
            points.append((number, float(np.median(values)), min(values), max(values), half))
    if not points:
        return
    x = np.array([p[0] for p in points]) * aside
    y, low, high = (np.array([p[k] for p in points]) for k in (1, 2, 3))
    axis.errorbar(x, y, yerr=[y - low, high - y], color=_color(i), lw=1.2, ls=_dashes(i), capsize=2)
    axis.plot([], [], label=label, color=_color(i), marker=MARKERS[i % len(MARKERS)], ls=_dashes(i))
    for at, value, (*_, hollow) in zip(x, y, points, strict=True):
        face = "white" if hollow else _color(i)
        axis.plot([at], [value], marker=MARKERS[i % len(MARKERS)], color=_color(i), mfc=face, ms=5, ls="none", zorder=5)


# -- what figures have in common -------------------------------------------------------------------------------------


def _styled(suite: Suite) -> list[tuple[int, Entrant]]:
    """The planners with the numbers of their styles: the planner of this project has the first in every suite."""
    entrants = sorted(suite.entrants, key=lambda e: (e.planner, e.without, e.intra_orbit) != ("guided", (), None))
    return [(entrants.index(entrant), entrant) for entrant in suite.entrants]


def _color(i: int) -> str:
    return COLORS[i % len(COLORS)]


def _dashes(i: int) -> Any:
    """With more planners than colours the same colour comes with other dashes."""
    return DASHES[(i + i // len(COLORS)) % len(DASHES)]


def _style(i: int) -> dict[str, Any]:
    return {"color": _color(i), "ls": _dashes(i), "lw": 1.8, "drawstyle": "steps-post"}


def _grid(count: int, sharey: bool = False) -> tuple[Any, list[Any]]:
    """A figure with so many diagrams."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    down = math.ceil(count / _ACROSS)
    across = math.ceil(count / down)
    # Not pyplot: it would keep every figure, and look for a screen.
    figure = Figure(figsize=(_PANEL[0] * across, _PANEL[1] * down), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(down, across, squeeze=False, sharey=sharey).ravel().tolist()
    for axis in axes[count:]:
        axis.remove()
    return figure, axes[:count]


def _finished(figure: Any, axes: Sequence[Any], suite: Suite, text: str) -> Any:
    """The figure with one legend for all diagrams, and what is drawn in words."""
    known: dict[str, Any] = {}
    for axis in axes:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            known.setdefault(label, handle)
    order = [label for label in (*(entrant.label for entrant in suite.entrants), _OPTIMUM) if label in known]
    # As many as fit side by side, labels being as long as they are.
    widest = _INCHES_PER_LETTER * max(len(label) for label in order) + 0.6
    ncols = max(1, min(len(order), int(figure.get_figwidth() / widest)))
    figure.legend([known[label] for label in order], order, loc="outside upper center", ncols=ncols)
    if text:
        lines = textwrap.wrap(text, int(figure.get_figwidth() / _INCHES_PER_LETTER))
        figure.supxlabel("\n".join(lines), fontsize=8, color="#555555")
    return figure


def _plain_ticks(axis: Any) -> None:
    """1, 2, 5, 10 in place of powers of ten; even steps where the axis is less than a decade."""
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator

    low, high = axis.get_view_interval()
    few = high < 8 * low
    axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]) if few else LogLocator(subs=(1, 2, 5), numticks=8))
    axis.set_major_formatter(FuncFormatter(_short))
    axis.set_minor_locator(_no_ticks())


def _short(value: float, position: int | None = None) -> str:
    """A number at a tick."""
    if value >= 1e6:
        return f"{value / 1e6:g}M"
    return f"{value / 1e3:g}k" if value >= 1e4 else f"{value:g}"


def _no_ticks() -> Any:
    from matplotlib.ticker import NullLocator

    return NullLocator()
