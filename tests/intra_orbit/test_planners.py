"""Both intra-orbit planners on tensor products small enough to be solved exactly by Dijkstra."""

from __future__ import annotations

from itertools import pairwise

import networkx as nx
import numpy as np
import pytest
from flatland import WEIGHTS, Flatland, Setting, grid, product_graph, roadmap, step_free

from mrtamp.deadline import Deadline
from mrtamp.intra_orbit.planners import INTRA_ORBIT, IntraOrbitPlanner
from mrtamp.roadmap import Roadmap
from mrtamp.tensor_tree import At, Node

NAMES = sorted(INTRA_ORBIT)


def planner(name: str, setting: Setting, seed: int = 0) -> IntraOrbitPlanner:
    rng = np.random.default_rng(seed)
    return INTRA_ORBIT[name](setting.roadmaps, setting.world, setting.insert, rng, WEIGHTS, Deadline())


def crossing(robots: int) -> tuple[Setting, At, At]:
    """Robots on a 4 x 3 grid (three robots: 3 x 2) that change sides past an obstacle and each other."""
    columns, rows = (4, 3) if robots == 2 else (3, 2)
    roadmaps = [grid(n, columns, rows, jitter=0.1, seed=seed) for seed, n in enumerate("abc"[:robots])]
    world = Flatland(roadmaps, radius=0.25, obstacles=[((1.5, 1.0), 0.2)])
    start, goal = ((4, 7), (7, 4)) if robots == 2 else ((0, 5, 2), (5, 0, 3))
    return Setting(world, roadmaps, start), start, goal


def check_branch(setting: Setting, node: Node) -> None:
    """Every step on the way to a node is one of the roadmaps' and free."""
    for a, b in pairwise(setting.tree.branch(node)):
        assert step_free(setting.world, setting.roadmaps, a.at, b.at)
        for g, u, v in zip(setting.roadmaps, a.at, b.at, strict=True):
            assert u == v or v in g.neighbours(u)


@pytest.mark.parametrize("robots", [2, 3])
def test_robots_change_places_and_never_beat_the_optimum(robots: int) -> None:
    optimum = None
    for name in NAMES:
        for seed in range(3):
            setting, start, goal = crossing(robots)
            there = planner(name, setting, seed).drive(setting.root, dict(zip("abc", goal, strict=False)))
            assert there is not None and there.at == goal
            check_branch(setting, there)
            if optimum is None:
                optimum = nx.dijkstra_path_length(product_graph(setting.world, setting.roadmaps), start, goal)
            assert optimum - 1e-9 <= there.cost <= 1.5 * optimum


@pytest.mark.parametrize("name", NAMES)
def test_extensions_converge_to_the_optimum_of_the_product(name: str) -> None:
    """Driving and exploring from random nodes, with rewiring, ends at what Dijkstra finds on the whole product."""
    setting, start, goal = crossing(2)
    truth = nx.single_source_dijkstra_path_length(product_graph(setting.world, setting.roadmaps), start)
    setting.orbits.rewirings = 8
    rng = np.random.default_rng(1)
    search = planner(name, setting, 2)
    history = []
    for k in range(2000):
        nodes = setting.alive()
        node = nodes[int(rng.integers(len(nodes)))]
        if k % 20 == 0:
            search.drive(node, dict(zip("ab", goal, strict=True)))
        else:
            search.explore(node)
        there = setting.tree.find(node.mode, goal)
        history.append(np.inf if there is None else there.cost)
    assert all(b <= a + 1e-12 for a, b in pairwise(history)), "costs never rise"
    # Offered direct edges enlarge the product beyond what Dijkstra was given: never dearer, then.
    truth = nx.single_source_dijkstra_path_length(product_graph(setting.world, setting.roadmaps), start)
    assert history[-1] == pytest.approx(truth[goal], rel=1e-9)
    excess = [x.cost / truth[x.at] - 1 for x in setting.alive() if x is not setting.root]
    assert min(excess) > -1e-9
    assert np.mean(excess) < 0.02
    assert len(excess) > 0.9 * (len(truth) - 1), "explored for ever, the product is covered"


