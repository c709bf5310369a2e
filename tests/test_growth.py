"""Growing the tree through transitions, and two discs that have to come very close to each other."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from arena import arena, visit
from discs import RADIUS, disc_problem, errand

from mrtamp.check import check_plan
from mrtamp.plan import Plan
from mrtamp.planner import Options, Planner
from mrtamp.problem import AtConfiguration, Problem, Subgoal


def meeting(folder: Path, gap: float) -> Problem:
    """Two discs have to stand beside each other at the same instant, `gap` (m) apart."""
    places = {"a": (-RADIUS - gap / 2, 0.0), "b": (RADIUS + gap / 2, 0.0)}
    subgoal = Subgoal("meet", {r: AtConfiguration(np.array(q)) for r, q in places.items()})
    return arena(folder, {"a": (-1, 0), "b": (1, 0)}, subgoals=[subgoal, visit("back", "a", (-1, 0), "meet")])


def first_plan(problem: Problem, iterations: int = 60) -> Plan | None:
    planner = Planner(problem, options=Options(initial_vertices=10))
    return next(planner.improve(iterations=iterations, first=True), None)


@pytest.mark.parametrize("gap", [0.02, 0.002])
def test_discs_that_have_to_meet_closer_than_the_padding_get_a_plan(tmp_path: Path, gap: float) -> None:
    """Padding is for what lies between samples; configurations that are given are checked exactly."""
    plan = first_plan(meeting(tmp_path, gap))
    assert plan is not None
    report = check_plan(plan)
    assert report.ok, str(report)
    ends = {r: q[-1] for r, q in plan.segments[0].q.items()}
    assert np.linalg.norm(ends["a"] - ends["b"]) == pytest.approx(2 * RADIUS + gap)


def test_discs_that_would_overlap_get_none(tmp_path: Path) -> None:
    assert first_plan(meeting(tmp_path, -0.002), iterations=20) is None


def test_a_plan_that_is_adopted_is_in_the_tree_knot_by_knot(tmp_path: Path) -> None:
    """Whatever the plan, the tree then has a goal node of its cost, and traces it back to the same motion."""
    problem = disc_problem(tmp_path)
    plan = errand(problem)
    planner = Planner(problem, options=Options(initial_vertices=10))
    # The start mode is the planner's own: attachments are known by identity.
    own = planner.root.mode
    from dataclasses import replace

    segments = [replace(s, mode=own.replace(*(a for a in s.mode.attachments if a.held or a.support != own.of[a.object].support), done=s.mode.done)) for s in plan.segments]  # noqa: E501
    transitions = plan.transitions
    node = planner.growth.adopt(segments, transitions, planner.root)
    assert node in planner.growth.goal_nodes
    assert node.cost <= plan.cost + 1e-9
    again = planner.growth.adopt(segments, transitions, planner.root)
    assert again is node, "adopting twice adds nothing"
