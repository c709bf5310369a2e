"""Ways between transitions: where they are, which are the same, and taking one in place of another."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from arena import arena
from discs import Errands
from gantry import gantry_problem, valid_plan
from test_local_search import around, plan_of, search, taut

from mrtamp.check import check_plan
from mrtamp.collision import Collision
from mrtamp.optimise import LocalSearch, Optimiser, Stock, local_search, tools_of
from mrtamp.optimise.legs import Way, legs_of, order_of
from mrtamp.optimise.nearness import Nearness
from mrtamp.optimise.piece import Whole
from mrtamp.optimise.polyline import load
from mrtamp.plan import Plan


def whole_of(plan: Plan) -> Whole:
    tools = tools_of(Nearness(Collision(plan.problem)))
    return Whole(load(plan.segments, plan.transitions, tools), [s.mode for s in plan.segments], plan.transitions)


def stock_of(plan: Plan) -> Stock:
    stock = Stock(tools_of(Nearness(Collision(plan.problem))))
    stock.add(plan.segments, plan.transitions)
    return stock


def below(plan: Plan) -> Plan:
    """The same errand around the near end of the block."""
    return Errands(plan.problem).move(a=(-0.4, -0.5)).move(a=(0.4, -0.5)).move(a=(1, 0)).plan()


def test_legs_lie_between_the_transitions_of_their_robots(tmp_path: Path) -> None:
    whole = whole_of(valid_plan(gantry_problem(tmp_path)))
    line = whole.line
    legs = legs_of(whole)
    assert {x.robot for x in legs} == set(line.columns)
    for leg in legs:
        own = [int(line.events[k]) for k, t in enumerate(whole.transitions) if leg.robot in t.active]
        assert any(a <= leg.low < leg.high <= b for a, b in pairwise([0, *own, line.knots - 1]))
        q = line.of(leg.robot)[leg.low : leg.high + 1]
        assert leg.length == pytest.approx(np.linalg.norm(np.diff(q, axis=0), axis=1).sum())
        assert leg.spare == pytest.approx(leg.length - np.linalg.norm(q[-1] - q[0]))
        # Of the motions in contact beside transitions they have at most the far ends.
        inner = np.arange(leg.low + 1, leg.high)
        for s in line.stretches:
            low, high = sorted((s.far, int(line.events[s.event])))
            assert s.robot != leg.robot or not np.any((inner > low) & (inner < high))


def test_the_clock_of_a_plan_counts_its_transitions(tmp_path: Path) -> None:
    whole = whole_of(valid_plan(gantry_problem(tmp_path)))
    clock, events = whole.clock(), whole.line.events
    assert clock[0] == 0.0
    assert clock[-1] == pytest.approx(len(events) + 1)
    assert np.all(np.diff(clock) > 0)
    np.testing.assert_allclose(clock[events], 1 + np.arange(len(events)))


def test_every_way_is_kept_once(tmp_path: Path) -> None:
    plan = around(tmp_path)
    stock = stock_of(plan)
    [leg] = legs_of(whole_of(plan))
    q = whole_of(plan).line.of("a")[leg.low : leg.high + 1]
    assert stock.others(leg, q) == [], "it is its own"
    other = below(plan)
    for _ in range(3):
        stock.add(other.segments, other.transitions)
    [way] = stock.others(leg, q)
    assert way.length < leg.length
    assert way.beside(q) > 0.9, "one leads above the block, one below"
    assert stock.others(leg, q + 0.3) == [], "a way between other places does not serve"


@pytest.mark.parametrize("by_the_clock", [False, True])
def test_a_way_in_place_of_another_has_its_ends(by_the_clock: bool) -> None:
    rng = np.random.default_rng(3)
    mine, theirs = np.cumsum(rng.normal(size=(2, 12, 3)), axis=1)
    clock = np.sort(rng.uniform(0, 1, 12))
    way = Way(theirs, clock, ())
    u, same = way.instead_of(theirs, clock if by_the_clock else None)
    np.testing.assert_allclose(u, np.arange(12))
    np.testing.assert_allclose(same, theirs, atol=1e-9)
    u, fresh = way.instead_of(mine, clock if by_the_clock else None)
    assert set(range(12)) <= set(u) and np.all(np.diff(u) > 0)
    np.testing.assert_allclose(fresh[[0, -1]], mine[[0, -1]])


def test_a_way_in_place_of_another_keeps_its_corners() -> None:
    rng = np.random.default_rng(4)
    way = Way(np.cumsum(rng.normal(size=(12, 3)), axis=0), np.linspace(0, 1, 12), ())
    straight = np.linspace(way.q[0], way.q[-1], 5)
    u, fresh = way.instead_of(straight)
    assert len(u) == 5 + 10
    assert all(np.linalg.norm(fresh - x, axis=1).min() < 1e-9 for x in way.q)
    lengths = [np.linalg.norm(np.diff(q, axis=0), axis=1).sum() for q in (fresh, way.q)]
    assert lengths[0] == pytest.approx(lengths[1])


def test_of_two_ways_that_are_alike_the_shorter_is_kept(tmp_path: Path) -> None:
    plan = around(tmp_path)

    def past(y: float) -> Plan:
        return Errands(plan.problem).move(a=(-0.4, y)).move(a=(0.4, y)).move(a=(1, 0)).plan()

    stock = stock_of(past(-0.5))
    [leg] = legs_of(whole_of(past(-0.5)))
    q = whole_of(past(-0.5)).line.of("a")[leg.low : leg.high + 1]
    for y, found in ((-0.53, []), (-0.47, [-0.47]), (-0.45, [-0.45]), (-0.46, [-0.45])):
        other = past(y)
        stock.add(other.segments, other.transitions)
        assert [w.q[len(w.q) // 2][1] for w in stock.others(leg, q)] == pytest.approx(found), y


def test_an_order_tells_who_does_what_when(tmp_path: Path) -> None:
    problem = arena(tmp_path, {"a": (-1, 0), "b": (-1, -1)}, {"a": (1, 0), "b": (0, -1)})
    orders = set()
    for first in ("a", "b"):
        goals = {"a": (1, 0), "b": (0, -1)}
        e = Errands(problem)
        for robot in sorted(goals, key=lambda r: r != first):
            e = e.move(**{robot: goals[robot]})
        orders.add(order_of(e.plan().transitions))
    assert len(orders) == 1, "nothing happens in either"


@pytest.mark.parametrize("seed", range(3))
def test_what_another_plan_did_better_is_taken_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    monkeypatch.setattr(local_search, "_BENT", 0.0)
    plan = around(tmp_path)
    work = search(plan, seed)
    work.stock = stock_of(below(plan))
    trials = 0
    while work.cost > 1.1 * taut(0.1) and trials < 2:
        work.step()
        trials += work._trial is None
    assert trials == 1, "it is the first thing that is tried"
    assert check_plan(plan_of(work)).ok
    while not work.converged and work.steps < 400:
        work.step()
    assert work.cost == pytest.approx(1.01 * taut(0.1), rel=0.01)


def test_a_shorter_way_that_is_free_counts_before_any_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Programs that lead nowhere do not lose it; what collides is none the better for being shorter."""
    monkeypatch.setattr(local_search, "_BENT", 0.0)

    def nowhere(scp: Optimiser) -> float:
        scp.converged = True
        return 0.0

    monkeypatch.setattr(Optimiser, "step", nowhere)
    plan = around(tmp_path)
    through = Errands(plan.problem).move(a=(-0.4, -0.1)).move(a=(0.4, -0.1)).move(a=(1, 0)).plan()
    for other, free in ((through, False), (below(plan), True)):
        work = search(plan)
        work.stock = stock_of(other)
        while work._others() or work._trial:
            work.step()
        assert work.cost == pytest.approx(other.cost if free else plan.cost)
        assert check_plan(plan_of(work)).ok


def test_a_stock_may_grow_while_it_is_used(tmp_path: Path) -> None:
    plan = around(tmp_path)
    work: LocalSearch = search(plan)
    assert not work._others()
    other = below(plan)
    work.stock.add(other.segments, other.transitions)
    [(leg, way)] = work._others()
    work._from_stock([(leg, way)])
    assert not work._others(), "no way is tried twice in the same place"
