"""Refinement makes plans cheaper, keeps them valid and what happens at transitions, and makes arms move together."""

from __future__ import annotations

import numpy as np
import pytest

import mrtamp
from mrtamp.collision import RESOLUTION
from mrtamp.incumbent import Incumbent
from mrtamp.modes import Attachment
from mrtamp.plan import Action, Plan, measures, plan_cost
from mrtamp.planner import Options, Planner
from mrtamp.refine import Refiner, must_follow
from mrtamp.retiming import Grid, cut, duration, simple_timing


@pytest.fixture(scope="module")
def planner() -> Planner:
    """With a first plan of the tensor tree, which moves one arm at a time."""
    options = Options(without=frozenset({"skeletons"}))
    planner = Planner(mrtamp.load_problem("stacking"), seed=1, options=options)
    next(planner.improve(60, first=True))
    return planner


@pytest.fixture(scope="module")
def plan(planner: Planner) -> Plan:
    assert planner.best is not None
    return planner.best


@pytest.fixture(scope="module")
def refined(planner: Planner, plan: Plan) -> Refiner:
    """Where something slips between the samples they are halved, as the portfolio does when the judge objects."""
    for halvings in range(3):
        better = Refiner(plan, planner.validity, np.random.default_rng(0), RESOLUTION / 2**halvings)
        costs = [better.cost]
        for _ in range(8):
            gain = better.improve(100)
            costs.append(better.cost)
            assert gain == pytest.approx(costs[-2] - costs[-1], abs=1e-9)
            assert gain >= -1e-9
        if mrtamp.check_plan(judged(planner, better)).ok:
            break
    return better


def judged(planner: Planner, better: Refiner) -> Plan:
    return Incumbent(planner.problem, 0, planner.collision.counts).plan(better.segments(), better.transitions)


def refiner(planner: Planner, plan: Plan, seed: int = 0) -> Refiner:
    return Refiner(plan, planner.validity, np.random.default_rng(seed))


def test_a_fresh_refiner_has_the_motion_and_the_cost_of_its_plan(planner: Planner, plan: Plan) -> None:
    fresh = refiner(planner, plan)
    assert fresh.cost == pytest.approx(plan.cost, rel=1e-12)
    assert plan_cost(fresh.segments(), fresh.transitions, planner.problem.cost) == pytest.approx(plan.cost, rel=1e-12)
    actions = [a for t in plan.transitions for a in t.actions]
    assert [a for t in fresh.transitions for a in t.actions] == actions


def test_refined_plans_are_cheaper_and_pass_the_check(planner: Planner, plan: Plan, refined: Refiner) -> None:
    assert refined.cost < 0.9 * plan.cost
    better = judged(planner, refined)
    assert better.cost == pytest.approx(refined.cost, rel=1e-9)
    assert mrtamp.check_plan(better).ok


def test_the_same_actions_happen_at_the_same_configurations(plan: Plan, refined: Refiner) -> None:
    def configurations(segments, transitions):
        out = {}
        for t, segment in zip(transitions, segments, strict=False):
            for n, a in enumerate(t.actions):
                out[id(a), n] = [segment.q[r][-1] for r in a.robots]
        return {key[0]: value for key, value in out.items()}

    before = configurations(plan.segments, plan.transitions)
    after = configurations(refined.segments(), refined.transitions)
    assert before.keys() == after.keys()
    for action, qs in before.items():
        np.testing.assert_array_equal(qs, after[action])


def test_actions_that_depend_on_each_other_keep_their_order(plan: Plan, refined: Refiner) -> None:
    def order(transitions):
        return [a for t in transitions for a in t.actions]

    place = {id(a): n for n, a in enumerate(order(refined.transitions))}
    actions = order(plan.transitions)
    for i, a in enumerate(actions):
        for b in actions[i + 1 :]:
            if must_follow(a, b, {}):
                assert place[id(a)] < place[id(b)]


