"""A roadmap in the composite space of all robots, and its layers: one per mode (Hartmann et al., 2025; PRM*).

Vertices are composite configurations, one roadmap vertex per robot, so that the collision queries are those of the
single robots and pairs.  Uniform samples are shared by all layers; what a mode adds of its own, and what is free in
it, is the layer's.  Edges and vertices are validated when a search comes by them.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Mapping, Sequence, Set

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from mrtamp.intra_orbit.lazy_validate import pair_is_apart
from mrtamp.modes import Mode
from mrtamp.problem import CostWeights
from mrtamp.roadmap import Roadmap, prm_star_neighbours
from mrtamp.tensor_tree import At
from mrtamp.validity import Validity

Pair = tuple[int, int]
_LEAST = 1e-9
"""Length of edges of length zero: sparse matrices know no others."""


class CompositeRoadmap:
    """Composite vertices, and the edges among those that all modes share.

    Attributes
    ----------
    at : vertex -> the robots' roadmap vertices, in the order of `names`.
    shared : the vertices that every layer has.
    u, v, w : ends, as positions in `shared`, and costs of the edges among them.
    """

    def __init__(self, roadmaps: Mapping[str, Roadmap], validity: Validity, weights: CostWeights) -> None:
        self.roadmaps = list(roadmaps.values())
        self.names = list(roadmaps)
        self.validity = validity
        self.weights = weights
        self.trouble: Counter[tuple[str, str]] = Counter()
        self.n_dof = sum(g.n_dof for g in self.roadmaps)
        self._cuts = np.cumsum([0, *(g.n_dof for g in self.roadmaps)])
        self.at: list[At] = []
        self._number: dict[At, int] = {}
        self._q = np.empty((256, self.n_dof))
        self.shared: list[int] = []
        self.u, self.v = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
        self.w = np.zeros(0)

    def add(self, at: At) -> int:
        """The vertex at which the robots stand at these vertices of theirs."""
        known = self._number.get(at)
        if known is not None:
            return known
        i = len(self.at)
        if i == len(self._q):
            self._q = np.concatenate([self._q, np.empty_like(self._q)])
        self._q[i] = np.concatenate([g.q[v] for g, v in zip(self.roadmaps, at, strict=True)])
        self.at.append(at)
        self._number[at] = i
        return i

    def vertices(self, q: Sequence[np.ndarray]) -> At:
        """New vertices of all robots at configurations (n,), without edges of their own."""
        return tuple(g.add_vertex(x, connect=False) for g, x in zip(self.roadmaps, q, strict=True))

    def q(self, vertices: Sequence[int] | int) -> np.ndarray:
        """Composite configurations (V, n) or (n,)."""
        return self._q[vertices]

    def parts(self, q: np.ndarray) -> list[np.ndarray]:
        """A composite configuration (..., n) robot by robot."""
        return [q[..., a:b] for a, b in zip(self._cuts[:-1], self._cuts[1:], strict=True)]

    def distance(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Cost (...,) of the straight synchronous motion between composite configurations (..., n)."""
        lengths = np.stack([np.linalg.norm(x, axis=-1) for x in self.parts(b - a)])
        return self.weights.makespan * lengths.max(axis=0) + self.weights.path_length * lengths.sum(axis=0)

    def share(self, vertices: Sequence[int]) -> None:
        """Make vertices part of every layer, each joined to its k nearest, k as PRM* asks."""
        u, v, w = [self.u], [self.v], [self.w]
        for i in vertices:
            n = len(self.shared)
            if n:
                cost = self.distance(self.q(self.shared), self.q(i))
                k = min(prm_star_neighbours(n, self.n_dof), n)
                near = np.argpartition(cost, k - 1)[:k]
                u.append(np.full(k, n))
                v.append(near)
                w.append(cost[near])
            self.shared.append(i)
        self.u, self.v, self.w = np.concatenate(u), np.concatenate(v), np.concatenate(w)

    # -- what is free ---------------------------------------------------------------------------------------------

    def stands(self, mode: Mode, i: int) -> bool:
        """Whether the robots may stand at a vertex in `mode`."""
        return self._is_free(mode, self.at[i], self.at[i])

    def moves(self, mode: Mode, i: int, j: int) -> bool:
        """Whether the robots may move straight from one vertex to another in `mode`."""
        return self._is_free(mode, self.at[i], self.at[j])

    def _is_free(self, mode: Mode, a: At, b: At) -> bool:
        for g, s, t in zip(self.roadmaps, a, b, strict=True):
            if not self.validity.edge(g.name, g.edge(s, t), mode):
                self.trouble[g.name, "world"] += 1
                return False
        for i in range(len(a)):
            for j in range(i + 1, len(a)):
                if not pair_is_apart(self.roadmaps, self.validity, mode, a, b, i, j):
                    self.trouble[self.names[i], self.names[j]] += 1
                    return False
        return True


