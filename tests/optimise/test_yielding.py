"""Timing drafts against brute force on the coordination grid, and against the judge."""

from __future__ import annotations

from itertools import pairwise, product
from pathlib import Path

import networkx as nx
import numpy as np
import pytest
from discs import RADIUS, Errands, disc_problem, errand
from gantry import gantry_problem, valid_plan

from mrtamp.check import Checker
from mrtamp.collision import Collision
from mrtamp.optimise.nearness import Nearness
from mrtamp.optimise.yielding import _EARLY, _LASTING, _PARTS, Draft, Yielding, _divided
from mrtamp.plan import Plan, Segment, Transition, plan_cost
from mrtamp.problem import Problem

THICK = 0.1
"""Of the discs (m): what overlaps by more parts upwards."""


def timed(plan: Plan, *, early: bool = False) -> Draft:
    yielding = Yielding(plan.problem, Nearness(Collision(plan.problem)))
    return yielding.time(plan.segments, plan.transitions, early=early)


def crossing(problem: Problem, a_to: tuple[float, float], b_to: tuple[float, float]) -> Plan:
    return Errands(problem).move(a=a_to, b=b_to).plan()


def charged(length: float, depth: float) -> float:
    return length * (1 + 10 * depth + 300 * depth**2)


def depth(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.clip(2 * RADIUS - np.linalg.norm(a - b), 0.0, THICK))


def to_go(way: np.ndarray) -> np.ndarray:
    """Length (T,) of what is left of a way (T, 2) from each of its nodes on."""
    steps = np.linalg.norm(np.diff(way, axis=0), axis=1)
    return np.append(np.cumsum(steps[::-1])[::-1], 0.0)