def test_arms_come_to_move_at_the_same_time(plan: Plan, refined: Refiner) -> None:
    """The tree moves one arm after another: makespan and path length differ little until a plan is refined."""
    ratio = [m["makespan"] / m["path_length"] for m in (measures(plan.segments), measures(refined.segments()))]
    assert ratio[1] < ratio[0]


def test_a_refinement_is_repeatable(planner: Planner, plan: Plan) -> None:
    costs = []
    for _ in range(2):
        once = refiner(planner, plan, seed=7)
        once.improve(150)
        costs.append(once.cost)
    assert costs[0] == costs[1]


def test_what_must_follow_what() -> None:
    def action(robot: str, item: str | None, parent: str = "table", subgoal: str | None = None) -> Action:
        a = Attachment(item, parent, np.eye(4), support=parent) if item else None
        return Action("place" if item else "reach", (robot,), a, a, subgoal)

    assert must_follow(action("a", "x"), action("a", "y"), {})
    assert must_follow(action("a", "x"), action("b", "x"), {})
    assert must_follow(action("a", "x"), action("b", "y", parent="x"), {})
    assert must_follow(action("a", "y", parent="x"), action("b", "x"), {})
    assert not must_follow(action("a", "x"), action("b", "y"), {})
    first, second = action("a", None, subgoal="one"), action("b", None, subgoal="two")
    assert must_follow(first, second, {"two": ("one",)})
    assert not must_follow(second, first, {"two": ("one",)})


@pytest.mark.parametrize("seed", range(20))
def test_timings_are_monotone_and_take_at_least_as_long_as_the_longer_of_both(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T, L = rng.random(2) * 5
    path = simple_timing(T, L, rng)
    assert np.all(np.diff(path, axis=0) >= -1e-12)
    np.testing.assert_allclose(path[[0, -1]], [[0, 0], [T, L]])
    assert duration(path) >= max(T, L) - 1e-9
    clock, progress = np.sort(rng.random(6)) * T, np.sort(rng.random(6)) * L
    clock[[0, -1]], progress[[0, -1]] = [0, T], [0, L]
    timing = cut(path, clock, progress, [(True, progress[2]), (False, clock[3])], [[], []])
    assert timing is not None
    steps = np.maximum(np.diff(timing.c), np.diff(timing.p))
    assert steps.sum() == pytest.approx(duration(path))
    assert timing.p[timing.events[0]] == pytest.approx(progress[2])
    assert timing.c[timing.events[1]] == pytest.approx(clock[3])


def test_an_event_waits_for_the_one_it_must_follow_or_the_timing_is_refused() -> None:
    clock, progress = np.linspace(0, 4, 5), np.linspace(0, 2, 3)
    others_at_3, own_at_1 = (False, 3.0), (True, 1.0)
    waits = np.array([[0.0, 0.0], [1.0, 1.0], [3.5, 1.0], [4.0, 2.0]])
    timing = cut(waits, clock, progress, [others_at_3, own_at_1], [[], [0]])
    assert timing is not None
    assert timing.events[1] >= timing.events[0]
    early = np.array([[0.0, 0.0], [2.0, 2.0], [4.0, 2.0]])
    assert cut(early, clock, progress, [others_at_3, own_at_1], [[], [0]]) is None
    free = cut(early, clock, progress, [others_at_3, own_at_1], [[], []])
    assert free is not None
    assert free.events[1] < free.events[0]


def test_the_grid_finds_the_shortest_timing_around_what_is_blocked() -> None:
    lines = np.linspace(0, 4, 41)
    grid = Grid(lines, lines)
    path = grid.timing()
    assert path is not None
    assert duration(path) == pytest.approx(4.0)
    # The robot must be past 3 before the others are past 1: they wait for two units.
    grid.forbid(1.0, 3.0, robot_waits=False)
    path = grid.timing()
    assert path is not None
    assert duration(path) == pytest.approx(6.0)
    grid.block(np.array([0.0, 0.0]), np.array([4.0, 4.0]))
    assert grid.timing() is None
