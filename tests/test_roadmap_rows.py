"""Roadmap paths in the tables of space and time: the same lines, cut finely enough, and each put there once."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from arena import Parts, arena

from mrtamp import roadmap_rows
from mrtamp.roadmap_rows import RoadmapRows
from mrtamp.space_time import STEP


@pytest.fixture
def parts(tmp_path: Path) -> Parts:
    parts = Parts(arena(tmp_path, {"a": (-1, 0), "b": (1, 0)}))
    for x in ((0.2, 0.9), (0.25, 0.9), (1.5, -1.2)):
        parts.vertex("a", x)
    return parts


def rows_of(parts: Parts) -> RoadmapRows:
    return RoadmapRows(parts.roadmaps, parts.collision, parts.validity)


def along(rows: RoadmapRows, path: list[int]) -> np.ndarray:
    """Configurations (M, 2) of the rows of a path of robot a, from its first vertex's own row."""
    table = rows.clearances.tables["a"]
    return np.array([table[i] for i in rows.path("a", path, rows.vertex("a", path[0]))])


def test_rows_follow_the_path_in_equal_steps_per_edge(parts: Parts) -> None:
    path = [0, 2, 1, 3]
    q = along(rows_of(parts), path)
    lengths = np.linalg.norm(np.diff(q, axis=0), axis=1)
    assert lengths.max() <= STEP + 1e-12
    corners = parts.roadmaps["a"].q[path]
    at = [int(np.flatnonzero(np.all(q == c, axis=1))[0]) for c in corners]
    assert (at[0], at[-1]) == (0, len(q) - 1)
    for (i, j), (a, b) in zip(itertools.pairwise(at), itertools.pairwise(corners), strict=True):
        assert j - i == max(1, np.ceil(np.linalg.norm(b - a) / STEP))
        np.testing.assert_allclose(q[i : j + 1], np.linspace(a, b, j - i + 1), atol=1e-12)


def test_paths_that_share_edges_share_rows(parts: Parts) -> None:
    rows = rows_of(parts)
    first = rows.path("a", [0, 1, 3], rows.vertex("a", 0))
    n = len(rows.clearances.tables["a"])
    assert rows.path("a", [0, 1, 3], rows.vertex("a", 0)) == first
    second = rows.path("a", [1, 3], rows.vertex("a", 1))
    assert second == first[-len(second) :] and len(second) > 1
    assert len(rows.clearances.tables["a"]) == n
    assert not rows.clearances.tables["b"]


def test_a_path_may_begin_at_a_row_of_a_schedule(parts: Parts) -> None:
    rows = rows_of(parts)
    start = rows.clearances.row("a", parts.roadmaps["a"].q[0])
    path = rows.path("a", [0, 1], start)
    assert path[0] == start != rows.vertex("a", 0)
    assert path[1:] == rows.path("a", [0, 1], rows.vertex("a", 0))[1:]
    assert rows.path("a", [0], start) == [start]


def test_full_tables_are_emptied_and_filled_again(parts: Parts, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = rows_of(parts)
    before, q = rows.clearances, along(rows, [0, 1, 3])
    assert before.size > 0, "moves are sampled"
    monkeypatch.setattr(roadmap_rows, "_FULL", before.size)
    rows.forget_if_full()
    assert rows.clearances is before
    monkeypatch.setattr(roadmap_rows, "_FULL", before.size - 1)
    rows.forget_if_full()
    assert rows.clearances is not before and rows.clearances.size == 0
    # In another order, so that rows of before would mean something else.
    np.testing.assert_array_equal(along(rows, [3, 1, 0])[::-1][[0, -1]], q[[0, -1]])
    np.testing.assert_array_equal(along(rows, [0, 1, 3]), q)


def test_the_edge_of_a_move_is_known(parts: Parts) -> None:
    rows = rows_of(parts)
    start = rows.clearances.row("a", parts.roadmaps["a"].q[0])
    vertices = [0, 2, 1, 3]
    path = rows.path("a", vertices, start)
    edges = list(dict.fromkeys(rows.edge_of("a", i, j) for i, j in itertools.pairwise(path)))
    assert edges == list(itertools.pairwise(vertices))
    assert rows.edge_of("a", path[-1], path[-1]) == (3, 3), "standing at a vertex"
    assert rows.edge_of("a", path[2], path[0]) is None and rows.edge_of("b", path[0], path[1]) is None
