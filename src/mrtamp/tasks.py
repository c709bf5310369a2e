"""Generated tasks: `pick_place`, for any number of robots from 1 to 8 and of objects from 1 to 24.

The paper's scalability task (section Experiments, Simple Pick-and-Place).  Robots stand on a ring around one table and
look inwards; every cube has its own start and its own goal pose.  A layout is solvable by construction: some robot
reaches both with a grasp from above, nothing stands within a gripper's width of anything else, and no goal is occupied.
"""

from __future__ import annotations

import colorsys
import itertools
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
    robots, objects
        How many: 1 to 8 and 1 to 24.
    layout_seed
        Chooses the layout; the same arguments give the same problem.

    Raises
    ------
    ProblemError
        A parameter is out of range.
    """
    from mrtamp.problem_file import problem_from_dict  # here, because problem_file lists this generator

    ensure_whole("pick_place", "robots", robots, 1, MAX_ROBOTS)
    ensure_whole("pick_place", "objects", objects, 1, MAX_OBJECTS)
    ensure_whole("pick_place", "layout_seed", layout_seed, 0)
    return problem_from_dict(pick_place_dict(robots, objects, layout_seed))


def ensure_whole(task: str, parameter: str, number: object, least: int, most: int | None = None) -> None:
    """Refuse a parameter of a generated task that is no whole number within its range, ends included."""
    if not isinstance(number, int) or number < least or (most is not None and number > most):
        upto = "" if most is None else f" to {most}"
        raise ProblemError(f"{task}: found {parameter}={number!r}, expected a whole number from {least}{upto}")


def pick_place_dict(robots: int, objects: int, layout_seed: int = 0) -> dict[str, Any]:
    """The problem of `pick_place` as the content of a problem file."""
    rng = np.random.default_rng([layout_seed, robots, objects])
    bases = ring(robots)
    starts, goals = _layout(bases, objects, rng)
    yaws = rng.uniform(-45.0, 45.0, size=(2, objects))
    side = round(2 * table_half_size(bases), 3)
    name = f"pick_place_{robots}_{objects}"
    return {
        "mrtamp": 1,
        "name": f"{name}_seed{layout_seed}" if layout_seed else name,
        "description": f"Simple pick and place: {robots} robots, {objects} cubes, layout {layout_seed}.",
        "robots": [
            {"name": f"arm{i + 1}", "model": "panda", "X_WB": pose(np.array([x, y]), 0.0, yaw)}
            for i, (x, y, yaw) in enumerate(bases)
        ],
        "world": [
            {
                "name": "table",
                "shape": {"box": [side, side, 0.1]},
                "X_WB": {"translation": [0.0, 0.0, -0.05]},
                "color": WOOD,
            }
        ],
        "objects": [
            {
                "name": f"cube{i + 1}",
                "shape": {"box": [CUBE] * 3},
                "color": color(i, objects),
                "start": {"on": "table", "X_WO": pose(starts[i], CUBE / 2, yaws[0, i])},
            }
            for i in range(objects)
        ],
        "goal": [
            {"object": f"cube{i + 1}", "at": pose(goals[i], CUBE / 2, yaws[1, i]), "on": "table"}
            for i in range(objects)
        ],
    }


def pose(xy: np.ndarray, z: float, yaw_deg: float) -> dict[str, Any]:
    """A pose as in a problem file, from a point (2,) and a height (m) and a turn about the vertical (degrees)."""
    rounded = [round(float(v), 4) for v in (*xy, z)]
    return {"translation": rounded, "rotation": {"rpy_deg": [0.0, 0.0, round(float(yaw_deg), 2)]}}


def color(i: int, n: int) -> list[float]:
    """The i-th of n colours that are easy to tell apart."""
    return [round(c, 3) for c in colorsys.hsv_to_rgb(i / n, 0.75, 0.85)]


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
