"""Ways: the poses of a whole chain of transitions fit together, end at the goal, and say what is in their way."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import mrtamp
from mrtamp.modes import Mode, goal_mode
from mrtamp.planner import Options, Planner
from mrtamp.problem_file import problem_from_dict
from mrtamp.tasks import pick_place
from mrtamp.transitions.ways import BLOCKED, Way


def planner_for(problem: Any) -> Planner:
    if isinstance(problem, str):
        problem = mrtamp.load_problem(problem)
    return Planner(problem, options=Options(initial_vertices=2))


def grown(planner: Planner, rounds: int = 6) -> list[Way]:
    """Every way after some rounds of growing."""
    for _ in range(rounds):
        planner.skeletons.grow(60, 8)
    return [w for ways in planner.skeletons.ways.of.values() for w in ways]


def assert_closed(planner: Planner, way: Way) -> Mode:
    """At every stop the object is where both attachments say; returns the mode at the end.

    What it is put on stands where it is planned to stand by then, and so on down.
    """
    mode = planner.root.mode
    for item in planner.skeletons.items:
        planned = planner.skeletons.ways.settle(mode, item, {})
        if planned is not None and item != way.stops[0].before.object:
            mode = mode.replace(planned[0])
    for stop in way.stops:
        assert stop.before is mode.of[stop.before.object], "each stop goes on where the last one ended"
        after = mode.replace(stop.after)
        X_WO = []
        for m in (mode, after):
            a = m.of[stop.before.object]
            if a.held:
                tool = planner.roadmaps[a.parent].world.tool
                X_WO.append(tool.matrix(stop.q[a.parent][None])[0] @ a.X_PO)
            else:
                X_WO.append(planner.validity.world_pose(m.chain(a.object)))
        np.testing.assert_allclose(X_WO[0], X_WO[1], atol=1e-6)
        mode = after
    return mode


@pytest.mark.parametrize("name", ["pick_place", "stacking", "handover"])
def test_poses_close_at_every_stop_and_the_last_one_is_the_goal(name: str) -> None:
    planner = planner_for(pick_place(2, 2) if name == "pick_place" else name)
    ways = grown(planner)
    assert len(ways) >= 10
    kinds = {tuple(s.kind for s in w.stops) for w in ways}
    assert kinds <= {("pick", "place"), ("pick", "handover", "place")}
    if name == "handover":
        assert ("pick", "handover", "place") in kinds
    for way in ways:
        end = assert_closed(planner, way)
        item = way.stops[-1].after.object
        assert way.stops[-1].after.support in {s.name for s in planner.sampler.goal_supports[item]}
        assert end.of[item] is way.stops[-1].after


def test_one_way_per_object_makes_a_goal_mode() -> None:
    planner = planner_for(pick_place(2, 2))
    ways = grown(planner)
    mode = planner.root.mode
    for item in mode.of:
        mode = mode.replace(next(w for w in ways if w.stops[-1].after.object == item).stops[-1].after)
    assert goal_mode(planner.problem, mode, planner.validity.X_WB)


def test_what_is_put_on_a_planned_placement_shares_that_very_attachment() -> None:
    """In a tower every way of an object below ends in one attachment, the one that those above were solved for."""
    planner = planner_for("stacking")
    grown(planner)
    ways, sampler = planner.skeletons.ways, planner.sampler
    below = {s.body for o in planner.skeletons.items for s in sampler.goal_supports[o]} & set(planner.skeletons.items)
    assert below
    for item in below:
        ends = {id(w.stops[-1].after) for (o, _), known in ways.of.items() if o == item for w in known}
        assert len(ends) == 1


def pose(x: float, y: float, z: float) -> dict[str, Any]:
    return {"translation": [x, y, z]}


def blocked_problem(*, blocker: bool) -> dict[str, Any]:
    """A cube has to go where another one stands."""
    cube = {"box": [0.05] * 3}
    objects = [{"name": "red", "shape": cube, "start": {"on": "table", "X_WO": pose(0.0, 0.2, 0.025)}}]
    if blocker:
        objects.append({"name": "lazy", "shape": cube, "start": {"on": "table", "X_WO": pose(0.0, -0.2, 0.025)}})
    return {
        "mrtamp": 1,
        "name": "blocked",
        "robots": [{"name": "arm", "model": "panda", "X_WB": pose(-0.5, 0, 0)}],
        "world": [{"name": "table", "shape": {"box": [1.6, 1.4, 0.1]}, "X_WB": pose(0, 0, -0.05)}],
        "objects": objects,
        "goal": [{"object": "red", "at": pose(0.01, -0.21, 0.025), "on": "table"}],
    }


@pytest.mark.parametrize("blocker", [False, True])
def test_penalties_count_what_is_in_the_way_where_things_are_now(blocker: bool) -> None:
    planner = planner_for(problem_from_dict(blocked_problem(blocker=blocker)))
    ways = grown(planner, 3)
    assert ways
    assert {w.penalty for w in ways} == {BLOCKED if blocker else 0.0}


def test_sets_of_ways_keep_growing_up_to_their_limit_and_keep_the_short_ones() -> None:
    planner = planner_for(pick_place(1, 1))
    sizes, shortest = [], []
    for _ in range(12):
        planner.skeletons.grow(80, 30)
        [known] = planner.skeletons.ways.of.values()
        sizes.append(len(known))
        shortest.append(min(planner.skeletons.ways.length(w) for w in known))
    assert sizes[-1] > 60 and max(sizes) <= 160
    assert shortest == sorted(shortest, reverse=True)
