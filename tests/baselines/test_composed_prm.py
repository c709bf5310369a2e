"""The composite roadmap and its search against independent ones; convergence to known optima."""

from __future__ import annotations

import itertools
import sys
from pathlib import Path

import networkx as nx
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from arena import Parts, arena, visit, wall

import mrtamp
from mrtamp.baselines.composed_prm import ComposedOptions, ComposedPRM
from mrtamp.baselines.composite import CompositeRoadmap, Layer
from mrtamp.baselines.multimodal import Multimodal
from mrtamp.informed import ellipsoid_sample
from mrtamp.modes import Mode
from mrtamp.plan import Segment, segment_cost
from mrtamp.planar import shortest_path, visibility_graph
from mrtamp.timetable import timetable


@pytest.fixture
def parts(tmp_path: Path) -> Parts:
    """Two discs, one on each side of a wall with a gap."""
    walls = [wall("low", (-0.1, -2), (0.1, -0.5)), wall("high", (-0.1, 0.5), (0.1, 2))]
    return Parts(arena(tmp_path, {"a": (-1, 0), "b": (1, 0)}, walls=walls))


def composite(parts: Parts, n: int) -> CompositeRoadmap:
    """n random composite vertices that all layers share."""
    roadmap = CompositeRoadmap(parts.roadmaps, parts.validity, parts.problem.cost)
    q = parts.rng.uniform(-1.7, 1.7, size=(n, 2, 2))
    roadmap.share([roadmap.add(roadmap.vertices(list(x))) for x in q])
    return roadmap


def whole(layer: Layer) -> nx.Graph:
    """Shared vertices and own ones joined to all others within a layer, as its edges say."""
    layer.distances(layer.own[0], layer.own)
    graph = nx.Graph()
    ids = [*layer.roadmap.shared, *layer.own]
    for u, v, w in zip(layer._u.tolist(), layer._v.tolist(), layer._w.tolist(), strict=True):
        graph.add_edge(ids[u], ids[v], length=w)
    return graph


def test_lengths_are_what_motions_cost(parts: Parts) -> None:
    roadmap = composite(parts, 5)
    q = roadmap.q([0, 1])
    segment = Segment(parts.root, {r: x for r, x in zip(roadmap.names, roadmap.parts(q), strict=True)})
    assert roadmap.distance(q[0], q[1]) == pytest.approx(segment_cost(segment, parts.problem.cost))


def test_lazy_search_in_a_layer_is_the_shortest_free_path(parts: Parts) -> None:
    """All edges validated first and the shortest path taken, or the other way round: the same."""
    roadmap = composite(parts, 150)
    layer = Layer(roadmap, parts.root)
    ends = [
        roadmap.add(roadmap.vertices([np.array(a), np.array(b)])) for a, b in (((-1, 0), (1, 0)), ((1, 1), (-1, -1)))
    ]
    for i in ends:
        layer.add(i)
    graph = whole(layer)
    assert graph.degree(ends[0]) >= 8, "PRM*: k grows with log n"
    lengths = [roadmap.distance(roadmap.q(u), roadmap.q(v)) for u, v in graph.edges]
    assert lengths == pytest.approx([d["length"] for _, _, d in graph.edges(data=True)])
    path = layer.path(*ends)
    while path is not None and layer.flaw(path) is not None:
        path = layer.path(*ends)
    asked = parts.collision.counts.collision_checks
    graph.remove_edges_from([(u, v) for u, v in graph.edges if not roadmap.moves(parts.root, u, v)])
    assert parts.collision.counts.collision_checks > 2 * asked, "lazy: most edges are never asked about"
    assert path is not None
    expected = nx.shortest_path_length(graph, *ends, weight="length")
    assert layer.distances(ends[0], ends[1:])[0] == pytest.approx(expected)
    assert sum(graph.edges[e]["length"] for e in itertools.pairwise(path)) == pytest.approx(expected)


def test_search_over_all_layers_is_the_shortest_path_of_the_expanded_graph(parts: Parts) -> None:
    """Random transitions between three modes: the lazy search against Dijkstra on all layers at once."""
    roadmap = composite(parts, 60)
    graph = Multimodal(roadmap)
    modes = [Mode((), frozenset(x)) for x in ((), ("one",), ("one", "two"))]
    layers = [graph.layer(m) for m in modes]

    def at() -> tuple[int, ...]:
        while True:
            q = parts.rng.uniform(-1.7, 1.7, size=(2, 2))
            found = roadmap.vertices(list(q))
            if roadmap.stands(parts.root, roadmap.add(found)):
                return found

    start = graph.cross(tuple(parts.start.values()), None, layers[0])
    middle = [graph.cross(at(), a, b, cost=0.1) for a, b in itertools.pairwise(layers) for _ in range(6)]
    ends = [graph.cross(at(), layers[2], None) for _ in range(2)]
    found = graph.cheapest(np.inf, lambda: False)
    assert found is not None
    expanded = nx.DiGraph()
    for layer in layers:
        for u, v, data in whole(layer).edges(data=True):
            if roadmap.moves(layer.mode, u, v):
                for a, b in ((u, v), (v, u)):
                    expanded.add_edge((layer, a), (layer, b), length=data["length"])
    for c in middle:
        expanded.add_edge((c.before, c.vertex), (c.after, c.vertex), length=c.cost)
    source = (layers[0], start.vertex)
    lengths = nx.single_source_dijkstra_path_length(expanded, source, weight="length")
    assert found.cost == pytest.approx(min(lengths[layers[2], c.vertex] for c in ends), abs=1e-6)
    assert graph.cheapest(found.cost, lambda: False) is None, "nothing is cheaper"
    assert graph.cheapest(np.inf, lambda: True) is None, "no time"


