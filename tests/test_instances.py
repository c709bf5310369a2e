"""Generated families: layouts load, start and end free of collision, keep what their task is about, and are solved."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from mrtamp.check import check_plan
from mrtamp.collision import Counts
from mrtamp.incumbent import Incumbent
from mrtamp.instances import (
    box_layout,
    box_layout_dict,
    clutter,
    clutter_dict,
    handover_layout,
    handover_layout_dict,
    stacking_layout,
    stacking_layout_dict,
)
from mrtamp.planner import Planner
from mrtamp.problem import Problem, ProblemError
from mrtamp.problem_file import list_problems, load_problem, problem_from_dict, problem_to_dict
from mrtamp.tasks import pick_place_dict

Data = dict[str, Any]

# Between these radii a Panda grasps a low object from above; farther than the third, a hand that points down is not.
NEAR, FAR, OUT_OF_REACH = 0.32, 0.66, 0.78
LAYOUTS = range(3)
FAMILIES: dict[str, Callable[[int], Data]] = {
    "box_layout": box_layout_dict,
    **{f"handover_layout {n}": lambda seed, n=n: handover_layout_dict(n, seed) for n in (1, 4)},  # type: ignore[misc]
    **{
        f"stacking_layout {r} {n}": lambda seed, r=r, n=n: stacking_layout_dict(r, n, seed)  # type: ignore[misc]
        for r, n in ((2, 2), (2, 6), (3, 6))
    },
    **{
        f"clutter {r} {n}": lambda seed, r=r, n=n: clutter_dict(r, n, seed)  # type: ignore[misc]
        for r, n in ((2, 6), (3, 1), (4, 6))
    },
}
EVERY_FAMILY = pytest.mark.parametrize("family", FAMILIES)


def xy(pose: Data) -> np.ndarray:
    """The point (2,) of a pose as in a problem file."""
    return np.array(pose["translation"][:2])


def base_distances(data: Data, point: np.ndarray) -> dict[str, float]:
    """How far (m) a point is from the base of every robot."""
    return {robot["name"]: float(np.linalg.norm(xy(robot["X_WB"]) - point)) for robot in data["robots"]}


def starts_and_goals(data: Data) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 2) each, of objects that start and end at poses."""
    goals = {condition["object"]: xy(condition["at"]) for condition in data["goal"]}
    names = [thing["name"] for thing in data["objects"]]
    return np.array([xy(t["start"]["X_WO"]) for t in data["objects"]]), np.array([goals[name] for name in names])


def least_distance(points: np.ndarray) -> float:
    """Of any two of the points (n, 2)."""
    return min(float(np.linalg.norm(a - b)) for a, b in itertools.combinations(points, 2))


def at_the_goal(data: Data) -> Data:
    """The same scene with every object where it shall end: a start that has to be as valid as the given one."""
    ended = copy.deepcopy(data)
    goals = {condition["object"]: condition for condition in data["goal"]}
    sizes = {thing["name"]: thing["shape"]["box"] for thing in data["objects"]}

    def pose(name: str) -> Data:
        goal = goals[name]
        if "at" in goal:
            return dict(goal["at"])
        below = copy.deepcopy(pose(goal["on"]))
        below["translation"][2] += (sizes[goal["on"]][2] + sizes[name][2]) / 2
        return below

    for i, thing in enumerate(ended["objects"]):
        goal = goals[thing["name"]]
        if "in" in goal:
            thing["start"] = {"in": goal["in"], "xy": [0.1 * i - 0.05, 0.0]}
        else:
            thing["start"] = {"on": goal["on"], "X_WO": pose(thing["name"])}
    return ended


@EVERY_FAMILY
@pytest.mark.parametrize("seed", LAYOUTS)
def test_start_and_goal_are_free_of_collision(family: str, seed: int) -> None:
    data = FAMILIES[family](seed)
    for scene in (data, at_the_goal(data)):
        problem = problem_from_dict(scene)
        Incumbent(problem, 0, Counts()).check_start()


