"""The shipped planar problems: their optima in closed form or by exact lower bounds that hand-made plans attain."""

from __future__ import annotations

import dataclasses

import pytest
from pydrake.math import RigidTransform
from scheduled import Hold, scheduled_plan

from mrtamp.check import check_plan
from mrtamp.problem import MrtampError, Problem, Shape, StaticBody
from mrtamp.problem_file import load_problem
from mrtamp.timetable import Timetable, timetable

SHIPPED = ("square_sequence", "square_free", "planar_passages", "planar_doorway", "planar_meetings")
CLEARANCE = 2e-4
"""Hand-made plans keep this far (m) from the walls: the judge wants more than zero."""
HOLDS: dict[str, dict[str, list[Hold]]] = {
    "square_sequence": {},
    "square_free": {},
    "planar_passages": {},
    # `right` lets `left` into the doorway, then `left` waits at its second errand until `right` is through.
    "planar_doorway": {"right": [(0.0, 0.8)], "left": [(4.927, 5.95)]},
    # The clerk keeps the doorway free for the scout, and lets the courier pass when all go home.
    "planar_meetings": {"clerk": [(0.0, 5.0), (2.103, 9.5)]},
}
"""Where robots wait beside their subgoals; found by looking at when they would meet."""


@pytest.fixture(params=SHIPPED, scope="module")
def problem(request: pytest.FixtureRequest) -> Problem:
    return load_problem(request.param)


def test_bound_is_attained_by_a_plan_that_the_judge_accepts(problem: Problem):
    """Lower bound and plan meet to 0.2 %: up to that, the bound is the optimum."""
    bound = timetable(problem)
    plan = scheduled_plan(problem, timetable(problem, CLEARANCE), HOLDS[problem.name])
    report = check_plan(plan)
    assert report.ok, report
    assert bound.cost - 1e-9 <= plan.cost <= 1.002 * bound.cost


def test_squares_by_counting():
    """Nobody is in anybody's way, so only lengths and order count.

    agent2 walks its unit side four times; agent1 walks up its own and back.  Both together: 6 m of path, 0.06.
    Each at its own pace, agent2 takes longest: 4 + 0.06.  In the fixed sequence, agent1 may stand at its corner by the
    time agent2 is done, at 4, and be there at that very instant, but it cannot leave before, and has 1 m to go:
    4 + 1 + 0.06.
    """
    assert timetable(load_problem("square_free")).cost == pytest.approx(4.06, abs=1e-12)
    assert timetable(load_problem("square_sequence")).cost == pytest.approx(5.06, abs=1e-12)


def test_passages_tempt_with_wrong_passages_and_orders():
    """The narrow passage is worth 10 %, the order of visits too: a local optimum of another kind shows."""
    problem = load_problem("planar_passages")
    best = timetable(problem)
    closed = StaticBody("closed", RigidTransform([0, 0.3, 0.15]), Shape("box", (0.2, 0.5, 0.3)))
    wide = timetable(dataclasses.replace(problem, statics=(*problem.statics, closed)))
    assert wide.cost > 1.1 * best.cost
    # The way there and back again can be taken in either sense: what is in the middle of the tour distinguishes tours.
    one, middle, two = best.order["north"]
    forced = tuple(dataclasses.replace(s, after=(one, two)) if s.name == middle else s for s in problem.subgoals)
    assert timetable(dataclasses.replace(problem, subgoals=forced)).cost > 1.02 * best.cost


@pytest.mark.parametrize("name", ["planar_doorway", "planar_meetings"])
def test_somebody_has_to_wait(name: str):
    """At full speed the robots collide: the bound is attained only because some of them have the time to wait."""
    problem = load_problem(name)
    table = timetable(problem, CLEARANCE)
    report = check_plan(scheduled_plan(problem, table, {}))
    assert report.kinds == {"collision"}
    for robot in HOLDS[name]:
        others = {r: holds for r, holds in HOLDS[name].items() if r != robot}
        assert not check_plan(scheduled_plan(problem, table, others)).ok


def test_meetings_depend_on_who_waits_for_whom():
    """The longest chain of visits passes from robot to robot."""
    problem = load_problem("planar_meetings")
    table = timetable(problem)
    longest = max(sum(lengths) for lengths in table.lengths.values())
    assert table.makespan > 1.1 * longest
    first_survey = tuple(
        dataclasses.replace(s, after=("survey",)) if s.name == "briefing" else s for s in problem.subgoals
    )
    assert timetable(dataclasses.replace(problem, subgoals=first_survey)).cost > 1.1 * table.cost


def test_timetable_waits_for_predecessors(problem: Problem):
    table: Timetable = timetable(problem)
    for subgoal in problem.subgoals:
        assert all(table.arrival[subgoal.name] >= table.arrival[name] for name in subgoal.after)
    for robot, order in table.order.items():
        done = 0.0
        for name, leg in zip(order, table.lengths[robot], strict=False):
            done += leg
            assert table.arrival[name] >= done - 1e-9


def test_other_problems_have_no_timetable():
    with pytest.raises(MrtampError, match="found objects, expected discs"):
        timetable(load_problem("box"))
    arms = load_problem("box")
    with pytest.raises(MrtampError, match="found the robot left, expected a disc"):
        timetable(dataclasses.replace(arms, objects=(), supports=(), goal=()))


def test_a_robot_shut_in_has_no_timetable():
    problem = load_problem("planar_doorway")
    door = StaticBody("door", RigidTransform([0, 0, 0.15]), Shape("box", (0.1, 0.6, 0.3)))
    with pytest.raises(MrtampError, match="cannot get from start to left_far"):
        timetable(dataclasses.replace(problem, statics=(*problem.statics, door)))
