"""Generated tasks: `pick_place`, for any number of robots from 1 to 8 and of objects from 1 to 24.

The paper's scalability task (section Experiments, Simple Pick-and-Place).  Robots stand on a ring around one table and
look inwards; every cube has its own start and its own goal pose.  A layout is solvable by construction: some robot
reaches both with a grasp from above, nothing stands within a gripper's width of anything else, and no goal is occupied.
"""

from __future__ import annotations

import colorsys
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mrtamp.problem import Problem, ProblemError

MAX_ROBOTS = 8
MAX_OBJECTS = 24
CUBE = 0.05
WOOD = [0.82, 0.76, 0.68]
# Centres of two cubes this far apart leave 9 cm between parallel ones and 7 cm between corners: an open gripper fits.
SPACING = 0.1402
BASE_CLEARANCE = 0.30
# Distance between neighbouring bases on the ring: close enough to share a zone, far enough to pass each other.
NEIGHBOUR_DISTANCE = {2: 0.92, 3: 0.90, 4: 0.88}
DISTANT_NEIGHBOURS = 0.84
# The table reaches this far beyond the bases, and cubes keep clear of its edge.
TABLE_MARGIN = 0.40
SMALLEST_TABLE = 0.75
EDGE_CLEARANCE = 0.08


@dataclass(frozen=True)
class _Reach:
    """Where a robot comfortably grasps from above: an annulus of radii (m), within `azimuth` (rad) of its front."""

    near: float
    far: float
    azimuth: float


# A lone arm with many objects needs the room beside and behind it; the first that holds the layout is taken.
_REACHES = (
    _Reach(0.36, 0.60, np.radians(110)),
    _Reach(0.35, 0.62, np.radians(150)),
    _Reach(0.33, 0.65, np.radians(155)),
)
_POOL = 2000
_TRIES = 6


def pick_place(robots: int = 2, objects: int = 4, layout_seed: int = 0) -> Problem:
    """Robots around a table bring cubes from their starts to their goals (robots 1-8, objects 1-24).

    Parameters
    ----------
    robots, objects : how many, 1 to 8 and 1 to 24.
    layout_seed : chooses the layout; the same arguments give the same problem.

    Raises
    ------
    ProblemError : a parameter is out of range.
    """
    sizes = {"robots": Size(robots, 1, MAX_ROBOTS), "objects": Size(objects, 1, MAX_OBJECTS)}
    return generated("pick_place", pick_place_dict, layout_seed, **sizes)


@dataclass(frozen=True)
class Size:
    """How many of something a generated task is asked to have, and from how many to how many it may."""

    number: int
    least: int
    most: int


def generated(task: str, content: Callable[..., dict[str, Any]], layout_seed: int, **sizes: Size) -> Problem:
    """The problem that `content` makes of the sizes and the layout seed, once these are known to be valid.

    Raises
    ------
    ProblemError : one of them is no whole number, or out of its range.
    """
    from mrtamp.problem_file import problem_from_dict  # here, because problem_file lists the generators

    for name, size in sizes.items():
        if not _is_whole(size.number) or not size.least <= size.number <= size.most:
            valid = f"a whole number from {size.least} to {size.most}"
            raise ProblemError(f"{task}: found {name}={size.number!r}, expected {valid}")
    if not _is_whole(layout_seed) or layout_seed < 0:
        raise ProblemError(f"{task}: found layout_seed={layout_seed!r}, expected a whole number from 0")
    return problem_from_dict(content(**{name: size.number for name, size in sizes.items()}, layout_seed=layout_seed))


def _is_whole(number: object) -> bool:
    return isinstance(number, int) and not isinstance(number, bool)


def pick_place_dict(robots: int, objects: int, layout_seed: int = 0) -> dict[str, Any]:
    """The problem of `pick_place` as the content of a problem file."""
    rng = np.random.default_rng([layout_seed, robots, objects])
    bases = ring(robots)
    starts, goals = _layout(bases, objects, rng)
    yaws = rng.uniform(-45.0, 45.0, size=(2, objects))
    return {
        "mrtamp": 1,
        "name": problem_name("pick_place", layout_seed, robots, objects),
        "description": f"Simple pick and place: {robots} robots, {objects} cubes, layout {layout_seed}.",
        "robots": panda_arms(bases, [f"arm{i + 1}" for i in range(robots)]),
        "world": [table_around(bases)],
        "objects": cubes(starts, yaws[0]),
        "goal": [
            {"object": f"cube{i + 1}", "at": pose(goals[i], CUBE / 2, yaws[1, i]), "on": "table"}
            for i in range(objects)
        ],
    }


# -- parts of problem files -------------------------------------------------------------------------------------------


def problem_name(task: str, layout_seed: int, *sizes: int) -> str:
    """The name of a generated problem; the first layout is the one without a seed in its name."""
    return "_".join([task, *map(str, sizes), *([f"seed{layout_seed}"] if layout_seed else [])])


def panda_arms(bases: np.ndarray, names: Sequence[str]) -> list[dict[str, Any]]:
    """Pandas at `bases` (robots, 3): x, y (m) and yaw (degrees)."""
    return [
        {"name": name, "model": "panda", "X_WB": pose(base[:2], 0.0, base[2])}
        for name, base in zip(names, bases, strict=True)
    ]


def table(name: str, size: Sequence[float], x: float = 0.0) -> dict[str, Any]:
    """A table of `size` (2,) with its top at height 0 and its middle at (x, 0) (m)."""
    X_WB = {"translation": [x, 0.0, -0.05]}
    return {"name": name, "shape": {"box": [*size, 0.1]}, "X_WB": X_WB, "color": WOOD}


