"""One robot at a time: shortest valid paths around standing robots, and who is in whose way."""

from __future__ import annotations

import itertools

import networkx as nx
import numpy as np
import pytest
from flatland import MODE, Flatland, Setting, grid, roadmap, step_cost, step_free

from mrtamp.steering import Steering


def steering(setting: Setting, seed: int = 0) -> Steering:
    return Steering(setting.roadmaps, setting.world, setting.insert, np.random.default_rng(seed))


@pytest.mark.parametrize("seed", range(4))
def test_paths_are_the_shortest_around_standing_robots(seed: int) -> None:
    roadmaps = [grid(n, 4, 3, 0.2, seed + k) for k, n in enumerate("ab")]
    world = Flatland(roadmaps, 0.3, [((1.5, 0.6), 0.1)])
    for b in (5, 6, 9):
        setting = Setting(world, roadmaps, (0, b))
        for goal in (3, 7, 11):
            path, blockers = steering(setting).path(MODE, (0, b), "a", goal)
            truth = nx.Graph()
            truth.add_nodes_from(range(12))
            for u, v in roadmaps[0].ends.tolist():
                if u != v and step_free(world, roadmaps, (u, b), (v, b)):
                    truth.add_edge(u, v, weight=step_cost(roadmaps, (u, b), (v, b)))
            if path is None:
                assert not nx.has_path(truth, 0, goal)
                assert set(blockers) == {"b"}
            else:
                cost = sum(step_cost(roadmaps, (u, b), (v, b)) for u, v in itertools.pairwise(path))
                assert cost == pytest.approx(nx.dijkstra_path_length(truth, 0, goal))


def test_robots_that_block_each_other_are_sent_aside_in_turn() -> None:
    """Three robots in a corridor with a bay at its end: the last two make room, one level deeper than the first."""
    points = [(0, 0), (1, 0), (2, 0), (3, 0), (4, 0), (3, 1), (4, 1)]
    edges = [(0, 1), (1, 2), (2, 3), (3, 4), (3, 5), (4, 6)]
    roadmaps = [roadmap(n, points, edges) for n in "abc"]
    setting = Setting(Flatland(roadmaps, 0.3), roadmaps, (0, 2, 4))
    found = [steering(setting, seed).drive(setting.root, {"a": 3}, depth=2) for seed in range(5)]
    there = [x for x in found if x is not None]
    assert there
    for x in there:
        assert x.at[0] == 3
        branch = setting.tree.branch(x)
        assert all(step_free(setting.world, roadmaps, u.at, v.at) for u, v in itertools.pairwise(branch))
        moving = [sum(i != j for i, j in zip(u.at, v.at, strict=True)) for u, v in itertools.pairwise(branch)]
        assert set(moving) == {1}, "one at a time"
    assert steering(setting).drive(setting.root, {"a": 3}, depth=0) is None
