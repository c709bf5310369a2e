"""Disc robots in a plane with round obstacles, on roadmaps drawn by hand: every verdict is a distance in closed form.

`Flatland` is the planner's own `Validity`, caches and all, of which only the geometric questions are answered
here instead of by Drake.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from types import SimpleNamespace

import networkx as nx
import numpy as np

from mrtamp.collision import Counts
from mrtamp.graphs import Graphs
from mrtamp.intra_orbit.orbits import Orbits
from mrtamp.modes import Attachment, Mode
from mrtamp.problem import CostWeights
from mrtamp.roadmap import Roadmap
from mrtamp.tensor_tree import At, Node, TensorTree
from mrtamp.validity import Label, Validity

MODE = Mode(())
WEIGHTS = CostWeights(makespan=1.0, path_length=0.1)


def nearest_approach(start: np.ndarray, end: np.ndarray) -> float:
    """Least distance of the origin from the segment between two points (2,)."""
    way = end - start
    t = np.clip(-(start @ way) / max(way @ way, 1e-12), 0.0, 1.0)
    return float(np.linalg.norm(start + t * way))


class Flatland(Validity):
    """Discs of one radius among round obstacles (centre, radius)."""

    def __init__(self, roadmaps: Sequence[Roadmap], radius: float, obstacles: Sequence[tuple] = ()) -> None:
        nothing = SimpleNamespace(statics=())
        super().__init__(nothing, SimpleNamespace(counts=Counts()), {g.name: g for g in roadmaps})  # type: ignore[arg-type]
        self.radius = radius
        self.obstacles = [(np.asarray(p), r) for p, r in obstacles]
        self.asked = 0

    def glance(self, robot: str, edges: Sequence[int], mode: Mode) -> list[int]:
        """Verdicts in closed form come soon enough."""
        return []

    def _ask(self, robot: str, e: int, held: Attachment | None, static: Label, unknown: list) -> bool:
        assert held is None and not unknown
        self.asked += 1
        a, b = self.roadmaps[robot].q[self.roadmaps[robot].ends[e]]
        free = all(nearest_approach(a - p, b - p) > self.radius + r for p, r in self.obstacles)
        static.put(e, free)
        return free

    def _apart(
        self, a: str, ea: int, held_a: Attachment | None, b: str, eb: int, held_b: Attachment | None, opposed: bool
    ) -> bool:
        self.asked += 1
        one, two = (self.roadmaps[r].q[self.roadmaps[r].ends[e]] for r, e in ((a, ea), (b, eb)))
        gap = one - (two[::-1] if opposed else two)
        return nearest_approach(gap[0], gap[1]) > 2 * self.radius


def roadmap(name: str, points: Sequence[Sequence[float]], edges: Sequence[tuple[int, int]]) -> Roadmap:
    """A roadmap with exactly these vertices and edges."""
    world = SimpleNamespace(name=name, chain=SimpleNamespace(n=2))
    out = Roadmap(world)  # type: ignore[arg-type]
    for q in points:
        out._open_up(out.add_vertex(np.array(q, dtype=float), connect=False))
    for a, b in edges:
        out.edge(a, b)
    return out


def grid(name: str, columns: int, rows: int, jitter: float = 0.0, seed: int = 0) -> Roadmap:
    """A grid of unit squares with their edges and one diagonal each; vertex x + columns * y."""
    rng = np.random.default_rng(seed)
    cells = [(x, y) for y in range(rows) for x in range(columns)]
    points = [np.array(c) + jitter * rng.uniform(-1, 1, size=2) for c in cells]
    edges = []
    for (i, a), (j, b) in itertools.combinations(enumerate(cells), 2):
        if (b[0] - a[0], b[1] - a[1]) in ((1, 0), (0, 1), (1, 1)):
            edges.append((i, j))
    return roadmap(name, [tuple(p) for p in points], edges)


def tensor_neighbours(roadmaps: Sequence[Roadmap], at: At) -> Iterator[At]:
    """Every vertex of the tensor product to which one synchronous step leads."""
    options = [[v, *g.neighbours(v)] for g, v in zip(roadmaps, at, strict=True)]
    return (b for b in itertools.product(*options) if b != at)


def step_free(world: Flatland, roadmaps: Sequence[Roadmap], a: At, b: At) -> bool:
    """Brute force: the verdict on a step, asked of geometry directly and past all caches."""
    one, two = (np.array([g.q[v] for g, v in zip(roadmaps, at, strict=True)]) for at in (a, b))
    for p, q in zip(one, two, strict=True):
        if np.any(p != q) and any(nearest_approach(p - c, q - c) <= world.radius + r for c, r in world.obstacles):
            return False
    return all(
        nearest_approach(one[i] - one[j], two[i] - two[j]) > 2 * world.radius
        for i, j in itertools.combinations(range(len(a)), 2)
    )


def step_cost(roadmaps: Sequence[Roadmap], a: At, b: At, weights: CostWeights = WEIGHTS) -> float:
    """Cost of one step, from the definition."""
    lengths = [float(np.linalg.norm(g.q[v] - g.q[u])) for g, u, v in zip(roadmaps, a, b, strict=True)]
    return weights.makespan * max(lengths) + weights.path_length * sum(lengths)


def product_graph(world: Flatland, roadmaps: Sequence[Roadmap]) -> nx.Graph:
    """The tensor product with all of its valid steps: what the planner never builds."""
    graph = nx.Graph()
    for at in itertools.product(*(range(g.n_vertices) for g in roadmaps)):
        for b in tensor_neighbours(roadmaps, at):
            if at < b and step_free(world, roadmaps, at, b):
                graph.add_edge(at, b, weight=step_cost(roadmaps, at, b))
    return graph


class Setting:
    """A world with a tree rooted at `start`, grown through `Orbits`."""

    def __init__(self, world: Flatland, roadmaps: Sequence[Roadmap], start: At, rewirings: int = 0) -> None:
        self.world, self.roadmaps = world, list(roadmaps)
        self.graphs = Graphs()
        self.tree = TensorTree(self.roadmaps, WEIGHTS)
        self.orbits = Orbits(self.tree, self.graphs, self.roadmaps, world, rewirings)
        self.root = self.tree.add_root(MODE, start, self.graphs.add_orbit(MODE))

    def insert(self, node: Node, at: At) -> Node:
        """What intra-orbit planners are given."""
        return self.orbits.insert(node, at)[0]

    def alive(self) -> list[Node]:
        """Living nodes."""
        return [x for x in self.tree.nodes if x.alive]
