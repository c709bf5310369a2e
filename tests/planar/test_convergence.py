"""The planner on problems with known optima, in short, and the plot of its convergence."""

from __future__ import annotations

from xml.etree import ElementTree

import pytest

from mrtamp.bench.convergence import (
    KNOWN,
    ROUNDING,
    Curve,
    KnownOptimum,
    Panel,
    convergence,
    drawing,
    mean_curve,
    optimum,
)
from mrtamp.planner import Planner
from mrtamp.problem_file import load_problem


@pytest.mark.parametrize("row", KNOWN, ids=lambda row: row.problem)
def test_planner_comes_near_the_optimum_and_never_below(row: KnownOptimum):
    """Stops as soon as it is near enough: the budget is for slow machines."""
    best = optimum(row.problem)
    planner = Planner(load_problem(row.problem), seed=0)
    for plan in planner.improve(20.0):
        assert plan.cost >= best * (1 - ROUNDING)
        if plan.cost <= best * (1 + 2 * row.within):
            break
    assert planner.best is not None
    assert planner.best.cost <= best * (1 + 2 * row.within)


def panel() -> Panel:
    curves = (Curve(0, (0.1, 1.0), (15.0, 11.0)), Curve(1, (0.5, 2.0), (13.0, 10.0)), Curve(2, (), ()))
    return Panel("example", 10.0, 10.0, curves)


def test_mean_begins_when_every_run_has_a_plan():
    assert mean_curve(panel()) == [(0.5, 1.4), (1.0, 1.2), (2.0, 1.05)]
    assert mean_curve(Panel("none", 10.0, 10.0, (Curve(0, (), ()),))) == []


def test_cost_of_a_run_between_its_incumbents():
    curve = panel().curves[0]
    assert [curve.cost_at(t) for t in (0.05, 0.1, 0.9, 1.0, 5.0)] == [float("inf"), 15.0, 15.0, 11.0, 11.0]


def test_plot_draws_every_run_the_mean_and_the_optimum():
    root = ElementTree.fromstring(drawing([panel(), panel()]))
    kinds = [e.get("class") for e in root.iter("{http://www.w3.org/2000/svg}path")]
    assert (kinds.count("r"), kinds.count("m"), kinds.count("o")) == (4, 2, 2)
    titles = [e.text for e in root.iter("{http://www.w3.org/2000/svg}text") if e.get("class") == "t"]
    assert titles == ["example: optimum 10.000"] * 2


def test_table_has_a_row_per_problem_and_its_plot(tmp_path):
    said: list[str] = []
    row = KnownOptimum("square_free", 0.5, 0.5)
    assert convergence(1, [row], said.append, tmp_path / "plot.svg")
    assert "| square_free | 4.0600 | 1/1 |" in "\n".join(said)
    assert "square_free: optimum 4.060" in (tmp_path / "plot.svg").read_text()
