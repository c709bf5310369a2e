"""Guidance that knows costs: what it proposes is possible in that order, bounded from below, and learnt from."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from arena import arena, visit

import mrtamp
from mrtamp.modes import Mode
from mrtamp.planner import Options, Planner
from mrtamp.problem import Problem
from mrtamp.skeleton_guidance import Proposal
from mrtamp.tasks import pick_place


def ready(problem: Problem) -> Planner:
    """A planner that has grown ways but realised nothing."""
    planner = Planner(problem, options=Options(initial_vertices=2))
    for _ in range(4):
        planner.skeletons.grow(60, 14)
    planner.skeletons.update_bound()
    return planner


def names(proposal: Proposal) -> list[str]:
    return [s.subgoal or s.after.object for s, _ in proposal.stops]


def visits(folder: Path) -> Problem:
    """c must come after b, and d after c; a is free."""
    subgoals = [
        visit("a", "one", (0, 1)),
        visit("b", "one", (1, 1)),
        visit("c", "two", (0, -1), "b"),
        visit("d", "one", (0, 0.5), "c"),
    ]
    return arena(folder, {"one": (-1, 1), "two": (-1, -1)}, {"one": (-1, 1)}, subgoals=subgoals)


def assert_possible(planner: Planner, proposal: Proposal) -> None:
    """Predecessors are numbered before, and every robot's and object's chain is in order."""
    for k, before in enumerate(proposal.before):
        assert all(j < k for j in before)
    mode: Mode = planner.root.mode
    for stop, way in proposal.stops:
        assert stop in way.stops
        if stop.kind == "reach":
            assert set(planner.problem.subgoal(stop.subgoal).after) <= mode.done
            mode = mode.replace(done=[stop.subgoal])
            continue
        assert mode.of[stop.before.object] is stop.before
        assert stop.before.object not in mode.loaded
        if stop.kind == "place" and stop.after.parent in mode.of:
            assert planner.guidance.done(mode, stop.after.parent), "first what it goes onto"
        mode = mode.replace(stop.after)
        assert len(mode.held) == sum(a.held for a in mode.attachments), "one thing per hand"
    assert planner.growth.is_goal_mode(mode)


@pytest.mark.parametrize("scene", ["visits", "pick_place", "stacking", "box"])
def test_proposals_respect_precedence_and_cost_at_least_the_bound(tmp_path: Path, scene: str) -> None:
    problems = {"visits": lambda: visits(tmp_path), "pick_place": lambda: pick_place(2, 2)}
    planner = ready(problems.get(scene, lambda: mrtamp.load_problem(scene))())
    guidance = planner.skeletons
    found = list(guidance.propose())
    assert found and guidance.bound is not None and guidance.bound > 0
    costs = [p.skeleton.cost for p in found]
    assert costs == sorted(costs)
    for proposal in found:
        assert_possible(planner, proposal)
        assert guidance.bound <= proposal.skeleton.bound + 1e-9 <= proposal.skeleton.cost + 2e-9


def test_nothing_dearer_than_asked_for_is_proposed(tmp_path: Path) -> None:
    planner = ready(pick_place(2, 2))
    costs = [p.skeleton.cost for p in planner.skeletons.propose()]
    middle = float(np.median(costs))
    assert all(p.skeleton.cost < middle for p in planner.skeletons.propose(middle))
    assert list(planner.skeletons.propose(costs[0] - 1e-6)) == []


def test_ways_that_failed_get_dearer_and_others_are_proposed() -> None:
    planner = ready(pick_place(2, 2))
    guidance = planner.skeletons
    seen = []
    for _ in range(5):
        proposal = next(guidance.propose())
        way = proposal.stops[0][1]
        assert way not in seen, "not the way that has just failed again"
        seen.append(way)
        penalty = way.penalty
        guidance.failed(way)
        assert way.penalty > penalty and way.failures == 1
    guidance.update_bound()
    assert guidance.bound <= next(guidance.propose()).skeleton.cost, "experience is no part of the bound"


def test_an_order_that_was_realised_steps_back_behind_others_that_cost_about_the_same() -> None:
    planner = ready(pick_place(2, 2))
    guidance = planner.skeletons
    first = next(guidance.propose())
    orders = set()
    for _ in range(30):
        proposal = next(guidance.propose())
        assert proposal.repeated == guidance._realised[proposal.skeleton.order]
        orders.add(proposal.skeleton.order)
        guidance.realised(proposal)
    assert len(orders) >= 2, "others get their turn"
    assert first.skeleton.order in orders


def test_different_orders_and_assignments_are_proposed() -> None:
    planner = ready(pick_place(2, 4))
    found = list(islice(planner.skeletons.propose(), 8))
    assert len({p.skeleton.order for p in found}) >= 4


def test_a_stop_becomes_one_candidate_however_often_it_is_asked_for() -> None:
    planner = ready(pick_place(2, 2))
    guidance, mode = planner.skeletons, planner.root.mode
    for proposal in guidance.propose():
        stop, _ = proposal.stops[0]
        candidate = guidance.candidate(stop, mode)
        if candidate is not None:
            break
    vertices = {r: g.n_vertices for r, g in planner.roadmaps.items()}
    [robot] = stop.robots
    known = len(planner.sampler.picks(mode, robot, stop.before.object))
    assert guidance.candidate(stop, mode) is candidate
    assert {r: g.n_vertices for r, g in planner.roadmaps.items()} == vertices
    assert len(planner.sampler.picks(mode, robot, stop.before.object)) == known
    assert candidate.before is stop.before and candidate.after is stop.after
    np.testing.assert_array_equal(planner.roadmaps[robot].q[candidate.at[robot]], stop.q[robot])


def test_goals_that_end_in_a_hand_are_left_to_the_search() -> None:
    data = mrtamp.load_problem("handover")
    assert Planner(data, options=Options(initial_vertices=2)).skeletons.applies


@pytest.mark.parametrize("choice", [False, True])
def test_in_haste_nothing_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, choice: bool) -> None:
    """Skeletons are proposed without a look at the roadmaps, whether there is one or several to choose from."""
    if choice:
        problem = visits(tmp_path)
    else:
        subgoals = [visit("a", "one", (0, 1)), visit("b", "two", (1, 1), "a"), visit("c", "one", (1, 0), "b")]
        problem = arena(tmp_path, {"one": (-1, 1), "two": (-1, -1)}, subgoals=subgoals)
    guidance = ready(problem).skeletons
    measured = list(guidance.propose())

    def length(*_: object) -> float:
        raise AssertionError("measured")

    monkeypatch.setattr(guidance, "_length", length)
    hasty = list(guidance.propose(hasty=True))
    assert all(p.hasty for p in hasty) and not any(p.hasty for p in measured)
    assert names(hasty[0]) == names(measured[0])
    # Nothing is in the way here.
    assert [p.skeleton.cost for p in hasty] == pytest.approx([p.skeleton.cost for p in measured])
    guidance.update_bound(hasty=True)
    with pytest.raises(AssertionError, match="measured"):
        next(guidance.propose())


def test_what_all_ways_of_a_task_have_against_them_counts_for_nothing(tmp_path: Path) -> None:
    """Only ways can be told apart by experience: where there is one, a skeleton stays as promising as it was."""
    guidance = ready(visits(tmp_path)).skeletons
    before = next(guidance.propose())
    for way in before.ways:
        guidance.failed(way)
    assert next(guidance.propose()).skeleton.cost == pytest.approx(before.skeleton.cost)


def test_what_conflicts_makes_ways_near_to_it_dearer_and_no_others() -> None:
    guidance = ready(pick_place(2, 2)).skeletons
    blamed = next(guidance.propose()).ways[0]
    [(key, known)] = [(key, ways) for key, ways in guidance.ways.of.items() if blamed in ways]
    before = {way: way.penalty for ways in guidance.ways.of.values() for way in ways}
    guidance.crowded({blamed: 0.004})
    more = {way: way.penalty - penalty for way, penalty in before.items()}
    assert more[blamed] == pytest.approx(0.4)
    apart = np.array([np.linalg.norm(way.flat() - blamed.flat()) for way in known])
    rises = np.array([more[way] for way in known])
    assert len(known) > 5 and np.all(np.diff(rises[np.argsort(apart)]) <= 0)
    assert rises[apart > 2.0].max(initial=0.0) < 1e-3
    assert not any(more[way] for k, ways in guidance.ways.of.items() if k != key for way in ways)
