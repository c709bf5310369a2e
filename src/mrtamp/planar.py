"""Exact shortest paths of a disc among walls, by a curved visibility graph.

The centre of a disc of radius r keeps r away from every wall, so the walls grow into shapes of straight sides and round
corners.  A shortest path between two points is a chain of straight lines, tangent to the round corners, and arcs around
these: the lines and arcs that are free are a finite graph, and its shortest path is exact up to rounding.  What the
planner finds on discs is measured against it (paper, section on the 2D environment).

Walls are convex polygons, given as their corners (m, 2) in counter-clockwise order; lengths are metres.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import networkx as nx
import numpy as np

from mrtamp.problem import MrtampError

_EPSILON = 1e-9
"""Rounding (m, rad): a path may touch a wall."""
_ARC_STEP = np.pi / 48


@dataclass(frozen=True, eq=False)
class _Wall:
    """A convex polygon: corners (m, 2); outward normal (m, 2) and offset (m,) of the side that starts at each."""

    corners: np.ndarray
    outward: np.ndarray
    offset: np.ndarray

    @staticmethod
    def of(corners: np.ndarray) -> _Wall:
        sides = np.roll(corners, -1, axis=0) - corners
        outward = np.column_stack([sides[:, 1], -sides[:, 0]]) / np.linalg.norm(sides, axis=1)[:, None]
        return _Wall(corners, outward, np.sum(corners * outward, axis=1))


@dataclass(frozen=True, eq=False)
class Corner:
    """A round corner of a grown wall: its centre (2,), the angle (rad) at which its arc starts, and how far it goes."""

    centre: np.ndarray
    start: float
    extent: float

    def at(self, angle: float, radius: float) -> np.ndarray:
        """The point (2,) at `angle` from the start of the arc."""
        return self.centre + radius * _direction(self.start + angle)


def visibility_graph(
    walls: Sequence[np.ndarray],
    radius: float,
    sites: Mapping[str, np.ndarray],
    room: tuple[np.ndarray, np.ndarray] | None = None,
) -> nx.Graph:
    """The curved visibility graph of a disc.

    Parameters
    ----------
    walls : corners (m, 2) of convex polygons, counter-clockwise; walls may touch or overlap.
    radius : radius of the disc.
    sites : name -> point (2,) that paths start or end at.
    room : lower and upper corner (2,) of the rectangle in which the disc's centre stays.

    Returns
    -------
    A graph whose vertices are the names of the sites and (corner, number) for tangent points; its edges carry `length`
    (m) and `points`, the polyline (k, 2) from the lower to the higher `rank` of the ends; arcs are replaced by polygons
    around them.

    Raises
    ------
    MrtampError : a site is not free.
    """
    solids = [_Wall.of(np.asarray(wall, dtype=float)) for wall in walls]

    def free(a: np.ndarray, b: np.ndarray) -> bool:
        return _inside(a, room) and _inside(b, room) and all(_is_clear(a, b, wall, radius) for wall in solids)

    for name, p in sites.items():
        if not free(p, p):
            raise MrtampError(f"{name} at ({p[0]:g}, {p[1]:g}) is not free for a disc of radius {radius:g} m")
    graph = nx.Graph()
    corners = [corner for wall in solids for corner in _corners(wall)]
    tangents: list[list[tuple[float, object]]] = [[] for _ in corners]

    def tangent(k: int, point: np.ndarray) -> object:
        angle = _angle(point - corners[k].centre) - corners[k].start
        node = (k, len(tangents[k]))
        tangents[k].append((min((angle + _EPSILON) % (2 * np.pi) - _EPSILON, corners[k].extent), node))
        graph.add_node(node, rank=graph.number_of_nodes())
        return node

    def join(u: object, v: object, points: np.ndarray, length: float) -> None:
        graph.add_edge(u, v, length=length, points=points)

    for name in sites:
        graph.add_node(name, rank=graph.number_of_nodes())
    for (u, a), (v, b) in itertools.combinations(sites.items(), 2):
        if free(a, b):
            join(u, v, np.array([a, b]), float(np.linalg.norm(b - a)))
    for (name, p), (k, corner) in itertools.product(sites.items(), enumerate(corners)):
        for t in _tangents_from_point(p, corner.centre, radius):
            if _on(corner, t) and free(p, t):
                join(name, tangent(k, t), np.array([p, t]), float(np.linalg.norm(t - p)))
    for (k, one), (m, two) in itertools.combinations(enumerate(corners), 2):
        for t1, t2 in _common_tangents(one.centre, two.centre, radius):
            if _on(one, t1) and _on(two, t2) and free(t1, t2):
                join(tangent(k, t1), tangent(m, t2), np.array([t1, t2]), float(np.linalg.norm(t2 - t1)))
    for corner, contacts in zip(corners, tangents, strict=True):
        contacts.sort(key=lambda item: item[0])
        for (low, one_end), (high, other_end) in itertools.pairwise(contacts):
            if _arc_is_free(corner, low, high, radius, solids, free):
                around = _around(corner, low, high, radius)
                forward = graph.nodes[one_end]["rank"] < graph.nodes[other_end]["rank"]
                join(one_end, other_end, around if forward else around[::-1], radius * (high - low))
    return graph


def shortest_path(graph: nx.Graph, start: str, end: str) -> tuple[float, np.ndarray]:
    """Length (m) and polyline (k, 2) of the shortest path between two sites of a visibility graph.

    The polyline runs around the arcs, at least the disc's radius from every wall, and is longer by less than 0.04 %.

    Raises
    ------
    MrtampError : there is no path.
    """
    try:
        length, nodes = nx.single_source_dijkstra(graph, start, end, weight="length")
    except nx.NetworkXNoPath:
        raise MrtampError(f"a disc cannot get from {start} to {end}") from None
    points = []
    for u, v in itertools.pairwise(nodes):
        forward = graph.nodes[u]["rank"] < graph.nodes[v]["rank"]
        points.append(graph.edges[u, v]["points"][:: 1 if forward else -1])
    if not points:
        raise MrtampError(f"a path from {start} to itself has no points")
    return float(length), np.concatenate(points)


# -- pieces ----------------------------------------------------------------------------------------------------------


def _direction(angle: float) -> np.ndarray:
    return np.array([np.cos(angle), np.sin(angle)])


def _angle(v: np.ndarray) -> float:
    return float(np.arctan2(v[1], v[0]))


def _corners(wall: _Wall) -> Iterator[Corner]:
    """The corners of a wall: each arc goes from the normal of one side to that of the next."""
    normals = np.arctan2(wall.outward[:, 1], wall.outward[:, 0])
    for i, centre in enumerate(wall.corners):
        yield Corner(centre, float(normals[i - 1]), float((normals[i] - normals[i - 1]) % (2 * np.pi)))


def _on(corner: Corner, point: np.ndarray) -> bool:
    angle = (_angle(point - corner.centre) - corner.start + _EPSILON) % (2 * np.pi)
    return bool(angle <= corner.extent + 2 * _EPSILON)


def _tangents_from_point(p: np.ndarray, centre: np.ndarray, radius: float) -> Iterator[np.ndarray]:
    distance = float(np.linalg.norm(p - centre))
    if distance < radius - _EPSILON:
        return
    half = np.arccos(min(radius / distance, 1.0))
    for sign in (-1, 1):
        yield centre + radius * _direction(_angle(p - centre) + sign * half)


def _common_tangents(c1: np.ndarray, c2: np.ndarray, radius: float) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Points of contact of the tangents that two circles of one radius share: one on each side, two that cross over."""
    distance = float(np.linalg.norm(c2 - c1))
    if distance < _EPSILON:
        return
    along = _angle(c2 - c1)
    for sign in (-1, 1):
        u = radius * _direction(along + sign * np.pi / 2)
        yield c1 + u, c2 + u
        if distance >= 2 * radius:
            u = radius * _direction(along + sign * np.arccos(2 * radius / distance))
            yield c1 + u, c2 - u