def depths(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Of two ways (T, 2), (N, 2): measured at every sixth node of each, and linear between those."""
    low = [np.array([[depth(x, y) for y in b[::_PARTS]] for x in a[::_PARTS]])]
    for n in (len(a), len(b)):
        columns = [np.interp(np.arange(n), np.arange(0, n, _PARTS), column) for column in low[-1].T]
        low.append(np.array(columns))
    return low[-1]


def cheapest(a: np.ndarray, b: np.ndarray, *, early: bool) -> float:
    """Over all monotone paths on the grid of two ways (T, 2), (N, 2)."""
    graph = nx.DiGraph()
    deep = depths(a, b)
    left = to_go(a)[:, None] + to_go(b)
    haste = 1 + _EARLY * early * left / left[0, 0]
    for i, j in product(range(len(a)), range(len(b))):
        for k, m in ((i + 1, j), (i, j + 1), (i + 1, j + 1)):
            if k < len(a) and m < len(b):
                longest = max(np.linalg.norm(a[k] - a[i]), np.linalg.norm(b[m] - b[j]))
                graph.add_edge((i, j), (k, m), weight=haste[k, m] * charged(float(longest), deep[k, m]))
    return float(nx.dijkstra_path_length(graph, (0, 0), (len(a) - 1, len(b) - 1)))


@pytest.mark.parametrize("early", [False, True])
@pytest.mark.parametrize(
    ("a_to", "b_to"),
    [
        ((0.5, -1.5), (-0.5, -1.5)),  # both could be in the middle at once
        ((0.5, -1.0), (-0.5, -1.0)),
        ((-0.5, -1.5), (0.5, -1.5)),  # side by side
        ((0.5, -0.7), (-0.5, -0.7)),  # no timing helps: they have to go through each other
    ],
)
def test_two_discs_wait_for_each_other_as_brute_force_has_it(
    tmp_path: Path, a_to: tuple, b_to: tuple, early: bool
) -> None:
    problem = disc_problem(tmp_path)
    draft = timed(crossing(problem, a_to, b_to), early=early)
    [segment] = draft.segments
    ways = []
    for robot, to in zip(problem.robots, (a_to, b_to), strict=True):
        length = float(np.linalg.norm(np.array(to) - robot.start))
        ways.append(np.linspace(robot.start, to, _PARTS * int(np.ceil(length / 0.3 - 1e-9)) + 1))
    deep = depths(*ways)
    a, b = segment.q["a"], segment.q["b"]
    nodes = [np.linalg.norm(q[:, None] - way, axis=2).argmin(axis=1) for q, way in zip((a, b), ways, strict=True)]
    cost = conflict = 0.0
    left = to_go(a) + to_go(b)
    for i, j in pairwise(range(len(a))):
        longest = max(np.linalg.norm(a[j] - a[i]), np.linalg.norm(b[j] - b[i]))
        at = deep[nodes[0][j], nodes[1][j]]
        cost += (1 + _EARLY * early * left[j] / left[0]) * charged(float(longest), at)
        conflict += float(longest) * at**2
    assert cost == pytest.approx(cheapest(*ways, early=early), rel=2e-3)
    assert draft.conflict == pytest.approx(conflict, abs=1e-5)
    for robot, to, q in zip(problem.robots, (a_to, b_to), (a, b), strict=True):
        assert np.array_equal(q[0], robot.start) and np.allclose(q[-1], to)


def test_who_waits_sets_out_late_or_comes_as_near_as_it_can(tmp_path: Path) -> None:
    """b crosses a's way and goes on; a has to wait for it, and for nothing else."""
    plan = crossing(disc_problem(tmp_path), (0.5, -1.5), (-0.5, -1.5))
    late, early = timed(plan), timed(plan, early=True)
    ends = [plan_cost(d.segments, d.transitions, plan.problem.cost) for d in (late, early)]
    assert ends[1] <= (1 + _EARLY) * ends[0]

    def behind(draft: Draft) -> float:
        """What is still to be done (m), over the time (m) that goes by."""
        [segment] = draft.segments
        left = sum(to_go(q) for q in segment.q.values())
        time = np.max([np.linalg.norm(np.diff(q, axis=0), axis=1) for q in segment.q.values()], axis=0)
        return float(np.asarray(left)[1:] @ time)

    assert behind(early) < behind(late) - 0.1


def test_waiting_takes_the_place_of_a_collision(tmp_path: Path) -> None:
    plan = crossing(disc_problem(tmp_path), (0.5, -1.5), (-0.5, -1.5))
    draft = timed(plan)
    assert plan_cost(draft.segments, draft.transitions, plan.problem.cost) > plan.cost
    distances = np.linalg.norm(draft.segments[0].q["a"] - draft.segments[0].q["b"], axis=1)
    assert distances.min() > 2 * RADIUS - 0.05


@pytest.mark.parametrize("toy", ["discs", "gantries"])
def test_what_was_valid_stays_valid_and_takes_no_longer(tmp_path: Path, toy: str) -> None:
    plan = errand(disc_problem(tmp_path)) if toy == "discs" else valid_plan(gantry_problem(tmp_path))
    draft = timed(plan)
    assert draft.conflict == 0.0
    cost = plan_cost(draft.segments, draft.transitions, plan.problem.cost)
    assert cost <= plan.cost + 1e-9
    assert draft.segments[-1].mode.key == plan.segments[-1].mode.key
    assert sorted(map(id, draft.transitions)) == sorted(map(id, plan.transitions))
    again = Plan(plan.problem, draft.segments, draft.transitions, cost)
    assert not [v for v in Checker(plan.problem).check(again).violations if v.kind != "goal"]


def test_who_need_not_wait_does_not(tmp_path: Path) -> None:
    """a's visit comes last in the plan, though a could be there long before b has taken the token and dropped it."""
    problem = disc_problem(tmp_path)
    plan = (
        Errands(problem)
        .move(b=(0.9, -0.5))
        .reach("take")
        .move(b=(0.5, -0.5))
        .move(b=(0.5, 0.5))
        .reach("drop")
        .move(a=(-0.5, -0.9))
        .reach("visit")
        .plan()
    )
    draft = timed(plan)
    order = [t.actions[0].subgoal for t in draft.transitions]
    assert order.index("take") < order.index("drop")
    lengths = {"a": 0.4, "b": 0.4 + 0.4 + 1.0}
    cost = plan_cost(draft.segments, draft.transitions, problem.cost) - problem.cost.of_changes(["reach"] * 3)
    assert cost == pytest.approx(max(lengths.values()) + 0.01 * sum(lengths.values())), "a moves while b does"


def test_the_events_that_robots_are_on_their_way_to_are_to_blame(tmp_path: Path) -> None:
    """b has taken the token long before it comes back to where a ends, and stays."""
    problem = disc_problem(tmp_path)
    plan = (
        Errands(problem)
        .move(b=(0.9, -0.5))
        .reach("take")
        .move(a=(-0.5, -0.9), b=(0.5, -0.5))
        .move(b=(0.5, 0.5))
        .reach("drop", "visit")
        .move(a=(-0.5, -0.5), b=(0.5, -0.5))
        .move(b=(-0.5, -0.65))
        .plan()
    )
    split = [
        Transition((action,)) for t in plan.transitions for action in sorted(t.actions, key=lambda a: str(a.subgoal))
    ]
    assert [t.actions[0].subgoal for t in split] == ["take", "drop", "visit"]
    segments = [*plan.segments[:2], *plan.segments[1:]]
    last = {r: q[-1:] for r, q in plan.segments[1].q.items()}
    segments[2] = Segment(plan.segments[1].mode.after(split[1]), last)
    draft = Yielding(problem, Nearness(Collision(problem))).time(segments, split)
    assert draft.conflict > 0
    # In the end they overlap, and the shortest way out is up: discs are 0.1 m high.
    lasting = _LASTING * 0.1**2
    assert draft.blame[1] == pytest.approx(draft.conflict + lasting) == draft.blame[2]
    assert draft.blame.get(0, 0.0) == pytest.approx(0.0)


def test_ways_are_divided_evenly_and_cut_short_nowhere_but_at_slight_bends() -> None:
    corner = np.array([[0, 0], [0.5, 0], [0.5, 0], [1.0, 0.1], [1.0, 1.0]], dtype=float)
    stretches = list(_divided(corner))
    assert len(stretches) == 2
    start, whole = corner[0], 0.0
    for (nodes, n), end in zip(stretches, corner[[3, 4]], strict=True):
        steps = np.linalg.norm(np.diff(np.vstack([start, nodes]), axis=0), axis=1)
        assert len(nodes) == n * _PARTS and steps.max() <= 0.3 / _PARTS + 1e-9
        assert steps.max() - steps.min() < 1e-3
        assert np.array_equal(nodes[-1], end)
        start, whole = end, whole + steps.sum()
    assert whole == pytest.approx(0.5 + np.hypot(0.5, 0.1) + 0.9, abs=1e-3)
    assert not list(_divided(np.zeros((3, 2))))
