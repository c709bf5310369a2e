"""Guidance on names: closed-form counts of transitions and active sets, optimistic distances, proposals."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np
import pytest

from mrtamp.guidance import Choice
from mrtamp.modes import Attachment, Mode
from mrtamp.planner import Options, Planner
from mrtamp.problem_file import problem_from_dict

POSES = ((-0.5, 0.0, 0.0), (0.5, 0.0, 180.0), (0.0, 0.65, -90.0))


def planner_for(robots: int, cubes: int, goal: list[dict[str, Any]] | None = None, **sections: Any) -> Planner:
    """Arms around a table with two regions, in one of which all cubes start."""
    names = [f"cube{i}" for i in range(cubes)]
    data = {
        "mrtamp": 1,
        "name": "counting",
        "robots": [
            {
                "name": f"arm{i}",
                "model": "panda",
                "X_WB": {"translation": [x, y, 0], "rotation": {"rpy_deg": [0, 0, yaw]}},
            }
            for i, (x, y, yaw) in enumerate(POSES[:robots])
        ],
        "world": [{"name": "table", "shape": {"box": [1.6, 1.4, 0.1]}, "X_WB": {"translation": [0, 0, -0.05]}}],
        "supports": [
            {"name": "floor", "on": "table", "X_BS": {"translation": [0, -0.1, 0.05]}, "size": [0.4, 0.4]},
            {"name": "target", "on": "table", "X_BS": {"translation": [0, 0.25, 0.05]}, "size": [0.2, 0.1]},
        ],
        "objects": [
            {"name": n, "shape": {"box": [0.05] * 3}, "start": {"in": "floor", "xy": [0.0, 0.15 * i - 0.1]}}
            for i, n in enumerate(names)
        ],
        "goal": goal or [{"object": n, "in": "target"} for n in names],
        **sections,
    }
    return Planner(problem_from_dict(data), options=Options(initial_vertices=2))


def held(planner: Planner, robot: str, item: str) -> Attachment:
    family = planner.sampler.families[robot, item][0]
    X_OG = family.pose(np.zeros((1, len(family.lower))))[0]
    return Attachment(item, robot, np.linalg.inv(X_OG), None, family.width)


def after_pick(planner: Planner, robot: str = "arm0", item: str = "cube0") -> Mode:
    return planner.root.mode.replace(held(planner, robot, item))


def kinds(choices: list[Choice]) -> dict[str, int]:
    return {k: sum(c.kind == k for c in choices) for k in ("pick", "place", "handover")}


def drawn_sets(planner: Planner, mode: Mode, n: int = 3000) -> set[frozenset[str]]:
    rng = np.random.default_rng(0)
    out = set()
    for _ in range(n):
        choices = planner.guidance.feasible_sets(mode, rng)
        robots = [r for c in choices for r in c.robots]
        assert len(set(robots)) == len(robots), "disjoint robots"
        assert len({c.object for c in choices}) == len(choices), "disjoint objects"
        if choices:
            out.add(frozenset(robots))
    return out


def feasible(choices: list[Choice]) -> set[frozenset[str]]:
    """Brute force: unions of robots over all sets of choices with disjoint robots and objects."""
    out = set()
    for k in range(1, 4):
        for group in combinations(choices, k):
            robots = [r for c in group for r in c.robots]
            if len(set(robots)) == len(robots) and len({c.object for c in group}) == k:
                out.add(frozenset(robots))
    return out


@pytest.mark.parametrize(
    ("robots", "cubes", "start", "after"),
    [
        (1, 1, {"pick": 1, "place": 0, "handover": 0}, {"pick": 0, "place": 2, "handover": 0}),
        (2, 1, {"pick": 2, "place": 0, "handover": 0}, {"pick": 0, "place": 2, "handover": 1}),
        (2, 2, {"pick": 4, "place": 0, "handover": 0}, {"pick": 1, "place": 2, "handover": 1}),
        (3, 2, {"pick": 6, "place": 0, "handover": 0}, {"pick": 2, "place": 2, "handover": 2}),
    ],
)
def test_elementary_transitions_are_as_many_as_the_closed_form(
    robots: int, cubes: int, start: dict[str, int], after: dict[str, int]
) -> None:
    """R empty hands pick any of M cubes; one that holds may place on either region or hand over to R - 1 others."""
    planner = planner_for(robots, cubes)
    assert kinds(planner.guidance.enabled(planner.root.mode)) == start
    assert kinds(planner.guidance.enabled(after_pick(planner))) == after


@pytest.mark.parametrize(
    ("robots", "cubes", "start", "after"), [(1, 1, 1, 1), (2, 1, 2, 2), (2, 2, 3, 3), (3, 2, 6, 6), (3, 3, 7, 7)]
)
def test_every_feasible_active_set_is_drawn_and_no_other(robots: int, cubes: int, start: int, after: int) -> None:
    """At most 2^R - 1; two cubes keep at most two of three empty hands busy."""
    planner = planner_for(robots, cubes)
    for mode, count in ((planner.root.mode, start), (after_pick(planner), after)):
        sets = drawn_sets(planner, mode)
        assert sets == feasible(planner.guidance.enabled(mode))
        assert len(sets) == count


def test_every_elementary_transition_is_drawn() -> None:
    planner = planner_for(3, 2)
    mode, rng = after_pick(planner), np.random.default_rng(0)
    seen = {c for _ in range(2000) for c in planner.guidance.feasible_sets(mode, rng)}
    assert seen == set(planner.guidance.enabled(mode))


def test_strata_are_one_per_family_of_choices() -> None:
    """A cube: five approaches (not from below), two closing axes, two signs; one way to stand in a region."""
    planner = planner_for(2, 2)
    strata = planner.sampler.strata
    assert len(strata(planner.root.mode, "pick", ("arm0",), "cube0")) == 5 * 2 * 2
    mode = after_pick(planner)
    assert [s.rank for s in strata(mode, "place", ("arm0",), "cube0", "target")] == [3]
    handovers = strata(mode, "handover", ("arm0", "arm1"), "cube0")
    assert len(handovers) == 20
    assert {(s.rank, s.dofs, s.active) for s in handovers} == {(4, 14, ("arm0", "arm1"))}


def tower(goal: list[dict[str, Any]]) -> Planner:
    return planner_for(2, 2, goal)


def test_nothing_is_stacked_on_what_another_robot_takes_away_at_the_same_time() -> None:
    planner = tower([{"object": "cube0", "on": "cube1"}])
    mode, rng = after_pick(planner), np.random.default_rng(0)
    assert any(c.place == "top of cube1" for c in planner.guidance.enabled(mode))
    for _ in range(3000):
        choices = planner.guidance.feasible_sets(mode, rng)
        taken = {c.object for c in choices if c.kind == "pick"}
        onto = {planner.problem.support(c.place).body for c in choices if c.kind == "place"}
        assert not taken & onto, choices


def test_what_carries_another_object_is_not_picked_and_what_is_held_is_not_stacked_on() -> None:
    planner = tower([{"object": "cube0", "on": "cube1"}])
    start = planner.root.mode
    stacked = start.replace(Attachment("cube0", "cube1", np.eye(4), "top of cube1"))
    assert {c.object for c in planner.guidance.enabled(stacked)} == {"cube0"}
    both = after_pick(planner).replace(held(planner, "arm1", "cube1"))
    assert all(c.place != "top of cube1" for c in planner.guidance.enabled(both))


def test_costs_to_goal_count_transitions() -> None:
    planner = planner_for(2, 1)
    assert planner.guidance.costs_to_goal("cube0") == {"target": 0.0, "arm0": 1.0, "arm1": 1.0, "floor": 2.0}
    assert planner.guidance.remaining(planner.root.mode) == 2.0
    assert planner.guidance.remaining(after_pick(planner)) == 1.0


def test_vain_attempts_make_a_transition_dearer_and_detours_attractive() -> None:
    planner = planner_for(2, 1)
    stats = planner.sampler.outcome(("place", ("arm0",), "cube0", "target"))
    stats.calls += 2
    costs = planner.guidance.costs_to_goal("cube0")
    assert costs["arm1"] == 1.0 and costs["arm0"] == 2.0, "hand it over"
    best = planner.guidance.proposals(after_pick(planner))[0][1]
    assert best.kind == "handover"
    stats.accepted += 1
    stats.calls += 1
    assert planner.guidance.costs_to_goal("cube0")["arm0"] == 1.0


def test_places_outside_the_reach_that_was_seen_are_dear_before_any_attempt() -> None:
    far = {"name": "far", "on": "table", "X_BS": {"translation": [0.7, 0.6, 0.05]}, "size": [0.1, 0.1]}
    planner = planner_for(1, 1, [{"object": "cube0", "in": "far"}], supports=[
        {"name": "floor", "on": "table", "X_BS": {"translation": [0, -0.1, 0.05]}, "size": [0.4, 0.4]}, far
    ])  # fmt: skip
    near = planner.guidance.edge_cost(Choice("place", ("arm0",), "cube0", "floor"))
    assert planner.guidance.edge_cost(Choice("place", ("arm0",), "cube0", "far")) > near + 3


def test_held_by_goals_end_in_that_hand() -> None:
    planner = planner_for(2, 1, [{"object": "cube0", "held_by": "arm1"}])
    assert planner.guidance.goal_places("cube0") == ["arm1"]
    assert planner.guidance.costs_to_goal("cube0") == {"arm1": 0.0, "arm0": 1.0, "floor": 1.0, "target": 1.0}
    assert planner.guidance.done(after_pick(planner, "arm1"), "cube0")
    assert not planner.guidance.done(after_pick(planner, "arm0"), "cube0")


def test_an_object_in_the_way_of_a_goal_is_proposed_to_be_moved() -> None:
    """cube1 has no goal of its own and stands where cube0 has to go: calls that fail because of it name it."""
    goal = [{"object": "cube0", "at": {"translation": [0, -0.05, 0.025]}, "on": "table"}]
    planner = planner_for(1, 2, goal)
    picked = planner.sampler.sample_pick(planner.root.mode, "arm0", "cube0")
    while not picked:
        picked = planner.sampler.sample_pick(planner.root.mode, "arm0", "cube0")
    holding = planner.root.mode.replace(picked[0].after)
    for _ in range(3):
        assert planner.sampler.sample_place(holding, "arm0", "goal of cube0") == []
    proposals = planner.guidance.proposals(planner.root.mode)
    assert proposals, "there is always something to try"
    assert min(score for score, c in proposals if c.object == "cube1") <= proposals[0][0] + 1.0