@pytest.mark.parametrize("name", NAMES)
def test_moving_together_costs_one_makespan(name: str) -> None:
    """Robots that do not meet move at the same time, edges of different lengths side by side."""
    chain = [(0, 1), (1, 2), (2, 3)]
    a = roadmap("a", [(0, 0), (0.5, 0.3), (1.0, 0.4), (3.0, 0)], chain)
    b = roadmap("b", [(0, 5), (2.0, 5.4), (2.5, 5.3), (3.0, 5)], chain)
    # The straight edge is blocked.
    world = Flatland([a, b], radius=0.1, obstacles=[((1.2, 0.0), 0.05), ((1.2, 5.0), 0.05)])
    setting = Setting(world, [a, b], (0, 0))
    there = planner(name, setting).drive(setting.root, {"a": 3, "b": 3})
    assert there is not None
    optimum = nx.dijkstra_path_length(product_graph(world, [a, b]), (0, 0), (3, 3))
    assert there.cost == pytest.approx(optimum)
    assert optimum < 0.8 * (length(a) + length(b))


def length(g: Roadmap) -> float:
    return float(np.linalg.norm(np.diff(g.q, axis=0), axis=1).sum())


@pytest.mark.parametrize("name", NAMES)
def test_an_idle_robot_moves_aside_if_it_may(name: str) -> None:
    """Robot b stands in a corridor with one recess; robot a has to pass."""
    corridor = [(0, 0), (1, 0), (2, 0), (3, 0), (2, 1)]
    edges = [(0, 1), (1, 2), (2, 3), (2, 4)]
    a, b = (roadmap(n, corridor, edges) for n in "ab")
    setting = Setting(Flatland([a, b], radius=0.3), [a, b], (0, 2))
    search = planner(name, setting)
    assert search.drive(setting.root, {"a": 3}, depth=0) is None
    assert all(x.at[1] == 2 for x in setting.alive())
    assert search.trouble["a", "b"] + search.trouble["b", "a"] > 0
    there = search.drive(setting.root, {"a": 3})
    assert there is not None and there.at == (3, 4)
    check_branch(setting, there)


@pytest.mark.parametrize("name", NAMES)
def test_what_cannot_be_reached_is_not(name: str) -> None:
    points = [(0, 0), (1, 0), (5, 0)]
    a, b = (roadmap(n, points, [(0, 1)]) for n in "ab")
    setting = Setting(Flatland([a, b], radius=0.3, obstacles=[((3, 0), 0.5)]), [a, b], (0, 1))
    search = planner(name, setting)
    assert search.drive(setting.root, {"a": 2}) is None, "behind an obstacle"
    assert search.drive(setting.root, {"a": 1, "b": 1}) is None, "both at one place"
    assert search.drive(setting.root, {"a": 1, "b": 0}) is None, "no room to change places"
    there = search.drive(setting.root, {"a": 0, "b": 1})
    assert there is setting.root, "already there"


@pytest.mark.parametrize("name", NAMES)
def test_runs_repeat_to_the_last_bit(name: str) -> None:
    costs = []
    for _ in range(2):
        setting, _, goal = crossing(3)
        search = planner(name, setting, 7)
        node: Node | None = setting.root
        for _ in range(30):
            node = search.explore(node or setting.root)
        there = search.drive(setting.root, dict(zip("abc", goal, strict=True)))
        assert there is not None
        costs.append([x.cost for x in setting.tree.nodes])
    assert costs[0] == costs[1]


@pytest.mark.parametrize("name", NAMES)
def test_exploration_reaches_every_free_tensor_neighbour(name: str) -> None:
    setting, start, _ = crossing(2)
    search = planner(name, setting, 3)
    for _ in range(3000):
        search.explore(setting.root)
    free = set(product_graph(setting.world, setting.roadmaps)[start])
    assert {x.at for x in setting.root.steps} == free
