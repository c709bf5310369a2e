"""Refinement makes plans cheaper, keeps them valid, and leaves what happens at transitions alone."""

from __future__ import annotations

import numpy as np
import pytest

import mrtamp
from mrtamp.incumbent import Incumbent
from mrtamp.plan import Plan, measures, plan_cost
from mrtamp.planner import Options, Planner
from mrtamp.refine import Refiner


@pytest.fixture(scope="module")
def planner() -> Planner:
    planner = Planner(mrtamp.load_problem("stacking"), seed=1, options=Options(refinements=0))
    next(planner.improve(30, first=True))
    return planner


def refiner(planner: Planner, plan: Plan, seed: int = 0) -> Refiner:
    return Refiner(
        plan.segments,
        plan.transitions,
        planner.problem.cost,
        planner.collision,
        planner.validity,
        planner.roadmaps,
        np.random.default_rng(seed),
    )


def test_a_fresh_refiner_has_the_motion_and_the_cost_of_its_plan(planner: Planner) -> None:
    plan = planner.best
    assert plan is not None
    fresh = refiner(planner, plan)
    assert fresh.cost == pytest.approx(plan.cost, rel=1e-12)
    assert plan_cost(fresh.segments(), fresh.transitions, planner.problem.cost) == pytest.approx(plan.cost, rel=1e-12)


def test_refined_plans_are_cheaper_and_pass_the_check(planner: Planner) -> None:
    plan = planner.best
    assert plan is not None
    better = refiner(planner, plan)
    costs = [better.cost]
    for _ in range(4):
        gain = better.improve(150)
        costs.append(better.cost)
        assert gain == pytest.approx(costs[-2] - costs[-1], abs=1e-9)
        assert gain >= -1e-9
    assert costs[-1] < 0.9 * costs[0]
    refined = Incumbent(planner.problem, 0, planner.counts).plan(better.segments(), better.transitions)
    assert refined.cost == pytest.approx(better.cost, rel=1e-9)
    assert mrtamp.check_plan(refined).ok


def test_transition_configurations_do_not_move(planner: Planner) -> None:
    plan = planner.best
    assert plan is not None
    better = refiner(planner, plan, seed=3)
    better.improve(300)
    for t, before, after in zip(plan.transitions, plan.segments, better.segments(), strict=False):
        for robot in t.active:
            np.testing.assert_array_equal(before.q[robot][-1], after.q[robot][-1])


def test_arms_come_to_move_at_the_same_time(planner: Planner) -> None:
    """The tree moves one arm after another: makespan and path length differ little until a plan is refined."""
    plan = planner.best
    assert plan is not None
    better = refiner(planner, plan, seed=5)
    better.improve(600)
    ratio = [m["makespan"] / m["path_length"] for m in (measures(plan.segments), measures(better.segments()))]
    assert ratio[1] < 0.95 * ratio[0]
