"""Growing the tree through transitions, and two discs that have to come very close to each other."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from arena import arena, visit, wall
from discs import RADIUS, Errands

from mrtamp.check import check_plan
from mrtamp.check_report import Report, Side, Violation
from mrtamp.plan import Plan
from mrtamp.planner import Options, Planner
from mrtamp.problem import AtConfiguration, Problem, Subgoal
from mrtamp.space_time import SpaceTime


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
    """The tree then has a goal node of the plan's cost, and traces it back to the very same motion."""
    subgoals = [visit("one", "a", (0, 1)), visit("two", "b", (0, -1), "one")]
    problem = arena(tmp_path, {"a": (-1, 1), "b": (-1, -1)}, {"a": (1, 1)}, subgoals=subgoals)
    plan = Errands(problem).move(a=(0, 1), b=(-0.5, -1)).reach("one").move(b=(0, -1)).reach("two").move(a=(1, 1)).plan()
    planner = Planner(problem, options=Options(initial_vertices=10))
    before = {r: g.n_vertices for r, g in planner.roadmaps.items()}
    node = planner.growth.adopt(plan.segments, plan.transitions, planner.root)
    assert node in planner.growth.goal_nodes
    assert node.cost == pytest.approx(plan.cost)
    segments, transitions, _ = planner.tree.trace(node)
    assert [a.subgoal for t in transitions for a in t.actions] == ["one", "two"]
    for mine, its in zip(segments, plan.segments, strict=True):
        for robot, q in its.q.items():
            np.testing.assert_array_equal(mine.q[robot], q)
    assert all(g.n_vertices > before[r] for r, g in planner.roadmaps.items()), "knots are roadmap vertices"


def test_an_edge_on_which_the_judge_sees_a_robot_hit_the_world_is_not_taken_again(tmp_path: Path) -> None:
    """The schedule is made anew, on another way."""
    problem = arena(tmp_path, {"a": (-1, 0)}, {"a": (1, 0)}, walls=[wall("above", (-0.1, 1.2), (0.1, 2.2))])
    planner = Planner(problem)
    growth, robot = planner.growth, "a"

    def schedule() -> SpaceTime:
        timed = growth.insertion.realise(
            planner.root.mode, {robot: planner.root.at[0]}, [], [], lambda k, mode: None, growth.goal_vertices
        )
        assert timed is not None and growth.insertion.schedule is not None
        return growth.insertion.schedule

    first = schedule()
    sides = (Side("robot", robot, "disc"), Side("static", "above", "above"))
    report = Report([Violation("collision", "deep", segment=0, step=0, fraction=0.5, value=0.02, sides=sides)])
    move = first.moves[robot][0]
    edge = growth.insertion.edge_of(robot, move)
    assert edge is not None
    e = planner.roadmaps[robot].edge(*edge)
    assert planner.validity.edge(robot, e, planner.root.mode)
    assert growth.refuted(report, first)
    assert not planner.validity.edge(robot, e, planner.root.mode)
    second = schedule()
    assert growth.insertion.edge_of(robot, second.moves[robot][0]) != edge
    assert not growth.refuted(Report([Violation("goal", "not there")]), second), "nothing to learn from"