def test_a_scene_in_collision_would_be_noticed() -> None:
    data = clutter_dict(2, 2, 0)
    data["world"][1]["X_WB"] = {"translation": [*xy(data["goal"][0]["at"]), 0.05]}
    Incumbent(problem_from_dict(data), 0, Counts()).check_start()
    with pytest.raises(Exception, match="the start is not valid"):
        Incumbent(problem_from_dict(at_the_goal(data)), 0, Counts()).check_start()


@EVERY_FAMILY
def test_layouts_depend_on_the_seed_and_on_nothing_else(family: str) -> None:
    make = FAMILIES[family]
    assert make(1) == make(1)
    layouts = [make(seed) for seed in range(6)]
    for one, two in itertools.combinations(layouts, 2):
        assert one["name"] != two["name"]
        assert one["objects"] != two["objects"]


@pytest.mark.parametrize(
    ("generator", "parameters"),
    [
        (box_layout, {"layout_seed": 3}),
        (handover_layout, {"objects": 3, "layout_seed": 5}),
        (stacking_layout, {"robots": 3, "objects": 3, "layout_seed": 1}),
        (clutter, {"robots": 3, "objects": 2, "layout_seed": 2}),
    ],
)
def test_families_are_loaded_by_name(generator: Callable[..., Problem], parameters: dict[str, int]) -> None:
    name = generator.__name__
    problem = load_problem(name, **parameters)
    assert problem_to_dict(problem) == problem_to_dict(generator(**parameters))
    assert len(problem.robots) == parameters.get("robots", 2)
    assert len(problem.objects) == parameters.get("objects", 2)
    assert "at random" in list_problems()[name] or name == "clutter"


@pytest.mark.parametrize(
    ("name", "parameters", "message"),
    [
        ("clutter", {"robots": 1}, "clutter: found robots=1, expected a whole number from 2 to 4"),
        ("clutter", {"objects": 7}, "clutter: found objects=7, expected a whole number from 1 to 6"),
        ("clutter", {"layout_seed": -1}, "clutter: found layout_seed=-1, expected a whole number from 0"),
        ("box_layout", {"layout_seed": 0.5}, "box_layout: found layout_seed=0.5, expected a whole number from 0"),
        ("box_layout", {"robots": 2}, "box_layout: found the unknown parameter 'robots', .*layout_seed"),
        ("handover_layout", {"objects": 5}, "handover_layout: found objects=5, expected a whole number from 1 to 4"),
        ("stacking_layout", {"objects": 1}, "stacking_layout: found objects=1, expected a whole number from 2 to 6"),
        ("stacking_layout", {"robots": 4}, "stacking_layout: found robots=4, expected a whole number from 2 to 3"),
        (
            "box",
            {"layout_seed": 1},
            "found the parameters layout_seed for box, expected none: only pick_place, clutter",
        ),
    ],
)
def test_wrong_parameters(name: str, parameters: dict[str, Any], message: str) -> None:
    with pytest.raises(ProblemError, match=message):
        load_problem(name, **parameters)


# What each task is about.


@pytest.mark.parametrize("seed", range(20))
def test_box_admits_one_hand_and_is_reached_by_both_arms(seed: int) -> None:
    data = box_layout_dict(seed)
    world = {body["name"]: body for body in data["world"]}
    box, (target,) = xy(world["box_floor"]["X_WB"]), [xy(s["X_BS"]) for s in data["supports"] if s["name"] == "target"]
    for place in (box, target):
        assert all(NEAR < d < FAR for d in base_distances(data, place).values())
    # A hand is 20.4 cm wide: along the box it fits, with its middle over either cube; across the box it does not.
    inside = np.array(world["box_floor"]["shape"]["box"][:2])
    spots = np.array([thing["start"]["xy"] for thing in data["objects"]])
    assert inside[0] < 0.204
    assert (np.abs(spots[:, 1]) + 0.102 < inside[1] / 2).all()
    # Two hands pointing down need 9 cm between their flanges; a grasp slides by 1 cm.
    across = np.abs(spots[0, 0] - spots[1, 0])
    assert 0.044 < across < 0.088 - 0.02
    # Opposite walls are as far apart as the floor is wide, wherever the box stands and however it is turned.
    for (one, two), clear in zip((("left", "right"), ("near", "far")), inside, strict=True):
        gap = np.linalg.norm(xy(world[f"box_wall_{one}"]["X_WB"]) - xy(world[f"box_wall_{two}"]["X_WB"]))
        assert gap == pytest.approx(clear + 0.01, abs=2e-4)


