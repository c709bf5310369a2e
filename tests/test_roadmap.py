"""Constituent roadmaps: shortest paths, lazy validation, resolution of edges, PRM* neighbours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import networkx as nx
import numpy as np
import pytest
from arena import arena

from mrtamp.collision import RESOLUTION, Collision, Counts, RobotWorld
from mrtamp.problem import MovableObject, Problem, Robot, Shape, StaticBody
from mrtamp.roadmap import Roadmap, ShortestPaths, add_stations, lazy_path, prm_star_neighbours, roadmaps_of
from mrtamp.robot_file import load_robot_model
from mrtamp.scene import RigidTransform


@pytest.fixture(scope="module")
def world() -> RobotWorld:
    panda = load_robot_model("panda")
    home = np.array(panda.home)
    return RobotWorld(
        Problem("alone", (Robot("arm", panda, RigidTransform(), home, home),), (), (), (), ()), "arm", Counts()
    )


@pytest.fixture
def roadmap(world: RobotWorld) -> Roadmap:
    """Home and 150 random configurations, more than fit into the first arrays."""
    out = Roadmap(world)
    out.add_vertex(world.home)
    for q in np.random.default_rng(0).uniform(world.chain.lower, world.chain.upper, size=(150, 7)):
        out.add_vertex(q)
    return out


def as_graph(roadmap: Roadmap, blocked: np.ndarray) -> nx.Graph:
    graph = nx.Graph()
    graph.add_nodes_from(range(roadmap.n_vertices))
    for e, (a, b) in enumerate(roadmap.ends):
        if not blocked[e] and a != b:
            graph.add_edge(int(a), int(b), weight=float(roadmap.w[e]))
    return graph


def length(roadmap: Roadmap, path: list[int]) -> float:
    return float(np.linalg.norm(np.diff(roadmap.q[path], axis=0), axis=1).sum())


def test_shortest_paths_are_dijkstras(roadmap: Roadmap) -> None:
    rng = np.random.default_rng(1)
    for share in (0.0, 0.5, 0.9):
        blocked = rng.random(roadmap.n_edges) < share
        graph = as_graph(roadmap, blocked)
        for goal in rng.integers(roadmap.n_vertices, size=15):
            path = roadmap.shortest(0, int(goal), blocked)
            if path is None:
                assert not nx.has_path(graph, 0, int(goal))
                continue
            assert path[0] == 0 and path[-1] == goal
            assert all(graph.has_edge(a, b) or a == b for a, b in pairwise(path))
            assert length(roadmap, path) == pytest.approx(nx.dijkstra_path_length(graph, 0, int(goal)))


@pytest.mark.parametrize("share", [0.0, 0.3, 0.6])
def test_lazy_validation_finds_the_shortest_valid_path(roadmap: Roadmap, share: float) -> None:
    rng = np.random.default_rng(2)
    invalid = rng.random(roadmap.n_edges) < share
    asked: list[int] = []

    def validate(e: int) -> bool:
        asked.append(e)
        return not invalid[e]

    blocked = np.zeros(roadmap.n_edges, dtype=bool)
    truth = as_graph(roadmap, invalid)
    for goal in (5, 50, 100):
        path = lazy_path(roadmap, 0, goal, blocked, validate, rounds=10_000)
        if path is None:
            assert not nx.has_path(truth, 0, goal)
        else:
            assert length(roadmap, path) == pytest.approx(nx.dijkstra_path_length(truth, 0, goal))
    assert np.all(invalid[blocked]), "only what failed is blocked"
    assert len(set(asked)) < 0.7 * roadmap.n_edges, "lazily"


def test_what_is_seen_at_a_glance_is_not_validated(roadmap: Roadmap) -> None:
    rng = np.random.default_rng(4)
    bad = rng.random(roadmap.n_vertices) < 0.2
    bad[[0, 5, 50, 100]] = False
    invalid = bad[roadmap.ends].any(axis=1) | (rng.random(roadmap.n_edges) < 0.1)
    asked: list[int] = []

    def glance(edges: Sequence[int]) -> list[int]:
        vertices = [v for v in roadmap.ends[list(edges)].ravel().tolist() if bad[v]]
        return roadmap.arcs(vertices[0])[1].tolist() if vertices else []

    def validate(e: int) -> bool:
        asked.append(e)
        return not invalid[e]

    for goal in (5, 50, 100):
        path = lazy_path(roadmap, 0, goal, np.zeros(roadmap.n_edges, dtype=bool), validate, 10_000, glance)
        without = lazy_path(roadmap, 0, goal, np.zeros(roadmap.n_edges, dtype=bool), lambda e: not invalid[e], 10_000)
        assert (path is None) == (without is None)
        if path is not None and without is not None:
            assert length(roadmap, path) == pytest.approx(length(roadmap, without))
    assert not bad[roadmap.ends[asked]].any()


def test_lazy_validation_gives_up_after_the_rounds_it_was_given(roadmap: Roadmap) -> None:
    blocked = np.zeros(roadmap.n_edges, dtype=bool)
    assert lazy_path(roadmap, 0, 100, blocked, lambda e: False, rounds=3) is None
    assert blocked.sum() == 3
    assert lazy_path(roadmap, 7, 7, blocked, lambda e: False, rounds=3) == [7]


def test_edges_are_made_once_and_undirected(roadmap: Roadmap) -> None:
    e = roadmap.edge(3, 149)
    assert roadmap.edge(149, 3) == e
    assert roadmap.w[e] == pytest.approx(np.linalg.norm(roadmap.q[3] - roadmap.q[149]))
    stand = roadmap.edge(3, 3)
    assert roadmap.w[stand] == 0 and roadmap.n_samples(stand) == 1
    np.testing.assert_array_equal(roadmap.path_samples(stand, 4), np.tile(roadmap.q[3], (4, 1)))
    assert 149 in roadmap.neighbours(3) and 3 in roadmap.neighbours(149)
    assert 3 not in roadmap.neighbours(3)


def test_edges_are_sampled_from_end_to_end(roadmap: Roadmap) -> None:
    e = roadmap.edge(10, 20)
    q = roadmap.path_samples(e)
    assert len(q) == roadmap.n_samples(e)
    np.testing.assert_array_equal(q[0], roadmap.q[10])
    np.testing.assert_allclose(q[-1], roadmap.q[20], atol=1e-12)
    steps = np.diff(q, axis=0)
    np.testing.assert_allclose(steps, np.tile(steps[0], (len(steps), 1)), atol=1e-12)


def test_no_tracked_point_moves_more_than_the_resolution_between_samples(roadmap: Roadmap) -> None:
    """On steps of the size that a k-nearest roadmap and approach chains have, of all directions."""
    rng = np.random.default_rng(3)
    worst = []
    for scale in (0.02, 0.1, 0.3, 0.8):
        for _ in range(20):
            a = int(rng.integers(roadmap.n_vertices))
            chain = roadmap.world.chain
            b = roadmap.add_vertex(
                np.clip(roadmap.q[a] + rng.normal(scale=scale, size=7), chain.lower, chain.upper), connect=False
            )
            spheres = roadmap.spheres(roadmap.edge(a, b)).astype(float)
            worst.append(np.linalg.norm(np.diff(spheres, axis=0), axis=2).max())
    assert max(worst) <= 1.02 * RESOLUTION, f"{max(worst) * 1e3:.1f} mm"


def test_new_vertices_are_joined_to_their_nearest_as_prm_star_asks(world: RobotWorld) -> None:
    """k > e (1 + 1/d) log n for every n, the very k nearest of the open vertices, and no more."""
    roadmap = Roadmap(world)
    rng = np.random.default_rng(4)
    for n in range(200):
        q = rng.uniform(world.chain.lower, world.chain.upper)
        before = roadmap.n_edges
        v = roadmap.add_vertex(q)
        k = min(n, prm_star_neighbours(n, 7)) if n else 0
        assert n < 2 or k == n or k > np.e * (1 + 1 / 7) * np.log(n)
        assert roadmap.n_edges - before == k
        nearest = np.argsort(np.linalg.norm(roadmap.q[:n] - q, axis=1))[:k]
        assert set(roadmap.neighbours(v)) == set(nearest.tolist())
    assert prm_star_neighbours(10**6, 7) < 3 * prm_star_neighbours(10**3, 7), "with the logarithm"


def test_vertices_added_at_once_are_joined_as_one_after_another(world: RobotWorld) -> None:
    rng = np.random.default_rng(6)
    at_once, in_turn = Roadmap(world), Roadmap(world)
    for size in (1, 5, 60, 0, 2, 130):
        q = rng.uniform(world.chain.lower, world.chain.upper, size=(size, 7))
        # What is not open is nobody's neighbour.
        for roadmap in (at_once, in_turn):
            roadmap.add_vertex(q[0] if size else world.home, connect=False)
        at_once.add_vertices(q)
        for x in q:
            in_turn.add_vertex(x)
    np.testing.assert_array_equal(at_once.q, in_turn.q)
    np.testing.assert_array_equal(at_once.ends, in_turn.ends)
    np.testing.assert_allclose(at_once.w, in_turn.w, rtol=1e-12)
    assert at_once.open_vertices() == in_turn.open_vertices()


@pytest.mark.parametrize("expansions", [0, 3, 10_000])
def test_paths_stay_shortest_while_more_edges_are_blocked(
    roadmap: Roadmap, monkeypatch: pytest.MonkeyPatch, expansions: int
) -> None:
    """Whether A* may hardly look around or need never compute distances anew."""
    monkeypatch.setattr("mrtamp.roadmap._EXPANSIONS", expansions)
    rng = np.random.default_rng(7)
    for start, goal in ((0, 100), (40, 7)):
        blocked = rng.random(roadmap.n_edges) < 0.2
        search, found = ShortestPaths(roadmap, start, goal, blocked), 0
        while True:
            path = search.path()
            graph = as_graph(roadmap, blocked)
            if path is None:
                assert not nx.has_path(graph, start, goal)
                break
            found += 1
            assert length(roadmap, path) == pytest.approx(nx.dijkstra_path_length(graph, start, goal))
            edges = [roadmap.edge(a, b) for a, b in pairwise(path)]
            assert not blocked[edges].any()
            blocked[edges[int(rng.integers(len(edges)))]] = True
        assert found > 10


def test_searches_between_which_the_roadmap_grows_are_dijkstras(world: RobotWorld) -> None:
    """Vertices, edges and blocked sets come and go between searches; the graph behind them keeps up."""
    roadmap = Roadmap(world)
    roadmap.add_vertex(world.home)
    rng = np.random.default_rng(5)
    for _ in range(60):
        for _ in range(int(rng.integers(4))):
            roadmap.add_vertex(rng.uniform(world.chain.lower, world.chain.upper), connect=bool(rng.random() < 0.9))
        for _ in range(int(rng.integers(12))):
            a, b = (int(x) for x in rng.integers(roadmap.n_vertices, size=2))
            roadmap.edge(a, b)
        blocked = rng.random(roadmap.n_edges) < rng.choice([0.0, 0.4, 0.8])
        graph = as_graph(roadmap, blocked)
        target, start = (int(x) for x in rng.integers(roadmap.n_vertices, size=2))
        truth = nx.single_source_dijkstra_path_length(graph, target)
        distance = roadmap.distances_to(target, blocked)
        assert distance.shape == (roadmap.n_vertices,)
        assert {v: d for v, d in enumerate(distance) if np.isfinite(d)} == pytest.approx(truth)
        path = roadmap.shortest(start, target, blocked)
        assert (path is None) == (start not in truth)
        if path is not None:
            assert length(roadmap, path) == pytest.approx(truth[start])
            assert all(roadmap.length(a, b) == graph.edges[a, b]["weight"] for a, b in pairwise(path))
        everything = as_graph(roadmap, np.zeros(roadmap.n_edges, dtype=bool))
        for v in everything:
            assert sorted(roadmap.neighbours(v)) == sorted(everything[v])


def test_edges_made_while_a_search_runs_are_not_blocked(roadmap: Roadmap) -> None:
    blocked = np.ones(roadmap.n_edges, dtype=bool)
    roadmap.edge(0, 150)
    assert roadmap.shortest(0, 150, blocked) == [0, 150]
    assert roadmap.shortest(0, 150, blocked[:0]) == [0, 150]


def test_lengths_are_distances_whether_there_is_an_edge_or_not(roadmap: Roadmap) -> None:
    for a, b in ((3, 3), (0, 149), (149, 0), (17, 80)):
        assert roadmap.length(a, b) == pytest.approx(np.linalg.norm(roadmap.q[a] - roadmap.q[b]))


def test_old_spheres_are_forgotten_and_computed_again(roadmap: Roadmap, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mrtamp.roadmap._KEPT_SPHERES", 5)
    first = roadmap.spheres(0).copy()
    for e in range(1, 9):
        roadmap.spheres(e)
    assert len(roadmap._spheres) == 5
    np.testing.assert_array_equal(roadmap.spheres(0), first)


def test_unconnected_vertices_are_reached_through_their_exits_only(roadmap: Roadmap) -> None:
    v = roadmap.add_vertex(roadmap.q[0] + 0.2, connect=False)
    assert not roadmap.neighbours(v)
    assert v not in roadmap.open_vertices()
    exit_ = roadmap.add_vertex(roadmap.q[0] + 0.15)
    roadmap.edge(v, exit_)
    roadmap.exits[v] = [exit_]
    roadmap.offer_direct(0, v)
    blocked = np.zeros(roadmap.n_edges, dtype=bool)
    assert roadmap.shortest(0, v, blocked) == [0, exit_, v], "the direct edge to the exit is offered"
    assert list(roadmap.neighbours(v)) == [exit_]


@pytest.mark.parametrize("size", [0.04, 0.6], ids=["small", "large"])
def test_edges_are_sampled_for_the_largest_object_that_may_be_carried(size: float) -> None:
    """Turning the hand moves the far end of a long object further than anything of the arm."""
    panda = load_robot_model("panda")
    home = np.array(panda.home)
    table = StaticBody("table", RigidTransform([0, 0, -1.05]), Shape("box", (1, 1, 0.1)))
    bar = MovableObject("bar", "table", RigidTransform([0, 0, 0.1]), shape=Shape("box", (size, 0.02, 0.1)))
    problem = Problem("one", (Robot("arm", panda, RigidTransform(), home, home),), (table,), (), (bar,), ())
    collision = Collision(problem)
    roadmap = roadmaps_of(problem, collision)["arm"]
    turn = 0.5 * np.eye(7)[6]
    n = roadmap.samples_between(home, home + turn)
    reach = max(0.1, collision.worlds["arm"].object_radius["bar"])
    assert reach >= size / 2
    assert (n - 1) * RESOLUTION >= 0.99 * reach * 0.5, "an arc of half a radian"


def test_what_a_problem_names_is_on_the_roadmaps_once(tmp_path: Path) -> None:
    """The start first, then a home and an end that are elsewhere."""
    problem = arena(tmp_path, {"a": (-1, 0), "b": (1, 0), "c": (0, 2)}, {"a": (1, 1), "b": (1, 0)})
    a, *others = problem.robots
    problem = replace(problem, robots=(replace(a, home=np.array([-1.0, 0.5])), *others))
    roadmaps = roadmaps_of(problem, Collision(problem))
    stations = add_stations(problem, roadmaps)
    assert stations.start == {"a": 0, "b": 0, "c": 0}
    assert stations.home == {"a": 1, "b": 0, "c": 0}
    assert stations.goal == {"a": 2, "b": 0}
    np.testing.assert_array_equal(roadmaps["a"].q, [(-1, 0), (-1, 0.5), (1, 1)])
    assert [roadmaps[r].n_vertices for r in ("b", "c")] == [1, 1]