class Layer:
    """The composite roadmap of one mode: shared samples, its own vertices, and what was found out about both.

    Attributes
    ----------
    own : vertices of this layer alone; `links` are edges of theirs that are there whatever is nearest.
    """

    def __init__(self, roadmap: CompositeRoadmap, mode: Mode) -> None:
        self.roadmap = roadmap
        self.mode = mode
        self.visits = 0
        self.own: list[int] = []
        self.links: dict[Pair, None] = {}
        self._lonely: set[int] = set()
        self._place: dict[int, int] = {}
        self._free: set[Pair] = set()
        self._hit: set[Pair] = set()
        self._vertex: dict[int, bool] = {}
        self._built: tuple[int, int, int] = (-1, -1, -1)
        self._trees: dict[int, tuple[int, np.ndarray, np.ndarray]] = {}
        self.version = 0

    def add(self, i: int, *, joined: bool = True) -> None:
        """Add a vertex; `joined` to its k nearest, else by its links alone."""
        if i not in self._place:
            self._place[i] = len(self.own)
            self.own.append(i)
            if not joined:
                self._lonely.add(i)

    def forget(self, vertices: Set[int]) -> None:
        """Take own vertices away, with their links."""
        self.own = [i for i in self.own if i not in vertices]
        self._place = {i: k for k, i in enumerate(self.own)}
        self.links = {pair: None for pair in self.links if not vertices & set(pair)}
        self._trees.clear()
        self._built = (-1, -1, -1)

    def link(self, i: int, j: int, *, free: bool = False) -> None:
        """Add an edge between two own vertices; `free`: it is known to be."""
        if i != j:
            self.links[_pair(i, j)] = None
            if free:
                self._free.add(_pair(i, j))
                self._vertex[i] = self._vertex[j] = True

    def block(self, i: int, j: int) -> None:
        """An edge, or a vertex (i = j), was found out to be in collision."""
        if i == j:
            self._vertex[i] = False
        self._free.discard(_pair(i, j))
        self._hit.add(_pair(i, j))
        self.version += 1

    # -- search ---------------------------------------------------------------------------------------------------

    def distances(self, source: int, targets: Sequence[int]) -> np.ndarray:
        """Costs (T,) of the cheapest paths from one own vertex to others past all that is known to be blocked."""
        distance, _ = self._tree(source)
        return distance[[self._index(t) for t in targets]]

    def path(self, source: int, target: int) -> list[int] | None:
        """The vertices of the cheapest such path, or None."""
        distance, parent = self._tree(source)
        i, first = self._index(target), self._index(source)
        if not np.isfinite(distance[i]):
            return None
        out = [i]
        while out[-1] != first:
            out.append(int(parent[out[-1]]))
        n = len(self.roadmap.shared)
        return [self.roadmap.shared[k] if k < n else self.own[k - n] for k in reversed(out)]

    def flaw(self, path: Sequence[int]) -> Pair | None:
        """The first vertex (twice) or edge of a path that is not free, which is blocked from then on; None: none is."""
        for i in path:
            if i not in self._vertex:
                self._vertex[i] = self.roadmap.stands(self.mode, i)
            if not self._vertex[i]:
                self.block(i, i)
                return i, i
        # The ends are the tightest parts: they fail first.
        edges = list(itertools.pairwise(path))
        for k in sorted(range(len(edges)), key=lambda k: min(k, len(edges) - 1 - k)):
            pair = _pair(*edges[k])
            if pair in self._free:
                continue
            if pair in self._hit or not self.roadmap.moves(self.mode, *pair):
                self.block(*pair)
                return pair
            self._free.add(pair)
        return None

    def _index(self, i: int) -> int:
        return len(self.roadmap.shared) + self._place[i]

    def _tree(self, source: int) -> tuple[np.ndarray, np.ndarray]:
        state = (len(self.roadmap.shared), len(self.own), len(self.links))
        if state != self._built:
            self._lay_out()
            self._built = state
            self.version += 1
        known = self._trees.get(source)
        if known is None or known[0] != self.version:
            distance, parent = dijkstra(
                self._matrix(), directed=False, indices=self._index(source), return_predecessors=True
            )
            known = self._trees[source] = (self.version, distance, parent)
        return known[1], known[2]

    def _lay_out(self) -> None:
        """The edges of all own vertices: the links, and to their nearest among the shared and the own ones."""
        roadmap = self.roadmap
        n = len(roadmap.shared)
        ends = [np.array([[self._index(i), self._index(j)] for i, j in self.links], dtype=np.int64).reshape(-1, 2)]
        joined = [i for i in self.own if i not in self._lonely]
        members = [*range(n), *(self._index(i) for i in joined)]
        vertices = [*roadmap.shared, *joined]
        q = roadmap.q(vertices)
        k = min(prm_star_neighbours(len(vertices), roadmap.n_dof), len(vertices) - 1)
        for row, i in enumerate(joined, start=n):
            if k > 0:
                near = np.argpartition(roadmap.distance(q, roadmap.q(i)), k)[: k + 1]
                near = near[near != row]
                ends.append(np.column_stack([np.full(len(near), members[row]), np.array(members)[near]]))
        edges = np.unique(np.sort(np.concatenate(ends), axis=1), axis=0)
        self._ids = np.array([*roadmap.shared, *self.own], dtype=np.int64)
        a, b = self._ids[edges].T
        self._u, self._v = np.concatenate([roadmap.u, edges[:, 0]]), np.concatenate([roadmap.v, edges[:, 1]])
        self._w = np.maximum(np.concatenate([roadmap.w, roadmap.distance(roadmap.q(a), roadmap.q(b))]), _LEAST)

    def _matrix(self) -> csr_array:
        w = self._w.copy()
        if self._hit:
            n, code = len(self._ids), np.array([i * 2**32 + j for i, j in self._hit])
            a, b = self._ids[self._u], self._ids[self._v]
            w[np.isin(np.minimum(a, b) * 2**32 + np.maximum(a, b), code)] = np.inf
            bad = np.isin(self._ids, [i for i, j in self._hit if i == j])
            w[bad[self._u] | bad[self._v]] = np.inf
        n = len(self._ids)
        keep = np.isfinite(w)
        return csr_array((w[keep], (self._u[keep], self._v[keep])), shape=(n, n))


def _pair(i: int, j: int) -> Pair:
    return (i, j) if i <= j else (j, i)