def table_around(bases: np.ndarray) -> dict[str, Any]:
    """The square table that carries the `bases`."""
    side = round(2 * table_half_size(bases), 3)
    return table("table", [side, side])


def cubes(starts: np.ndarray, yaws: np.ndarray) -> list[dict[str, Any]]:
    """Cubes of different colours on the table, at points (n, 2) (m) and turned by angles (n,) (degrees)."""
    return [
        {
            "name": f"cube{i + 1}",
            "shape": {"box": [CUBE] * 3},
            "color": color(i, len(starts)),
            "start": {"on": "table", "X_WO": pose(start, CUBE / 2, yaw)},
        }
        for i, (start, yaw) in enumerate(zip(starts, yaws, strict=True))
    ]


def pose(xy: np.ndarray, z: float, yaw_deg: float) -> dict[str, Any]:
    """A pose as in a problem file, from a point (2,) and a height (m) and a turn about the vertical (degrees)."""
    rounded = [round(float(v), 4) for v in (*xy, z)]
    return {"translation": rounded, "rotation": {"rpy_deg": [0.0, 0.0, round(float(yaw_deg), 2)]}}


def color(i: int, n: int) -> list[float]:
    """The i-th of n colours that are easy to tell apart."""
    return [round(c, 3) for c in colorsys.hsv_to_rgb(i / n, 0.75, 0.85)]


# -- layouts ----------------------------------------------------------------------------------------------------------


def ring(robots: int) -> np.ndarray:
    """Bases (robots, 3) as x, y (m) and yaw (degrees), evenly on a ring around the origin, looking inwards."""
    if robots == 1:
        return np.zeros((1, 3))
    angles = np.pi + 2 * np.pi * np.arange(robots) / robots
    radius = NEIGHBOUR_DISTANCE.get(robots, DISTANT_NEIGHBOURS) / (2 * np.sin(np.pi / robots))
    return np.column_stack([radius * np.cos(angles), radius * np.sin(angles), np.degrees(angles) - 180])


def table_half_size(bases: np.ndarray) -> float:
    """Half the side (m) of the square table that carries the `bases`."""
    return max(float(np.abs(bases[:, :2]).max()) + TABLE_MARGIN, SMALLEST_TABLE)


def _layout(bases: np.ndarray, objects: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Starts and goals (objects, 2), each pair within reach of one robot; about half where a second one reaches too."""
    extent = table_half_size(bases) - EDGE_CLEARANCE
    # A lattice holds more than random throws do, but looks regular: only where throws do not fit.
    for reach, regular in itertools.product(_REACHES, (False, True)):
        for _ in range(_TRIES):
            pool = _lattice(extent, rng) if regular else rng.uniform(-extent, extent, size=(_POOL * len(bases), 2))
            spots = _choose(bases, objects, reach, pool, rng)
            if spots is not None:
                return spots[0], spots[1]
    raise ProblemError(f"pick_place: no layout for {len(bases)} robots and {objects} objects")  # pragma: no cover


def _choose(
    bases: np.ndarray, objects: int, reach: _Reach, pool: np.ndarray, rng: np.random.Generator
) -> np.ndarray | None:
    """Starts and goals (2, objects, 2) out of the points `pool` (n, 2); None when some object finds no free one."""
    owners = rng.permutation(np.arange(objects) % len(bases))
    shared_wanted = rng.permutation(np.arange(objects) < (objects + 1) // 2)
    reached = reachable(bases, pool, reach.near, reach.far, reach.azimuth)
    away = np.linalg.norm(pool[:, None] - bases[None, :, :2], axis=2).min(axis=1) > BASE_CLEARANCE
    free = away & reached.any(axis=1)
    spots = np.zeros((2, objects, 2))
    for i in range(objects):
        for kind in range(2):
            candidates = free & reached[:, owners[i]]
            shared = candidates & (reached.sum(axis=1) > 1)
            if shared_wanted[i] and shared.any():
                candidates = shared
            indices = np.flatnonzero(candidates)
            if len(indices) == 0:
                return None
            spots[kind, i] = pool[rng.choice(indices)]
            free &= np.linalg.norm(pool - spots[kind, i], axis=1) >= SPACING
    return spots


def _lattice(extent: float, rng: np.random.Generator) -> np.ndarray:
    """Points (n, 2) of a hexagonal lattice, at a random place and angle, inside the square of half size `extent`."""
    step = SPACING * 1.002
    count = int(np.ceil(2 * extent / step)) + 2
    i, j = np.meshgrid(np.arange(-count, count + 1), np.arange(-count, count + 1))
    points = step * np.column_stack([(i + j / 2).ravel(), (np.sqrt(0.75) * j).ravel()]) + rng.uniform(0, step, size=2)
    angle = rng.uniform(0, np.pi / 3)
    points = points @ np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    inside: np.ndarray = points[np.abs(points).max(axis=1) <= extent]
    return inside


def reachable(bases: np.ndarray, points: np.ndarray, near: float, far: float, azimuth: float) -> np.ndarray:
    """Which robot (columns) comfortably reaches which of the `points` (n, 2) (rows): a boolean (n, robots)."""
    offset = points[:, None] - bases[None, :, :2]
    distance = np.linalg.norm(offset, axis=2)
    bearing = np.arctan2(offset[..., 1], offset[..., 0]) - np.radians(bases[None, :, 2])
    bearing = np.abs((bearing + np.pi) % (2 * np.pi) - np.pi)
    within: np.ndarray = (distance >= near) & (distance <= far) & (bearing <= azimuth)
    return within
