"""Constituent roadmaps G_r: one per robot, shared by all modes, growing for ever, validated lazily (paper, section V).

A roadmap knows geometry (configurations, lengths, sampled edges) and search; whether an edge is free in a mode is the
business of `mrtamp.validity`.  Transition configurations are vertices that are reached through their own approach
chain.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from mrtamp.collision import RESOLUTION, RobotWorld

_COARSE = 5
_HAND = 0.1


class Roadmap:
    """Vertices are configurations of one robot, edges straight lines in joint space.

    Attributes
    ----------
    q : (V, n) configurations.  u, v, w : (E,) end vertices and Euclidean lengths (rad) of the edges.
    contact : edge -> body that a held object may touch on it (its lift edges).
    exits : contact vertex -> the vertices of its chains, nearest first; other vertices are their own exit.
    """

    def __init__(self, world: RobotWorld, reach: float = _HAND) -> None:
        self.world = world
        self.name = world.name
        self.n_dof = world.chain.n
        self._q = np.empty((64, self.n_dof))
        self._ends = np.empty((256, 2), dtype=np.int64)
        self._w = np.empty(256)
        self.n_vertices = 0
        self.n_edges = 0
        self._edge_of: dict[tuple[int, int], int] = {}
        self.contact: dict[int, tuple[str, str]] = {}
        self.exits: dict[int, list[int]] = {}
        self._open: list[int] = []
        self._samples: dict[int, int] = {}
        self._spheres: dict[int, np.ndarray] = {}
        # Points of the hand (and of the largest object it may carry) that rotate far from any body's centre.
        self._points = np.array([[0, 0, 0], [reach, 0, 0], [0, reach, 0], [0, 0, reach]])

    @property
    def q(self) -> np.ndarray:
        """All configurations (V, n)."""
        return self._q[: self.n_vertices]

    @property
    def ends(self) -> np.ndarray:
        """End vertices of all edges (E, 2)."""
        return self._ends[: self.n_edges]

    @property
    def w(self) -> np.ndarray:
        """Lengths of all edges (E,), rad."""
        return self._w[: self.n_edges]

    def add_vertex(self, q: np.ndarray, *, connect: bool = True) -> int:
        """Add a configuration; `connect` joins it to its k nearest open vertices, k as PRM* asks."""
        if self.n_vertices == len(self._q):
            self._q = np.concatenate([self._q, np.empty_like(self._q)])
        i = self.n_vertices
        self._q[i] = q
        self.n_vertices += 1
        if connect:
            self._connect(i)
            self._open.append(i)
        return i

    def _connect(self, i: int) -> None:
        if not self._open:
            return
        others = np.array(self._open)
        distance = np.linalg.norm(self._q[others] - self._q[i], axis=1)
        # k = e (1 + 1/d) log n: Karaman and Frazzoli (2011), PRM*.
        k = int(np.ceil(np.e * (1 + 1 / self.n_dof) * np.log(len(others) + 1))) + 1
        for j in np.argsort(distance, kind="stable")[:k]:
            self.edge(i, int(others[j]))

    def edge(self, a: int, b: int) -> int:
        """The edge between two vertices, made if need be; (a, a) is the degenerate edge of standing at a."""
        key = (a, b) if a <= b else (b, a)
        known = self._edge_of.get(key)
        if known is not None:
            return known
        if self.n_edges == len(self._w):
            self._ends = np.concatenate([self._ends, np.empty_like(self._ends)])
            self._w = np.concatenate([self._w, np.empty_like(self._w)])
        e = self.n_edges
        self._ends[e] = key
        self._w[e] = np.linalg.norm(self._q[a] - self._q[b])
        self._edge_of[key] = e
        self.n_edges += 1
        return e

    def n_samples(self, e: int) -> int:
        """How many samples, ends included, keep consecutive ones within the resolution."""
        known = self._samples.get(e)
        if known is None:
            a, b = self._ends[e]
            known = 1 if a == b else samples_between(self.world, self._points, self._q[a], self._q[b])
            self._samples[e] = known
        return known

    def path_samples(self, e: int, n: int | None = None) -> np.ndarray:
        """Configurations (n, dof) along the edge from its first to its second end."""
        a, b = self._ends[e]
        t = np.linspace(0, 1, n or self.n_samples(e))[:, None] if a != b else np.zeros((n or 1, 1))
        return self._q[a] + t * (self._q[b] - self._q[a])

    def spheres(self, e: int) -> np.ndarray:
        """Centres (n, B, 3) of the bodies' bounding spheres along the edge's samples."""
        known = self._spheres.get(e)
        if known is None:
            known = self.world.bounds.spheres(self.path_samples(e)).astype(np.float32)
            self._spheres[e] = known
        return known

    def offer_direct(self, a: int, b: int) -> None:
        """Make the straight edges between the exits of two vertices: a k-nearest roadmap hides near-optimal ones."""
        for i in self.exits.get(a, [a]):
            for j in self.exits.get(b, [b]):
                if i != j:
                    self.edge(i, j)

    def shortest(self, start: int, goal: int, blocked: np.ndarray) -> list[int] | None:
        """Vertices of the shortest path that avoids edges marked in `blocked` (E,), or None."""
        if start == goal:
            return [start]
        ends = self.ends
        keep = ~blocked & (ends[:, 0] != ends[:, 1])
        u, v, w = ends[keep, 0], ends[keep, 1], np.maximum(self.w[keep], 1e-9)
        graph = csr_array((w, (u, v)), shape=(self.n_vertices, self.n_vertices))
        distance, parent = dijkstra(graph, directed=False, indices=start, return_predecessors=True)
        if not np.isfinite(distance[goal]):
            return None
        path = [goal]
        while path[-1] != start:
            path.append(int(parent[path[-1]]))
        return path[::-1]

    def neighbours(self, a: int) -> list[int]:
        """Vertices that share an edge with `a`."""
        ends = self.ends
        out = np.concatenate([ends[ends[:, 0] == a, 1], ends[ends[:, 1] == a, 0]])
        return [int(i) for i in np.unique(out) if i != a]

    def open_vertices(self) -> Sequence[int]:
        """Vertices that are not transitions or their chains."""
        return self._open


def samples_between(world: RobotWorld, points: np.ndarray, a: np.ndarray, b: np.ndarray) -> int:
    """Number of samples of the straight motion a -> b that keeps every tracked point's steps within RESOLUTION."""
    q = np.linspace(a, b, _COARSE)
    tracked = world.bounds.spheres(q)
    R, p = world.tool.pose(q)
    hand = p[:, None] + np.einsum("nij,kj->nki", R, points)
    # The fastest coarse part decides: points do not move evenly.
    parts = np.concatenate([np.linalg.norm(np.diff(x, axis=0), axis=2) for x in (tracked, hand)], axis=1)
    fastest = 1.1 * float(parts.max()) * (_COARSE - 1)
    return max(2, int(np.ceil(fastest / RESOLUTION)) + 1)


def lazy_path(
    roadmap: Roadmap,
    start: int,
    goal: int,
    blocked: np.ndarray,
    validate: Callable[[int], bool],
    rounds: int,
) -> list[int] | None:
    """Lazy shortest path: search, validate the edges of the answer, drop what fails, search again.

    `blocked` marks edges known to be invalid and is updated in place.  None after `rounds` searches without success.
    """
    for _ in range(rounds):
        path = roadmap.shortest(start, goal, blocked)
        if path is None:
            return None
        edges = [roadmap.edge(a, b) for a, b in itertools.pairwise(path)]
        # The ends are the tightest parts: they fail first.
        order = sorted(range(len(edges)), key=lambda i: min(i, len(edges) - 1 - i))
        for i in order:
            if not validate(edges[i]):
                blocked[edges[i]] = True
                break
        else:
            return path
    return None
