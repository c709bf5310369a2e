"""Every mechanism can be switched off by name; what is left plans all the same, and its plans are judged."""

from __future__ import annotations

from pathlib import Path

import pytest
from arena import arena, visit, wall

from mrtamp.check import check_plan
from mrtamp.mechanisms import MECHANISMS
from mrtamp.planner import Options, Planner
from mrtamp.problem import MrtampError, Problem
from mrtamp.tasks import pick_place


def swap(folder: Path) -> Problem:
    """Two discs pass each other at a pillar, with one visit each."""
    subgoals = [visit("one", "a", (1.0, 0.4)), visit("two", "b", (-1.0, -0.4), "one")]
    starts = {"a": (-1.0, 0.4), "b": (1.0, -0.4)}
    return arena(
        folder, starts, {"a": (-1.0, 0.4)}, subgoals=subgoals, walls=[wall("pillar", (-0.1, -0.1), (0.1, 0.1))]
    )


@pytest.mark.parametrize("name", list(MECHANISMS))
@pytest.mark.parametrize("scene", ["discs", "arms"])
def test_without_any_one_mechanism_there_are_plans_that_the_judge_accepts(
    tmp_path: Path, name: str, scene: str
) -> None:
    problem = swap(tmp_path) if scene == "discs" else pick_place(2, 2)
    planner = Planner(problem, options=Options(without=frozenset({name}), initial_vertices=20))
    plans = list(planner.improve(20.0, first=True))
    plans += list(planner.improve(iterations=6))
    assert plans and check_plan(plans[-1]).ok
    costs = [p.cost for p in plans]
    assert costs == sorted(costs, reverse=True)
    if name in ("refinement", "skeletons"):
        assert planner._effort.total[name] == 0.0


def test_nothing_but_the_bare_search_plans_too(tmp_path: Path) -> None:
    planner = Planner(swap(tmp_path), options=Options(without=frozenset(MECHANISMS), initial_vertices=20))
    plans = list(planner.improve(20.0, first=True))
    assert plans and check_plan(plans[-1]).ok


def test_unknown_names_are_an_error_that_lists_the_known_ones() -> None:
    with pytest.raises(MrtampError, match=r"without.*'?luck.*choose from.*modal-guidance"):
        Options(without=frozenset({"luck", "sliding"}))
    with pytest.raises(MrtampError, match=r"intra_orbit: 'magic'.*tensor-tree.*prioritised"):
        Options(intra_orbit="magic")
    with pytest.raises(TypeError):
        Options(refinements=0)  # type: ignore[call-arg]
