"""Constituent roadmaps G_r: one per robot, shared by all modes, growing for ever, validated lazily (paper, section V).

A roadmap knows geometry (configurations, lengths, sampled edges) and search; whether an edge is free in a mode is the
business of `mrtamp.validity`.  Transition configurations are vertices that are reached through their own approach
chain.
"""

from __future__ import annotations

import heapq
import itertools
from array import array
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from mrtamp.collision import RESOLUTION, Collision, RobotWorld
from mrtamp.problem import Problem, RobotAt

_COARSE = 5
_HAND = 0.1
"""Distance (m) from the tool frame that is tracked along edges where nothing larger is carried."""
_KEPT_SPHERES = 20_000
"""Edges per robot whose bounding spheres are kept (some 8 kB each): old ones are computed again when asked for."""
_LEAST_LENGTH = 1e-9
"""What searches take an edge to be at least as long as (rad): sparse matrices have no edges of length zero."""
_ROUNDING = 1e-12
"""Difference of lengths (rad) that is none."""
_EXPANSIONS, _DIJKSTRA = 10, 40
"""Vertices that A* may expand, and in proportion to how many one more: then Dijkstra's algorithm is quicker."""


class Roadmap:
    """Vertices are configurations of one robot, edges straight lines in joint space.

    Attributes
    ----------
    q : (V, n) configurations.  u, v, w : (E,) end vertices and Euclidean lengths (rad) of the edges.
    contact : edge -> body that a held object may touch on it (its lift edges).
    exits : contact vertex -> the vertices of its chains, nearest first; other vertices are their own exit.
    joined : two vertices -> the path between them that was last found beside the roadmap, in whatever mode, and how
        often it may still be used before another is looked for.
    """

    def __init__(self, world: RobotWorld, reach: float = _HAND) -> None:
        self.world = world
        self.name = world.name
        self.n_dof = world.chain.n
        self._q = np.empty((64, self.n_dof))
        self._ends = np.empty((256, 2), dtype=np.int32)
        self._w = np.empty(256)
        self.n_vertices = 0
        self.n_edges = 0
        # Of every vertex: the vertices that share an edge with it, and the numbers of these edges.  There are millions.
        self._adjacent: list[array[int]] = []
        self._incident: list[array[int]] = []
        self._standing: dict[int, int] = {}
        """Vertex -> its edge to itself."""
        self._arcs = _Arcs()
        self.contact: dict[int, tuple[str, str]] = {}
        self.exits: dict[int, list[int]] = {}
        self.joined: dict[tuple[int, int], tuple[list[int], int]] = {}
        self._open: list[int] = []
        self._open_q = np.empty((64, self.n_dof))
        self._samples: dict[int, int] = {}
        self._spheres: dict[int, np.ndarray] = {}
        # Points of the hand (and of the largest object it may carry) that rotate far from any body's centre.
        self._points = np.array([[0, 0, 0], [reach, 0, 0], [0, reach, 0], [0, 0, reach]])
        self.inserted: Callable[[str, int], object] | None = None
        """Called with the robot and every new edge, where edges are not to wait until a search asks about them."""

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
        self._adjacent.append(array("i"))
        self._incident.append(array("i"))
        if connect:
            self._connect(i)
            self._open_up(i)
        return i

    def add_vertices(self, q: np.ndarray) -> None:
        """Add configurations (m, n) one after another, each joined as by `add_vertex`, in far less time."""
        before = len(self._open)
        if len(q) < 2 or not before:
            for x in q:
                self.add_vertex(x)
            return
        most = min(before, prm_star_neighbours(before + len(q), self.n_dof))
        far, old = cKDTree(self._open_q[:before]).query(q, k=np.arange(1, most + 1))
        among = cdist(q, q)
        joined = []
        for m, x in enumerate(q):
            self._open_up(self.add_vertex(x, connect=False))
            others, distance = np.append(old[m], np.arange(before, before + m)), np.append(far[m], among[m, :m])
            nearest = self._nearest(distance, before + m)
            joined.append((others[nearest], distance[nearest]))
        opened = np.array(self._open, dtype=np.int32)
        many = [len(others) for others, _ in joined]
        to, w = (np.concatenate(x) for x in zip(*joined, strict=True))
        self._add_edges(opened[to], np.repeat(opened[before:], many), w)

    def _open_up(self, i: int) -> None:
        n = len(self._open)
        if n == len(self._open_q):
            self._open_q = np.concatenate([self._open_q, np.empty_like(self._open_q)])
        self._open_q[n] = self._q[i]
        self._open.append(i)

    def _connect(self, i: int) -> None:
        n = len(self._open)
        distance = np.linalg.norm(self._open_q[:n] - self._q[i], axis=1)
        nearest = self._nearest(distance, n)
        for j, d in zip(nearest.tolist(), distance[nearest].tolist(), strict=True):
            self._add_edge(self._open[j], i, d)

    def _nearest(self, distance: np.ndarray, n: int) -> np.ndarray:
        """Which of the vertices at some distances, the nearest first, a new one is joined to when n are open."""
        k = prm_star_neighbours(n, self.n_dof)
        nearest = np.argpartition(distance, k)[:k] if k < len(distance) else np.arange(len(distance))
        return nearest[np.argsort(distance[nearest], kind="stable")]

    def edge(self, a: int, b: int) -> int:
        """The edge between two vertices, made if need be; (a, a) is the degenerate edge of standing at a."""
        known = self._find_edge(a, b)
        if known is not None:
            return known
        return self._add_edge(min(a, b), max(a, b), float(np.linalg.norm(self._q[a] - self._q[b])))

    def _find_edge(self, a: int, b: int) -> int | None:
        if a == b:
            return self._standing.get(a)
        if len(self._adjacent[b]) < len(self._adjacent[a]):
            a, b = b, a
        try:
            return self._incident[a][self._adjacent[a].index(b)]
        except ValueError:
            return None

    def _add_edge(self, a: int, b: int, length: float) -> int:
        """A new edge, a <= b."""
        self._make_room(1)
        e = self.n_edges
        self._ends[e, 0], self._ends[e, 1], self._w[e] = a, b, length
        self.n_edges += 1
        if a == b:
            self._standing[a] = e
            return e
        for v, w in ((a, b), (b, a)):
            self._adjacent[v].append(w)
            self._incident[v].append(e)
        self._arcs.add(a, b, e)
        if self.inserted is not None:
            self.inserted(self.name, e)
        return e

    def _add_edges(self, a: np.ndarray, b: np.ndarray, length: np.ndarray) -> None:
        """New edges (m,) between different vertices, a < b, as by `_add_edge` one after another."""
        self._make_room(len(a))
        fresh = np.arange(self.n_edges, self.n_edges + len(a), dtype=np.int32)
        self._ends[fresh, 0], self._ends[fresh, 1], self._w[fresh] = a, b, length
        self.n_edges += len(a)
        at, across = self._ends[fresh].ravel(), self._ends[fresh, ::-1].ravel()
        order = np.argsort(at, kind="stable")
        vertices, first = np.unique(at[order], return_index=True)
        for v, part in zip(vertices.tolist(), np.split(order, first[1:]), strict=True):
            self._adjacent[v].frombytes(across[part].tobytes())
            self._incident[v].frombytes(fresh[part // 2].tobytes())
        self._arcs.forget()
        if self.inserted is not None:
            for e in fresh.tolist():
                self.inserted(self.name, e)

    def _make_room(self, more: int) -> None:
        while self.n_edges + more > len(self._w):
            self._ends = np.concatenate([self._ends, np.empty_like(self._ends)])
            self._w = np.concatenate([self._w, np.empty_like(self._w)])

    def length(self, a: int, b: int) -> float:
        """Length (rad) of the straight motion between two vertices."""
        e = self._find_edge(a, b)
        return float(self._w[e]) if e is not None else float(np.linalg.norm(self._q[b] - self._q[a]))

    def n_samples(self, e: int) -> int:
        """How many samples, ends included, keep consecutive ones within the resolution."""
        known = self._samples.get(e)
        if known is None:
            a, b = self._ends[e]
            known = 1 if a == b else samples_between(self.world, self._points, self._q[a], self._q[b])
            self._samples[e] = known
        return known

    def find(self, q: np.ndarray, tolerance: float = 0.0) -> int | None:
        """The first vertex at a configuration (n,), every joint within `tolerance` (rad or m); None: there is none."""
        same = np.flatnonzero(np.max(np.abs(self.q - q), axis=1) <= tolerance)
        return int(same[0]) if len(same) else None

    def samples_between(self, a: np.ndarray, b: np.ndarray) -> int:
        """How many samples of the straight motion a -> b keep every tracked point's steps within the resolution."""
        return samples_between(self.world, self._points, a, b)

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
            if len(self._spheres) > _KEPT_SPHERES:
                del self._spheres[next(iter(self._spheres))]
        return known

    def path_length(self, path: Sequence[int]) -> float:
        """Joint distance along vertices (rad or m)."""
        return float(np.linalg.norm(np.diff(self.q[list(path)], axis=0), axis=1).sum())

    def offer_direct(self, a: int, b: int) -> None:
        """Make the straight edges between the exits of two vertices: a k-nearest roadmap hides near-optimal ones."""
        for i in self.exits.get(a, [a]):
            for j in self.exits.get(b, [b]):
                if i != j:
                    self.edge(i, j)

    def shortest(self, start: int, goal: int, blocked: np.ndarray) -> list[int] | None:
        """Vertices of the shortest path that avoids edges marked in `blocked`, or None.

        `blocked` may be shorter than E: edges younger than it are not blocked.
        """
        return ShortestPaths(self, start, goal, blocked).path()

    def arcs(self, v: int) -> tuple[np.ndarray, np.ndarray]:
        """Vertices that share an edge with `v`, and the numbers of these edges."""
        return self._arcs.row(v, self.ends, self.n_vertices)

    def distances_to(self, target: int, blocked: np.ndarray | None = None) -> np.ndarray:
        """Lengths (V,), rad, of the shortest paths from every vertex to `target` that avoid `blocked` (E,) edges."""
        graph = self._arcs.weighted(self.ends, self.w, self.n_vertices, blocked)
        return dijkstra(graph, indices=target)[: self.n_vertices]

    def neighbours(self, a: int) -> Sequence[int]:
        """Vertices that share an edge with `a`, in the order in which the edges were made."""
        return self._adjacent[a]

    def chains(self, v: int) -> list[list[int]]:
        """The chains of a contact vertex, each from the vertex next to it outwards; none for other vertices."""
        out: list[list[int]] = []
        for w in self.exits.get(v, []):
            if not out or w in self._adjacent[v]:
                out.append([])
            out[-1].append(w)
        return out

    def open_vertices(self) -> Sequence[int]:
        """Vertices that are not transitions or their chains."""
        return self._open


class _Arcs:
    """Both directions of all edges as rows of a sparse matrix with room to grow.

    Searches and new edges alternate, and building the matrix takes longer than searching it.  So rows have spare
    places, where unused ones point at their own row with infinite weight, and the matrix is laid out anew only when
    there is no room left.
    """

    def __init__(self) -> None:
        self._start = np.zeros(1, dtype=np.int32)
        self._used = np.zeros(0, dtype=np.int64)
        self._target = np.zeros(0, dtype=np.int32)
        self._edge = np.zeros(0, dtype=np.int32)
        self._stale = True

    def forget(self) -> None:
        """Lay the rows out anew when they are asked for next: there are many new edges."""
        self._stale = True

    def add(self, a: int, b: int, e: int) -> None:
        """Add both directions of edge e."""
        if self._stale:
            return
        rows = len(self._used)
        if a >= rows or b >= rows:
            self._stale = True
            return
        for u, v in ((a, b), (b, a)):
            k = self._start[u] + self._used[u]
            if k == self._start[u + 1]:
                self._stale = True
                return
            self._target[k], self._edge[k] = v, e
            self._used[u] += 1

    def weighted(self, ends: np.ndarray, w: np.ndarray, n_vertices: int, blocked: np.ndarray | None) -> csr_array:
        """The matrix, with at least V rows, for edges `ends` (E, 2) of lengths w (E,); `blocked` (E,) are left out."""
        if self._stale or n_vertices > len(self._used):
            self._lay_out(ends, n_vertices)
        weight = np.full(len(w) + 1, np.inf)
        np.maximum(w, _LEAST_LENGTH, out=weight[:-1])
        if blocked is not None:
            weight[: len(blocked)][blocked] = np.inf
        n = len(self._used)
        return csr_array((weight[self._edge], self._target, self._start), shape=(n, n))

    def row(self, v: int, ends: np.ndarray, n_vertices: int) -> tuple[np.ndarray, np.ndarray]:
        """Where the edges (E, 2) lead from vertex v, and their numbers."""
        if self._stale or v >= len(self._used):
            self._lay_out(ends, n_vertices)
        places = slice(self._start[v], self._start[v] + self._used[v])
        return self._target[places], self._edge[places]

    def _lay_out(self, ends: np.ndarray, n_vertices: int) -> None:
        rows = n_vertices + n_vertices // 4 + 16
        e = np.flatnonzero(ends[:, 0] != ends[:, 1])
        u, v = ends[e].T
        source, target, edge = np.concatenate([u, v]), np.concatenate([v, u]), np.concatenate([e, e])
        # NumPy sorts small integers by radix, an order of magnitude faster.
        order = np.argsort(source.astype(np.min_scalar_type(rows)), kind="stable")
        self._used = np.bincount(source, minlength=rows)
        room = self._used + self._used // 4 + 8
        self._start = np.concatenate([[0], np.cumsum(room)]).astype(np.int32)
        self._target = np.repeat(np.arange(rows, dtype=np.int32), room)
        self._edge = np.full(len(self._target), -1, dtype=np.int32)
        first = np.cumsum(self._used) - self._used
        place = np.repeat(self._start[:-1] - first, self._used) + np.arange(len(order))
        self._target[place], self._edge[place] = target[order], edge[order]
        self._stale = False


class ShortestPaths:
    """Shortest paths between two vertices, asked for again and again while ever more edges are blocked.

    Distances to the goal that were computed with fewer edges blocked are lower bounds: A* with them hardly looks beside
    the path that it returns.  Where it does they are computed anew (lazy search: Dellin and Srinivasa, 2016).

    Parameters
    ----------
    blocked : (E,) marks edges to be avoided, and may change in place, from False to True only; edges younger than it
        are not blocked.
    """

    def __init__(self, roadmap: Roadmap, start: int, goal: int, blocked: np.ndarray) -> None:
        self._roadmap = roadmap
        self._start, self._goal = start, goal
        self._blocked = blocked
        self._look()

    def _look(self) -> None:
        self._to_go = self._roadmap.distances_to(self._goal, self._blocked)
        self._edges = self._roadmap.n_edges

    def path(self) -> list[int] | None:
        """Vertices of a shortest path, None where there is none."""
        if self._edges != self._roadmap.n_edges:
            self._look()
        if not np.isfinite(self._to_go[self._start]):
            return None
        found = self._search(_EXPANSIONS + self._roadmap.n_vertices // _DIJKSTRA)
        if found is None:
            self._look()
            # With the distances as they are now A* goes straight to the goal.
            found = self._search(np.inf) if np.isfinite(self._to_go[self._start]) else None
        return found

    def _search(self, most: float) -> list[int] | None:
        """A*; None where it would have to expand more vertices than that, or comes to an end without a path."""
        start, goal, to_go, w = self._start, self._goal, self._to_go, self._roadmap.w
        came = np.full(len(to_go), np.inf)
        parent = np.full(len(to_go), start)
        came[start] = 0.0
        queue = [(float(to_go[start]), start, 0.0)]
        while queue and most > 0:
            _, v, so_far = heapq.heappop(queue)
            if v == goal:
                path = [v]
                while path[-1] != start:
                    path.append(int(parent[path[-1]]))
                return path[::-1]
            if so_far > came[v]:
                continue
            most -= 1
            targets, edges = self._roadmap.arcs(v)
            cost = so_far + np.maximum(w[edges], _LEAST_LENGTH)
            total = cost + to_go[targets]
            better = (cost < came[targets] - _ROUNDING) & (total < np.inf) & self._free(edges)
            targets, cost, total = targets[better], cost[better], total[better]
            came[targets], parent[targets] = cost, v
            for entry in zip(total.tolist(), targets.tolist(), cost.tolist(), strict=True):
                heapq.heappush(queue, entry)
        return None

    def _free(self, edges: np.ndarray) -> np.ndarray:
        known = edges < len(self._blocked)
        if known.all():
            return ~self._blocked[edges]
        free = ~known
        free[known] = ~self._blocked[edges[known]]
        return free


def prm_star_neighbours(n: int, dof: int) -> int:
    """How many nearest of n vertices a new one is joined to: k > e (1 + 1/d) log n (Karaman and Frazzoli, 2011)."""
    return int(np.ceil(np.e * (1 + 1 / dof) * np.log(n + 1))) + 1


def samples_between(world: RobotWorld, points: np.ndarray, a: np.ndarray, b: np.ndarray) -> int:
    """Number of samples of the straight motion a -> b that keeps every tracked point's steps within RESOLUTION."""
    tracked, R, p = world.spheres_and_grasp(np.linspace(a, b, _COARSE))
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
    glance: Callable[[Sequence[int]], Sequence[int]] | None = None,
) -> list[int] | None:
    """Lazy shortest path: search, validate the edges of the answer, drop what fails, search again.

    `blocked` marks edges known to be invalid and is updated in place.  `glance` finds edges, of those it is given or
    beside them, that are blocked for certain, in less time than it takes to validate one.  None after `rounds` searches
    without success.
    """
    search = ShortestPaths(roadmap, start, goal, blocked)
    for _ in range(rounds):
        path = search.path()
        if path is None:
            return None
        edges = [roadmap.edge(a, b) for a, b in itertools.pairwise(path)]
        # The ends are the tightest parts: they fail first.
        edges = [edges[i] for i in sorted(range(len(edges)), key=lambda i: min(i, len(edges) - 1 - i))]
        seen = np.array(glance(edges) if glance is not None else [], dtype=int)
        if len(seen):
            blocked[seen[seen < len(blocked)]] = True
            continue
        for e in edges:
            if not validate(e):
                blocked[e] = True
                break
        else:
            return path
    return None


def roadmaps_of(problem: Problem, collision: Collision) -> dict[str, Roadmap]:
    """An empty roadmap for every robot, its edges sampled finely enough for the largest object it may carry."""
    reach = max([_HAND, *(r for world in collision.worlds.values() for r in world.object_radius.values())])
    return {robot.name: Roadmap(collision.worlds[robot.name], reach) for robot in problem.robots}


@dataclass(frozen=True)
class Stations:
    """Vertices by robot: where it starts, where it is at home, and, for some of them, where it has to end."""

    start: dict[str, int]
    home: dict[str, int]
    goal: dict[str, int]


def add_stations(problem: Problem, roadmaps: Mapping[str, Roadmap]) -> Stations:
    """Put the configurations that a problem names on empty roadmaps; the starts become their first vertices."""
    start, home, goal = {}, {}, {}
    for robot in problem.robots:
        name, roadmap = robot.name, roadmaps[robot.name]
        start[name] = home[name] = roadmap.add_vertex(robot.start)
        if np.max(np.abs(robot.home - robot.start)) > 0:
            home[name] = roadmap.add_vertex(robot.home)
        for condition in problem.goal:
            if isinstance(condition, RobotAt) and condition.robot == name:
                known = roadmap.find(condition.q)
                goal[name] = roadmap.add_vertex(condition.q) if known is None else known
    return Stations(start, home, goal)