def test_pruning_forgets_nothing_that_could_pay(parts: Parts) -> None:
    roadmap = composite(parts, 30)
    graph = Multimodal(roadmap)
    one, two = (graph.layer(Mode((), frozenset(x))) for x in ((), ("one",)))
    graph.cross(tuple(parts.start.values()), None, one)
    for x in (0.3, 0.9, 1.5):
        graph.cross(roadmap.vertices([np.array([-1.0, x]), np.array([1.0, x])]), one, two)
    graph.cross(tuple(parts.start.values()), two, None)
    best = graph.cheapest(np.inf, lambda: False)
    assert best is not None
    graph.prune(best.cost)
    assert [c.number for c in graph.exits[one]] == [1]
    again = graph.cheapest(np.inf, lambda: False)
    assert again is not None and again.cost == pytest.approx(best.cost)


@pytest.mark.parametrize("n", [1, 2, 7])
def test_informed_samples_fill_the_ellipsoid(n: int) -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, n))
    gap = float(np.linalg.norm(b - a))
    x = np.array([ellipsoid_sample(a, b, 1.5 * gap, rng) for _ in range(3000)])
    through = np.linalg.norm(x - a, axis=1) + np.linalg.norm(x - b, axis=1)
    assert through.max() <= 1.5 * gap + 1e-9
    assert through.max() > 1.45 * gap
    # Uniform: as much of the volume within half of the radius as has to be.
    u = (b - a) / gap
    along = (x - (a + b) / 2) @ u / (0.75 * gap)
    across = np.linalg.norm(x - (a + b) / 2 - np.outer((x - (a + b) / 2) @ u, u), axis=1) / (gap * np.sqrt(1.25) / 2)
    assert np.mean(np.hypot(along, across) < 0.5 ** (1 / n)) == pytest.approx(0.5, abs=0.04)


def test_converges_to_the_shortest_path_around_a_wall(tmp_path: Path) -> None:
    """One disc, nothing but the roadmap: the cost comes down to the exact optimum and never below."""
    problem = arena(tmp_path, {"a": (-1, -0.5)}, {"a": (1, -0.5)}, walls=[wall("wall", (-0.1, -2), (0.1, 0.3))])
    corners = np.array([[-0.1, -2], [0.1, -2], [0.1, 0.3], [-0.1, 0.3]])
    sites = {"start": np.array([-1, -0.5]), "end": np.array([1, -0.5])}
    exact = shortest_path(visibility_graph([corners], 0.2, sites), "start", "end")[0]
    weights = problem.cost
    optimum = (weights.makespan + weights.path_length) * exact
    last = []
    for without, within in ((set(), 1.02), ({"informed-sampling"}, 1.1)):
        options = ComposedOptions(without=frozenset({"refinement", *without}))
        planner = ComposedPRM(problem, seed=0, options=options)
        costs = [plan.cost for plan in planner.improve(30.0, iterations=25)]
        assert min(costs) >= optimum - 1e-6
        assert costs[-1] <= within * optimum
        assert costs[0] > 1.1 * optimum, "otherwise nothing has converged"
        last.append(costs[-1])
    assert last[0] < last[1], "informed samples come nearer"


def test_converges_for_two_robots_with_subgoals() -> None:
    """Without shortening costs fall towards the known optimum; with it they get there."""
    problem = mrtamp.load_problem("square_free")
    best = timetable(problem).cost
    bare = ComposedPRM(problem, seed=0, options=ComposedOptions(without=frozenset({"refinement"})))
    costs = [plan.cost for plan in bare.improve(30.0, iterations=25)]
    assert best <= costs[-1] <= 1.25 * best and costs[-1] < costs[0]
    full = ComposedPRM(problem, seed=0)
    assert min(plan.cost for plan in full.improve(30.0, iterations=10)) <= 1.002 * best


def test_modes_are_drawn_without_bias_too(tmp_path: Path) -> None:
    """Uniform modes and transitions find a way as well, where there are few of them."""
    goals = [visit("left", "a", (-1, -1)), visit("right", "b", (1, 1), "left")]
    problem = arena(tmp_path, {"a": (-1, 0), "b": (1, 0)}, {"a": (-1, 1)}, subgoals=goals)
    planner = ComposedPRM(problem, seed=0, options=ComposedOptions(without=frozenset({"goal-bias"})))
    assert list(planner.improve(20.0, iterations=5))