@pytest.mark.parametrize(("objects", "seed"), list(itertools.product(range(1, 5), range(8))))
def test_bars_have_to_change_hands(objects: int, seed: int) -> None:
    data = handover_layout_dict(objects, seed)
    starts, goals = starts_and_goals(data)
    givers = set()
    for start, goal in zip(starts, goals, strict=True):
        (giver,) = [r for r, d in base_distances(data, start).items() if d < OUT_OF_REACH]
        (receiver,) = [r for r, d in base_distances(data, goal).items() if d < OUT_OF_REACH]
        assert giver != receiver
        assert NEAR < base_distances(data, start)[giver] < FAR
        assert NEAR < base_distances(data, goal)[receiver] < FAR
        givers.add(giver)
    assert len(givers) == min(objects, 2), "from two on they go both ways"
    assert least_distance(np.vstack([starts, goals])) >= 0.29


@pytest.mark.parametrize(("robots", "objects"), list(itertools.product((2, 3), range(2, 7))))
def test_one_tower_within_reach_of_everybody(robots: int, objects: int) -> None:
    orders = set()
    for seed in range(6):
        data = stacking_layout_dict(robots, objects, seed)
        (bottom,) = [c for c in data["goal"] if "at" in c]
        on = {c["on"]: c["object"] for c in data["goal"] if c is not bottom}
        tower = [bottom["object"]]
        while tower[-1] in on:
            tower.append(on[tower[-1]])
        assert sorted(tower) == sorted(thing["name"] for thing in data["objects"])
        orders.add(tuple(tower))
        middle = xy(bottom["at"])
        assert all(NEAR < d < FAR for d in base_distances(data, middle).values())
        starts = np.array([xy(thing["start"]["X_WO"]) for thing in data["objects"]])
        for start in starts:
            assert any(NEAR < d < FAR for d in base_distances(data, start).values())
            assert np.linalg.norm(start - middle) >= 0.2
        assert least_distance(starts) >= 0.14
    assert len(orders) > 1


def rectangle_distance(body: Data, point: np.ndarray) -> float:
    """Horizontal distance (m) of a point (2,) from a box that stands upright."""
    yaw = np.radians(body["X_WB"]["rotation"]["rpy_deg"][2])
    x, y = point - xy(body["X_WB"])
    own = np.array([np.cos(yaw) * x + np.sin(yaw) * y, -np.sin(yaw) * x + np.cos(yaw) * y])
    return float(np.linalg.norm(np.maximum(np.abs(own) - np.array(body["shape"]["box"][:2]) / 2, 0.0)))


@pytest.mark.parametrize(("robots", "objects"), [(2, 1), (2, 6), (3, 6), (4, 6)])
def test_obstacles_leave_room_for_hands_and_stand_where_arms_move(robots: int, objects: int) -> None:
    for seed in LAYOUTS:
        data = clutter_dict(robots, objects, seed)
        obstacles = [body for body in data["world"] if body["name"].startswith("obstacle")]
        assert len(obstacles) == 2 * robots
        spots = np.vstack(starts_and_goals(data))
        for body in obstacles:
            # A hand turns freely: half of its width is 10.2 cm.
            assert min(rectangle_distance(body, spot) for spot in spots) > 0.11
            assert min(base_distances(data, xy(body["X_WB"])).values()) < FAR
            assert body["X_WB"]["translation"][2] == pytest.approx(body["shape"]["box"][2] / 2), "on the table"
        without = pick_place_dict(robots, objects, seed)
        assert (data["objects"], data["goal"]) == (without["objects"], without["goal"])


@pytest.mark.parametrize(
    "problem",
    [
        pytest.param(lambda: box_layout(5), id="box"),
        pytest.param(lambda: stacking_layout(2, 3, 1), id="stacking"),
        pytest.param(lambda: clutter(2, 2, 3), id="clutter"),
    ],
)
def test_layouts_are_solved(problem: Callable[[], Problem]) -> None:
    plan = next(iter(Planner(problem(), seed=0).improve(40.0, first=True)), None)
    assert plan is not None
    assert check_plan(plan).ok
