"""Paths that trees find where a roadmap has none: free, on the roadmap from then on, remembered for a while."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from arena import Parts, arena, wall

from mrtamp.connect import _USES, Connector

POST = [wall("post", (-0.1, -0.5), (0.1, 0.5))]


@pytest.fixture
def parts(tmp_path: Path) -> Parts:
    return Parts(arena(tmp_path, {"a": (-1, 0)}, walls=POST))


def free(parts: Parts, path: list[int]) -> bool:
    """Whether every motion of a path keeps clear of the world, by a look at every half centimetre."""
    world, q = parts.roadmaps["a"].world, parts.roadmaps["a"].q
    for u, v in pairwise(path):
        n = int(np.linalg.norm(q[v] - q[u]) / 0.005) + 2
        if world.hits(world.rows(np.linspace(q[u], q[v], n), None, {})).any():
            return False
    return True


@pytest.mark.parametrize("seed", range(10))
def test_what_is_found_is_free_between_coarse_samples_too(tmp_path: Path, seed: int) -> None:
    """A blade thinner than the steps by which trees grow."""
    blades = [wall(f"blade{k}", (x, -0.6), (x + 0.002, 0.6)) for k, x in enumerate((-0.31, 0.0, 0.33))]
    parts = Parts(arena(tmp_path, {"a": (-1, 0)}, walls=blades), seed=seed)
    beyond = parts.vertex("a", (1, 0))
    path = Connector(parts.validity, parts.rng).connect(parts.roadmaps["a"], parts.root, 0, beyond, 1000)
    assert path is not None
    assert (path[0], path[-1]) == (0, beyond)
    assert free(parts, path)


def test_a_found_path_is_used_for_a_while_and_then_another_is_looked_for(parts: Parts) -> None:
    roadmap, beyond = parts.roadmaps["a"], parts.vertex("a", (1, 0))
    connector = Connector(parts.validity, parts.rng)
    asked: list[list[int] | None] = []

    def join() -> list[int] | None:
        asked.append(connector.connect(roadmap, parts.root, 0, beyond, 1000))
        return asked[-1]

    def path(a: int, b: int) -> list[int] | None:
        # Every edge is held to be blocked but those that trees found: the lazy search has no way.
        blocked = np.ones(roadmap.n_edges, dtype=bool)
        return connector.path(roadmap, a, b, blocked, lambda _: True, 20, join)

    first = path(0, beyond)
    assert first == asked[0]
    for _ in range(_USES):
        assert path(0, beyond) == first
    assert len(asked) == 1
    path(0, beyond)
    assert len(asked) == 2
    assert path(beyond, 0) == asked[1][::-1], "there and back"


def test_a_found_path_that_has_become_blocked_is_not_used(parts: Parts) -> None:
    roadmap, beyond = parts.roadmaps["a"], parts.vertex("a", (1, 0))
    connector = Connector(parts.validity, parts.rng)
    path = connector.connect(roadmap, parts.root, 0, beyond, 1000)
    assert path is not None
    closed = roadmap.edge(path[0], path[1])
    blocked = np.ones(roadmap.n_edges, dtype=bool)
    assert connector.path(roadmap, 0, beyond, blocked, lambda e: e != closed, 20, lambda: None) is None


def test_where_there_is_no_way_there_is_no_path(tmp_path: Path) -> None:
    cell = [wall(f"side{k}", *sides) for k, sides in enumerate([((0.5, -0.6), (0.6, 0.6)), ((1.4, -0.6), (1.5, 0.6))])]
    cell += [wall("top", (0.5, 0.5), (1.5, 0.6)), wall("bottom", (0.5, -0.6), (1.5, -0.5))]
    parts = Parts(arena(tmp_path, {"a": (-1, 0)}, walls=cell))
    inside = parts.vertex("a", (1, 0))
    roadmap = parts.roadmaps["a"]
    assert Connector(parts.validity, parts.rng).connect(roadmap, parts.root, 0, inside, 200) is None
    assert not roadmap.joined


@pytest.mark.parametrize("seed", range(5))
def test_a_way_that_may_only_be_so_long_is_within_its_ellipse(tmp_path: Path, seed: int) -> None:
    """Past the post's end at (0, 0.7) it is 2 sqrt(1 + 0.49) = 2.44 from end to end, where the disc just fits."""
    parts = Parts(arena(tmp_path, {"a": (-1, 0)}, walls=POST), seed=seed)
    roadmap, beyond = parts.roadmaps["a"], parts.vertex("a", (1, 0))
    connector = Connector(parts.validity, parts.rng)
    assert connector.connect(roadmap, parts.root, 0, beyond, 300, longest=2.43) is None
    assert roadmap.n_vertices == 2
    path = connector.connect(roadmap, parts.root, 0, beyond, 1000, longest=2.8)
    assert path is not None and free(parts, path)
    q = roadmap.q[path]
    assert max(np.linalg.norm(q - q[0], axis=1) + np.linalg.norm(q - q[-1], axis=1)) <= 2.8 + 1e-9


@pytest.mark.parametrize("seed", range(5))
def test_who_knows_a_long_way_only_looks_for_a_shorter_one(tmp_path: Path, seed: int) -> None:
    """The roadmap goes around a wall that has a doorway."""
    walls = [wall("below", (-0.1, -1.6), (0.1, 0.2)), wall("above", (-0.1, 0.8), (0.1, 2.2))]
    parts = Parts(arena(tmp_path, {"a": (-1, 0)}, walls=walls), seed=seed)
    roadmap, beyond = parts.roadmaps["a"], parts.vertex("a", (1, 0))
    corners = [parts.vertex("a", (x, -1.85)) for x in (-0.5, 0.5)]
    around = [0, *corners, beyond]
    assert free(parts, around)
    steering = parts.insertion().steering

    def length(path: list[int] | None) -> float:
        assert path is not None and free(parts, path)
        return float(np.linalg.norm(np.diff(roadmap.q[path], axis=0), axis=1).sum())

    at = (0,)
    assert steering.path(parts.root, at, "a", beyond, connect=False)[0] == around
    steering.thorough, steering.shorter = True, False
    assert steering.path(parts.root, at, "a", beyond)[0] == around, "switched off"
    steering.shorter = True
    found = min(length(steering.path(parts.root, at, "a", beyond)[0]) for _ in range(4))
    assert found <= 0.8 * length(around)
    known = roadmap.n_vertices
    assert length(steering.path(parts.root, at, "a", corners[0])[0]) < 2.0
    assert roadmap.n_vertices == known, "short ways are not looked at twice"