def _inside(p: np.ndarray, room: tuple[np.ndarray, np.ndarray] | None) -> bool:
    return room is None or bool(np.all(p >= room[0] - _EPSILON) and np.all(p <= room[1] + _EPSILON))


def _is_clear(a: np.ndarray, b: np.ndarray, wall: _Wall, radius: float) -> bool:
    """Whether the segment a b keeps `radius` from a wall."""
    least = radius - _EPSILON
    heights = np.column_stack([wall.outward @ a, wall.outward @ b]) - wall.offset[:, None]
    if heights.min(axis=1).max() >= least:
        return True
    # Clip the segment to the polygon: what is left lies inside.
    low, high = 0.0, 1.0
    for ha, hb in heights.tolist():
        if ha > 0 and hb > 0:
            low, high = 1.0, 0.0
        elif ha > 0:
            low = max(low, ha / (ha - hb))
        elif hb > 0:
            high = min(high, ha / (ha - hb))
    if low <= high:
        return False
    ends = np.roll(wall.corners, -1, axis=0)
    gaps = [_gap(corner, a, b) for corner in wall.corners]
    gaps += [_gap(p, c, d) for p in (a, b) for c, d in zip(wall.corners, ends, strict=True)]
    return min(gaps) >= least


def _gap(p: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    """Distance of the point p from the segment a b."""
    d = b - a
    square = float(d @ d)
    t = 0.0 if square == 0 else min(max(float((p - a) @ d) / square, 0.0), 1.0)
    return float(np.hypot(*(p - a - t * d)))


def _arc_is_free(
    corner: Corner,
    a: float,
    b: float,
    radius: float,
    walls: Sequence[_Wall],
    free: Callable[[np.ndarray, np.ndarray], bool],
) -> bool:
    """Whether the arc between the angles a <= b of a corner keeps `radius` from all walls and stays in the room.

    It can only enter or leave a grown wall where its circle meets one of the lines and circles that bound that, and is
    furthest along x and y at multiples of a right angle: one point between every two such places decides.
    """
    cuts = [k * np.pi / 2 for k in range(4)]
    for wall in walls:
        for p, n in zip(wall.corners, wall.outward, strict=True):
            between = p - corner.centre
            height = float(between @ n) / radius + 1
            half = float(np.hypot(*between)) / (2 * radius)
            if abs(height) <= 1:
                cuts += [_angle(n) + sign * np.arccos(height) for sign in (-1, 1)]
            if 0 < half <= 1:
                cuts += [_angle(between) + sign * np.arccos(half) for sign in (-1, 1)]
    inner = [cut for cut in ((c - corner.start) % (2 * np.pi) for c in cuts) if a < cut < b]
    stations = sorted({a, b, *inner})
    stations += [(c + d) / 2 for c, d in itertools.pairwise(stations)]
    return all(free(p, p) for p in (corner.at(angle, radius) for angle in stations))


def _around(corner: Corner, a: float, b: float, radius: float) -> np.ndarray:
    """A polyline (k, 2) from angle a to b of a corner, its sides tangent to the arc."""
    n = max(1, int(np.ceil((b - a) / _ARC_STEP)))
    half = (b - a) / (2 * n)
    outer = [corner.at(a + (2 * i + 1) * half, radius / np.cos(half)) for i in range(n)]
    return np.array([corner.at(a, radius), *outer, corner.at(b, radius)])
