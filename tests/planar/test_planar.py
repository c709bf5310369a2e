"""The exact shortest paths of discs: against closed forms, and against polygons searched by other means."""

from __future__ import annotations

import itertools

import networkx as nx
import numpy as np
import pytest

from mrtamp.planar import shortest_path, visibility_graph
from mrtamp.problem import MrtampError

R = 0.2


def box(x: float, y: float, width: float, height: float, turn: float = 0.0) -> np.ndarray:
    """Corners of a box, counter-clockwise."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [width / 2, height / 2]
    c, s = np.cos(turn), np.sin(turn)
    return corners @ np.array([[c, s], [-s, c]]) + [x, y]


def length(walls: list[np.ndarray], a: np.ndarray, b: np.ndarray, radius: float = R) -> float:
    graph = visibility_graph(walls, radius, {"a": a, "b": b})
    return shortest_path(graph, "a", "b")[0]


def test_nothing_in_the_way_is_a_straight_line():
    a, b = np.array([-1.0, 0.0]), np.array([1.0, 1.0])
    assert length([box(0, -1, 1, 1)], a, b) == pytest.approx(np.sqrt(5))
    # A path may graze a wall.
    assert length([box(0, -0.7, 1, 1)], np.array([-1.0, 0.0]), np.array([1.0, 0.0])) == pytest.approx(2.0)


def test_around_a_corner_is_two_tangents_and_an_arc():
    """From the far side of a corner of a wide wall: sqrt(d^2 - r^2) to the arc on both sides, the arc in between."""
    wall = box(0, -1.0, 0.2, 2.0)  # its end is at y = 0
    half = 0.1
    a, b = np.array([-1.0, -0.5]), np.array([1.0, -0.5])
    d = np.hypot(1.0 - half, 0.5)
    tangent = np.sqrt(d**2 - R**2)
    # The angle at the corner from the vertical up to the point of contact.
    turn = np.pi / 2 + np.arctan2(0.5, 1 - half) - np.arccos(R / d)
    assert length([wall], a, b) == pytest.approx(2 * tangent + 2 * R * turn + 2 * half, abs=1e-12)


def test_between_two_walls_the_tangent_crosses_over():
    """An S around two points (tiny boxes): the crossing tangent has sin(angle) = 2 r / distance."""
    tiny = 1e-9
    walls = [box(-0.5, -0.5, tiny, 1.0), box(0.5, 0.5, tiny, 1.0)]  # ends at (-0.5, 0) and (0.5, 0)
    walls += [box(-0.5, 5.4, tiny, 10.0), box(0.5, -5.4, tiny, 10.0)]  # doors 0.4 wide, just as wide as the disc
    a, b = np.array([-2.0, R]), np.array([2.0, -R])
    lean = np.arcsin(2 * R)
    assert length(walls, a, b) == pytest.approx(2 * 1.5 + 2 * R * lean + np.sqrt(1 - 4 * R**2), abs=1e-6)


def test_a_gap_narrower_than_the_disc_is_closed_and_one_just_as_wide_is_open():
    a, b = np.array([-1.0, 0.0]), np.array([1.0, 0.0])
    for gap, open_ in ((0.399, False), (0.4, True), (0.401, True)):
        walls = [box(0, 1 + gap / 2, 0.2, 2), box(0, -1 - gap / 2, 0.2, 2)]
        assert (length(walls, a, b) == pytest.approx(2.0)) == open_


def test_the_room_bounds_the_way_round():
    wall = box(0, 0, 0.2, 2.0)
    sites = {"a": np.array([-1.0, 0.9]), "b": np.array([1.0, 0.9])}
    free = visibility_graph([wall], R, sites)
    below = visibility_graph([wall], R, sites, (np.array([-2.0, -2.0]), np.array([2.0, 1.1])))
    closed = visibility_graph([wall], R, sites, (np.array([-2.0, -1.1]), np.array([2.0, 1.1])))
    assert shortest_path(free, "a", "b")[0] < shortest_path(below, "a", "b")[0]
    with pytest.raises(MrtampError, match="cannot get from a to b"):
        shortest_path(closed, "a", "b")


def test_a_site_inside_a_grown_wall_is_refused():
    with pytest.raises(MrtampError, match=r"a at \(0.25, 0\) is not free"):
        visibility_graph([box(0, 0, 0.2, 0.2)], R, {"a": np.array([0.25, 0.0])})


def grown(wall: np.ndarray, n: int) -> np.ndarray:
    """A polygon around a wall grown by R: every arc becomes n tangents of it."""
    sides = np.roll(wall, -1, axis=0) - wall
    normals = np.arctan2(-sides[:, 0], sides[:, 1])
    points = []
    for i, corner in enumerate(wall):
        turn = (normals[i] - normals[i - 1]) % (2 * np.pi)
        angles = normals[i - 1] + (np.arange(n) + 0.5) * turn / n
        points += [corner + R / np.cos(turn / (2 * n)) * np.array([np.cos(t), np.sin(t)]) for t in angles]
    return np.array(points)


def polygon_length(walls: list[np.ndarray], a: np.ndarray, b: np.ndarray) -> float:
    """The shortest path among polygons, by the visibility graph of their corners; edges are tested by sampling."""
    polygons = [grown(wall, 12) for wall in walls]
    normals = []
    for p in polygons:
        side = np.roll(p, -1, axis=0) - p
        normals.append(np.column_stack([side[:, 1], -side[:, 0]]) / np.linalg.norm(side, axis=1)[:, None])

    def free(points: np.ndarray) -> bool:
        heights = ((points @ n.T - np.sum(p * n, axis=1)).max(axis=1) for p, n in zip(polygons, normals, strict=True))
        return all(h.min() > -1e-6 for h in heights)

    vertices = [a, b, *(v for p in polygons for v in p if free(v[None]))]
    graph = nx.Graph()
    graph.add_nodes_from((0, 1))
    t = np.linspace(0, 1, 400)[:, None]
    for (i, u), (j, v) in itertools.combinations(enumerate(vertices), 2):
        if free(u + t * (v - u)):
            graph.add_edge(i, j, length=float(np.linalg.norm(v - u)))
    return float(nx.shortest_path_length(graph, 0, 1, weight="length"))


@pytest.mark.parametrize("seed", range(4))
def test_agrees_with_polygons_searched_by_other_means(seed: int):
    rng = np.random.default_rng(seed)
    walls = [box(*rng.uniform(-1, 1, 2), *rng.uniform(0.2, 0.9, 2), rng.uniform(0, np.pi)) for _ in range(4)]
    a, b = np.array([-1.9, rng.uniform(-1, 1)]), np.array([1.9, rng.uniform(-1, 1)])
    graph = visibility_graph(walls, R, {"a": a, "b": b})
    exact, points = shortest_path(graph, "a", "b")
    around = polygon_length(walls, a, b)
    # The polygons lie around the arcs: never shorter, longer by at most what twelve tangents to a quarter turn cost.
    assert exact - 1e-6 <= around <= exact * 1.0015
    assert exact <= float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum()) <= exact * 1.0004
