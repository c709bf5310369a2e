"""Generated families of the paper's other tasks, so that planners are compared on many layouts and not on one.

`box_layout`, `handover_layout` and `stacking_layout` are the shipped `box`, `handover` and `stacking` with everything
drawn at random that may differ without changing what the task is about; `clutter` is `pick_place` among obstacles.  The
layout seed has nothing to do with the planner's.  Layouts are solvable by construction, as in `mrtamp.tasks`: whatever
has to be reached is within comfortable reach of a robot that may take it there, and a hand from above finds room.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np

from mrtamp.problem import Problem, ProblemError
from mrtamp.tasks import (
    BASE_CLEARANCE,
    CUBE,
    EDGE_CLEARANCE,
    SPACING,
    Size,
    color,
    cubes,
    generated,
    panda_arms,
    pick_place_dict,
    pose,
    problem_name,
    reachable,
    ring,
    table,
    table_around,
    table_half_size,
)

_NEAR, _FAR, _AZIMUTH = 0.36, 0.62, np.radians(110)
"""Where a robot comfortably grasps from above: radii (m) around its base, angle to either side of its front."""
_POOL = 2000
"""Points drawn for one thing before the layout is begun anew."""
_LAYOUTS = 50
"""Layouts begun before giving up."""

# `clutter`.
CLUTTERED_ROBOTS, CLUTTERED_OBJECTS = (2, 4), (1, 6)
_OBSTACLES_PER_ROBOT = 2
_OBSTACLE_HEIGHT = (0.08, 0.26)
_OBSTACLE_SIDE = (0.04, 0.10)
# A hand that points down, 20 cm wide, turns freely over a cube when obstacles keep this far from its middle.
_HAND_ROOM = 0.13
_BETWEEN_OBSTACLES = 0.03

# `box_layout`: inner width and length, height of the walls and their thickness; of the shipped `box`.
_BOX_WIDTH, _BOX_LENGTH, _BOX_HEIGHT, _WALL = 0.18, 0.27, 0.11, 0.01
_BOXED_CUBE = 0.04
_TARGET = (0.28, 0.14)

# `handover_layout`.
MOST_BARS = 4
_BAR = (0.20, 0.04, 0.04)
# Two bars that lie in line, and an open gripper between them.
_BAR_SPACING = 0.30
_TABLE_X, _BASE_X = 0.7, 0.6
_TABLE_SIZE = (1.0, 1.4)

# `stacking_layout`.
STACKING_ROBOTS, STACKED_CUBES = (2, 3), (2, 6)
_TOWER_OFFSET = 0.05
_TOWER_CLEARANCE = 0.20


def clutter(robots: int = 2, objects: int = 4, layout_seed: int = 0) -> Problem:
    """Robots bring cubes from their starts to their goals among boxes that stand in the way (robots 2-4, objects 1-6).

    Parameters
    ----------
    robots, objects : how many, 2 to 4 and 1 to 6.
    layout_seed : chooses the layout, that of `pick_place` for the same seed, and the boxes.

    Raises
    ------
    ProblemError : a parameter is out of range.
    """
    sizes = {"robots": Size(robots, *CLUTTERED_ROBOTS), "objects": Size(objects, *CLUTTERED_OBJECTS)}
    return generated("clutter", clutter_dict, layout_seed, **sizes)


def box_layout(layout_seed: int = 0) -> Problem:
    """Two Pandas take two cubes out of a box that admits one gripper at a time: box, cubes and target region at random.

    Raises
    ------
    ProblemError : the layout seed is no whole number from 0.
    """
    return generated("box_layout", box_layout_dict, layout_seed)


def handover_layout(objects: int = 2, layout_seed: int = 0) -> Problem:
    """Two Pandas at separate tables exchange bars by handing them over: starts and goals at random (objects 1-4).

    Parameters
    ----------
    objects : how many bars, 1 to 4; from two on they go both ways.
    layout_seed : chooses the layout.

    Raises
    ------
    ProblemError : a parameter is out of range.
    """
    return generated("handover_layout", handover_layout_dict, layout_seed, objects=Size(objects, 1, MOST_BARS))


def stacking_layout(robots: int = 2, objects: int = 4, layout_seed: int = 0) -> Problem:
    """Robots build one tower of cubes: starts, order and the tower's place at random (robots 2-3, objects 2-6).

    Parameters
    ----------
    robots, objects : how many, 2 or 3, and 2 to 6.
    layout_seed : chooses the layout.

    Raises
    ------
    ProblemError : a parameter is out of range.
    """
    sizes = {"robots": Size(robots, *STACKING_ROBOTS), "objects": Size(objects, *STACKED_CUBES)}
    return generated("stacking_layout", stacking_layout_dict, layout_seed, **sizes)


# -- the problems as the content of problem files ---------------------------------------------------------------------


def clutter_dict(robots: int, objects: int, layout_seed: int = 0) -> dict[str, Any]:
    """The problem of `clutter` as the content of a problem file."""
    data = pick_place_dict(robots, objects, layout_seed)
    bases = ring(robots)
    spots = [thing["start"]["X_WO"]["translation"][:2] for thing in data["objects"]]
    spots += [condition["at"]["translation"][:2] for condition in data["goal"]]
    extent = table_half_size(bases) - EDGE_CLEARANCE

    def draw(rng: np.random.Generator) -> list[dict[str, Any]] | None:
        sizes = rng.uniform(
            [_OBSTACLE_SIDE[0]] * 2 + [_OBSTACLE_HEIGHT[0]],
            [_OBSTACLE_SIDE[1]] * 2 + [_OBSTACLE_HEIGHT[1]],
            size=(_OBSTACLES_PER_ROBOT * robots, 3),
        )
        radii = np.linalg.norm(sizes[:, :2], axis=1) / 2
        placed = np.zeros((0, 2))
        for i, radius in enumerate(radii):
            pool = _pool(rng, extent)
            free = reachable(bases, pool, BASE_CLEARANCE, _FAR, _AZIMUTH).any(axis=1)
            free &= _apart(pool, spots, _HAND_ROOM + radius) & _apart(pool, bases[:, :2], BASE_CLEARANCE + radius)
            free &= _apart(pool, placed, _BETWEEN_OBSTACLES + radius + radii[:i])
            if not free.any():
                return None
            placed = np.vstack([placed, pool[free][:1]])
        return [
            {
                "name": f"obstacle{i + 1}",
                "shape": {"box": [round(float(x), 3) for x in size]},
                "X_WB": pose(point, round(float(size[2]), 3) / 2, rng.uniform(-90, 90)),
                "color": [0.45, 0.47, 0.52],
            }
            for i, (point, size) in enumerate(zip(placed, sizes, strict=True))
        ]

    data["world"] += _first(draw, "clutter", layout_seed, robots, objects)
    data["name"] = problem_name("clutter", layout_seed, robots, objects)
    data["description"] = (
        f"Pick and place in clutter: {robots} robots, {objects} cubes, {_OBSTACLES_PER_ROBOT * robots} obstacles, "
        f"layout {layout_seed}."
    )
    return data


def box_layout_dict(layout_seed: int = 0) -> dict[str, Any]:
    """The problem of `box_layout` as the content of a problem file."""
    rng = np.random.default_rng([layout_seed, 2, 2])
    bases = np.array([[-0.5, 0.0, 0.0], [0.5, 0.0, 180.0]])
    side = rng.choice([-1.0, 1.0])
    box = np.array([rng.uniform(-0.06, 0.06), -side * rng.uniform(0.06, 0.14)])
    target = np.array([rng.uniform(-0.08, 0.08), side * rng.uniform(0.27, 0.32)])
    yaw = rng.uniform(-15, 15)
    turn = np.radians(yaw)
    axes = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])  # across the box, along it

    def wall(name: str, across: float, along: float, size: list[float]) -> dict[str, Any]:
        return {
            "name": name,
            "shape": {"box": size},
            "X_WB": pose(box + np.array([across, along]) @ axes, size[2] / 2, yaw),
            "color": [0.62, 0.44, 0.27],
        }

    across, along = (_BOX_WIDTH + _WALL) / 2, (_BOX_LENGTH + _WALL) / 2
    # Side by side, so near that two hands do not fit, and so central that one does.
    half_gap = rng.uniform(0.025, 0.028)
    shifts = rng.uniform(-0.018, 0.018, size=2)
    order = rng.permutation([-1.0, 1.0])
    return {
        "mrtamp": 1,
        "name": problem_name("box_layout", layout_seed),
        "description": f"Two Pandas take two cubes out of a box that admits one gripper, layout {layout_seed}.",
        "robots": panda_arms(bases, ("left", "right")),
        "world": [
            table("table", [1.6, 1.4]),
            wall("box_floor", 0, 0, [_BOX_WIDTH, _BOX_LENGTH, _WALL]),
            wall("box_wall_left", -across, 0, [_WALL, _BOX_LENGTH + 2 * _WALL, _BOX_HEIGHT]),
            wall("box_wall_right", across, 0, [_WALL, _BOX_LENGTH + 2 * _WALL, _BOX_HEIGHT]),
            wall("box_wall_near", 0, -along, [_BOX_WIDTH, _WALL, _BOX_HEIGHT]),
            wall("box_wall_far", 0, along, [_BOX_WIDTH, _WALL, _BOX_HEIGHT]),
        ],
        "supports": [
            {"name": "in_box", "on": "box_floor", "size": [0.12, 0.20]},
            {
                "name": "target",
                "on": "table",
                "X_BS": pose(target, 0.05, rng.uniform(-15, 15)),
                "size": list(_TARGET),
                "color": [0.05, 0.05, 0.05],
            },
        ],
        "objects": [
            {
                "name": name,
                "shape": {"box": [_BOXED_CUBE] * 3},
                "color": rgb,
                "start": {"in": "in_box", "xy": [round(float(order[i] * half_gap), 4), round(float(shifts[i]), 4)]},
            }
            for i, (name, rgb) in enumerate([("red", [0.85, 0.20, 0.18]), ("blue", [0.20, 0.40, 0.80])])
        ],
        "goal": [{"object": name, "in": "target"} for name in ("red", "blue")],
    }


def handover_layout_dict(objects: int, layout_seed: int = 0) -> dict[str, Any]:
    """The problem of `handover_layout` as the content of a problem file."""
    bases = np.array([[-_BASE_X, 0.0, 0.0], [_BASE_X, 0.0, 180.0]])
    names, tables = ("left", "right"), ("left_table", "right_table")
    inside = np.array(_TABLE_SIZE) / 2 - _BAR[0] / 2 - 0.02

    def draw(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        givers = rng.permutation((np.arange(objects) + rng.integers(2)) % 2)
        spots = np.zeros((2, objects, 2))
        taken: list[np.ndarray] = []
        for i in range(objects):
            for kind, side in enumerate((givers[i], 1 - givers[i])):
                middle = np.array([(-_TABLE_X, _TABLE_X)[side], 0.0])
                pool = _pool(rng, _TABLE_X + _TABLE_SIZE[0] / 2)
                free = reachable(bases[side : side + 1], pool, _NEAR, _FAR, _AZIMUTH)[:, 0]
                free &= (np.abs(pool - middle) <= inside).all(axis=1) & _apart(pool, taken, _BAR_SPACING)
                if not free.any():
                    return None
                spots[kind, i] = pool[free][0]
                taken.append(spots[kind, i])
        return givers, spots, rng.uniform(-90, 90, size=(2, objects))

    givers, spots, yaws = _first(draw, "handover_layout", layout_seed, objects)
    height = _BAR[2] / 2
    return {
        "mrtamp": 1,
        "name": problem_name("handover_layout", layout_seed, objects),
        "description": f"Two Pandas at separate tables hand over {objects} bars, layout {layout_seed}.",
        "robots": panda_arms(bases, names),
        "world": [table(name, _TABLE_SIZE, x) for name, x in zip(tables, (-_TABLE_X, _TABLE_X), strict=True)],
        "objects": [
            {
                "name": f"bar{i + 1}",
                "shape": {"box": list(_BAR)},
                "mass": 0.15,
                "color": color(i, objects),
                "start": {"on": tables[givers[i]], "X_WO": pose(spots[0, i], height, yaws[0, i])},
            }
            for i in range(objects)
        ],
        "goal": [
            {"object": f"bar{i + 1}", "at": pose(spots[1, i], height, yaws[1, i]), "on": tables[1 - givers[i]]}
            for i in range(objects)
        ],
    }


def stacking_layout_dict(robots: int, objects: int, layout_seed: int = 0) -> dict[str, Any]:
    """The problem of `stacking_layout` as the content of a problem file."""
    bases = ring(robots)
    extent = table_half_size(bases) - EDGE_CLEARANCE

    def draw(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
        tower = rng.uniform(-_TOWER_OFFSET, _TOWER_OFFSET, size=2)
        if not reachable(bases, tower[None], _NEAR, _FAR, _AZIMUTH).all():
            return None
        starts: list[np.ndarray] = []
        for _ in range(objects):
            pool = _pool(rng, extent)
            free = reachable(bases, pool, _NEAR, _FAR, _AZIMUTH).any(axis=1)
            free &= _apart(pool, starts, SPACING) & _apart(pool, [tower], _TOWER_CLEARANCE)
            free &= _apart(pool, bases[:, :2], BASE_CLEARANCE)
            if not free.any():
                return None
            starts.append(pool[free][0])
        return tower, np.array(starts), rng.permutation(objects), rng.uniform(-90, 90, size=objects + 1)

    tower, starts, order, yaws = _first(draw, "stacking_layout", layout_seed, robots, objects)
    things = cubes(starts, yaws[:-1])
    names = [thing["name"] for thing in things]
    return {
        "mrtamp": 1,
        "name": problem_name("stacking_layout", layout_seed, robots, objects),
        "description": f"{robots} robots build one tower of {objects} cubes, layout {layout_seed}.",
        "robots": panda_arms(bases, [f"arm{i + 1}" for i in range(robots)]),
        "world": [table_around(bases)],
        "objects": things,
        "goal": [
            {"object": names[order[0]], "at": pose(tower, CUBE / 2, yaws[-1]), "on": "table"},
            *({"object": names[upper], "on": names[lower]} for lower, upper in itertools.pairwise(order)),
        ],
    }


# -- parts ------------------------------------------------------------------------------------------------------------


def _first(draw: Callable[[np.random.Generator], Any], task: str, *seeds: int) -> Any:
    """What `draw` first makes that is no None, the layout seed and sizes being the seed of its random numbers."""
    rng = np.random.default_rng(seeds)
    for _ in range(_LAYOUTS):
        drawn = draw(rng)
        if drawn is not None:
            return drawn
    raise ProblemError(f"{task}: no layout for {seeds}")  # pragma: no cover


def _pool(rng: np.random.Generator, extent: float) -> np.ndarray:
    """Points (n, 2) of the square of half size `extent`, from which the first that fits is taken."""
    return rng.uniform(-extent, extent, size=(_POOL, 2))


def _apart(points: np.ndarray, others: Any, distance: Any) -> np.ndarray:
    """Which of the `points` (n, 2) are at least so far from all `others` (m, 2); a distance for all or for each."""
    gaps = np.linalg.norm(points[:, None] - np.asarray(others).reshape(-1, 2), axis=2)
    far: np.ndarray = (gaps >= distance).all(axis=1)
    return far
