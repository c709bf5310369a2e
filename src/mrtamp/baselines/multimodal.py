"""The graph of transitions between the layers of a composite roadmap, and the lazy search for the cheapest plan in it.

Transitions are vertices; two are joined where one leads into the mode in which the other happens.  Such an edge costs
a straight motion until it is first part of the cheapest plan, then the cheapest path through the layer, whose edges
are validated when nothing else remains to be done: optimal on the roadmap, like A* with lazy validation, with the
search in a mode done once for all plans that pass through it.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from mrtamp.baselines.composite import CompositeRoadmap, Layer
from mrtamp.modes import Mode
from mrtamp.plan import Segment, Transition
from mrtamp.roadmap import prm_star_neighbours
from mrtamp.tensor_tree import At

_LEAST = 1e-9


@dataclass(eq=False)
class Crossing:
    """A transition at a composite vertex: from layer `before` to layer `after`.

    The start has no `before` and no transition, the end of a plan no `after` and no transition.  `gates` are the
    vertices of the layers through which it is reached and left, `vertices` all that are there because of it.
    """

    number: int
    vertex: int
    before: Layer | None
    after: Layer | None
    transition: Transition | None
    cost: float
    gates: tuple[int, ...]
    vertices: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Found:
    """A path through the layers: crossings from the start to an end, the vertices between them, and what it costs."""

    crossings: tuple[Crossing, ...]
    paths: tuple[list[int], ...]
    cost: float

    @property
    def transitions(self) -> list[Transition]:
        """What happens on the way."""
        return [c.transition for c in self.crossings if c.transition is not None]


class Multimodal:
    """Layers by mode, crossings between them, and the search.

    Attributes
    ----------
    layers : mode key -> layer, in the order in which they were found.
    ends : numbers of crossings that end a plan.  adopted : crossings of plans that were made elsewhere.
    """

    def __init__(self, roadmap: CompositeRoadmap) -> None:
        self.roadmap = roadmap
        self.layers: dict[tuple, Layer] = {}
        self.crossings: list[Crossing] = []
        self.ends: list[int] = []
        self.entries: dict[Layer, list[Crossing]] = {}
        self.exits: dict[Layer, list[Crossing]] = {}
        self.adopted: list[Crossing] = []
        self._banned: set[int] = set()
        self._source: list[np.ndarray] = []
        self._target: list[np.ndarray] = []
        self._bound: list[np.ndarray] = []
        self._closed: set[int] = set()
        self._weight = np.zeros(0)
        self._edge: dict[tuple[int, int], int] = {}
        self._exact: dict[int, int] = {}

    def layer(self, mode: Mode) -> Layer:
        """The layer of a mode, made if need be."""
        found = self.layers.get(mode.key)
        if found is None:
            found = self.layers[mode.key] = Layer(self.roadmap, mode)
            self.entries[found], self.exits[found] = [], []
        return found

    def cross(
        self,
        at: At,
        before: Layer | None,
        after: Layer | None,
        transition: Transition | None = None,
        cost: float = 0.0,
        chains: Sequence[Sequence[At]] = (),
        *,
        gated: bool = True,
    ) -> Crossing:
        """Add a crossing; each of `chains` leads from its vertex to where the robots are free to move.

        Unless `gated`, it is reached and left by links that are made for it.
        """
        i = self.roadmap.add(at)
        ways = [[i, *(self.roadmap.add(x) for x in chain)] for chain in chains]
        gates = (tuple(dict.fromkeys(way[-1] for way in ways)) or (i,)) if gated else ()
        for layer in (before, after):
            if layer is not None:
                layer.add(i, joined=gated and not ways)
                for way in ways:
                    for a, b in itertools.pairwise(way):
                        layer.add(b)
                        layer.link(a, b)
        vertices = tuple(dict.fromkeys([i, *itertools.chain(*ways)]))
        crossing = Crossing(len(self.crossings), i, before, after, transition, cost, gates, vertices)
        self.crossings.append(crossing)
        if before is not None:
            self._connect(self.entries[before], [crossing])
            self.exits[before].append(crossing)
            self._link(before, crossing, self.entries[before])
        if after is not None:
            self._connect([crossing], self.exits[after])
            self.entries[after].append(crossing)
            self._link(after, crossing, self.exits[after])
        else:
            self.ends.append(crossing.number)
        return crossing

    def _connect(self, entries: Sequence[Crossing], exits: Sequence[Crossing]) -> None:
        for one, two in itertools.product(entries, exits):
            self._edge[one.number, two.number] = len(self._edge)
            self._source.append(np.array([one.number]))
            self._target.append(np.array([two.number]))
            straight = self.roadmap.distance(self.roadmap.q(one.vertex), self.roadmap.q(two.vertex))
            self._bound.append(np.array([max(float(straight), _LEAST) + two.cost]))

    def _link(self, layer: Layer, crossing: Crossing, others: Sequence[Crossing]) -> None:
        """Straight edges between a crossing and the nearest of those at the other ends of motions in a layer.

        The nearest vertices of a roadmap hide near-optimal straight motions.
        """
        if not others:
            return
        far = self.roadmap.distance(self.roadmap.q([o.vertex for o in others]), self.roadmap.q(crossing.vertex))
        k = prm_star_neighbours(len(others), self.roadmap.n_dof)
        for o in np.argsort(far, kind="stable")[:k].tolist():
            for a, b in itertools.product(crossing.gates, others[o].gates):
                layer.link(a, b)

    def prune(self, limit: float) -> None:
        """Forget crossings, and their vertices, by way of which plans with straight motions cost more than `limit`.

        What does not lead to an end yet stays.  Whatever goes may be sampled again.
        """
        forward, backward = self.bounds()
        gone = np.isinf(forward) | (np.isfinite(backward) & (forward + backward > limit + _LEAST))
        gone[0] = False
        if not gone.any():
            return
        for layer in self.entries:
            for known in (self.entries, self.exits):
                known[layer] = [c for c in known[layer] if not gone[c.number]]
        for mode in [mode for mode, layer in self.layers.items() if not self.entries[layer]]:
            layer = self.layers.pop(mode)
            del self.entries[layer], self.exits[layer]
        self.ends = [i for i in self.ends if not gone[i]]
        self.adopted = [c for c in self.adopted if not gone[c.number]]
        dropped: dict[Layer, set[int]] = {}
        for c in self.crossings:
            for side in (c.before, c.after) if gone[c.number] else ():
                if side is not None and side in self.entries:
                    dropped.setdefault(side, set()).update(c.vertices)
        for layer, vertices in dropped.items():
            layer.forget(vertices - {i for c in (*self.entries[layer], *self.exits[layer]) for i in c.vertices})
        kept = ~(gone[self._sources] | gone[self._targets])
        self._source, self._target, self._bound = [self._sources[kept]], [self._targets[kept]], [self._bounds[kept]]
        pairs = zip(self._source[0].tolist(), self._target[0].tolist(), strict=True)
        self._edge = {pair: e for e, pair in enumerate(pairs)}
        self.refresh()

    def adopt(self, modes: Sequence[Mode], paths: Sequence[Sequence[int]], transitions: Sequence[Transition]) -> None:
        """Put a checked plan into the graph: the vertices of its motion in every mode, and what happens between."""
        for k, path in enumerate(paths):
            layer = self.layer(modes[k])
            for i in path[1:-1]:
                layer.add(i)
            end, cost = self.roadmap.at[path[-1]], 0.0
            if k < len(transitions):
                cost = self.roadmap.weights.of_changes(a.kind for a in transitions[k].actions)
                new = self.cross(end, layer, self.layer(modes[k + 1]), transitions[k], cost, gated=False)
            else:
                new = self.cross(end, layer, None, gated=False)
            for a, b in itertools.pairwise(path):
                layer.link(a, b, free=True)
            self.adopted.append(new)

    def ban(self, crossing: Crossing) -> None:
        """No plan goes through this crossing any more."""
        self._banned.add(crossing.number)

    # -- search ---------------------------------------------------------------------------------------------------

    def refresh(self) -> None:
        """The roadmap has grown: costs in the layers may have gone down."""
        self._exact.clear()
        self._weight = np.zeros(0)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower bounds (C,) of the cost from the start to every crossing, and from there to the nearest end."""
        self._gather()
        self._closed = self._banned
        forward = self._distances(self._bounds, [0])
        backward = (
            self._distances(self._bounds, self.ends, reverse=True) if self.ends else np.full_like(forward, np.inf)
        )
        return forward, backward

    def cheapest(self, below: float, late: Callable[[], bool], *, anew: bool = False) -> Found | None:
        """The cheapest valid path from the start (crossing 0) to an end; None if none costs less than `below`.

        `late` ends the search early, without a result; `anew` leaves the crossings of adopted plans out.
        """
        if not self.ends:
            return None
        self._gather()
        self._closed = self._banned | ({c.number for c in self.adopted} if anew else set())
        while not late():
            chain = self._chain(below)
            if chain is None:
                return None
            pending = [(a, b) for a, b in itertools.pairwise(chain) if not self._is_exact(a, b)]
            if pending:
                for a, _ in pending:
                    self._evaluate(self.crossings[a])
                continue
            crossings = [self.crossings[i] for i in chain]
            paths = []
            for one, two in itertools.pairwise(crossings):
                assert one.after is not None
                path = one.after.path(one.vertex, two.vertex)
                assert path is not None
                while path is not None and one.after.flaw(path) is not None and not late():
                    # Other ways through this layer come first while they cost no more.
                    again = one.after.path(one.vertex, two.vertex)
                    path = again if again is not None and self._length(again) <= self._length(path) + _LEAST else None
                if path is None or late():
                    break
                paths.append(path)
            else:
                return Found(tuple(crossings), tuple(paths), float(self._cost(chain)))
        return None

    def _length(self, path: Sequence[int]) -> float:
        q = self.roadmap.q(path)
        return float(self.roadmap.distance(q[:-1], q[1:]).sum())

    def _gather(self) -> None:
        """Bring the arrays of edges up to date."""
        if not self._source:
            self._sources, self._targets, self._bounds = np.zeros(0, int), np.zeros(0, int), np.zeros(0)
            return
        if len(self._source) > 1:
            self._source = [np.concatenate(self._source)]
            self._target = [np.concatenate(self._target)]
            self._bound = [np.concatenate(self._bound)]
        self._sources, self._targets, self._bounds = self._source[0], self._target[0], self._bound[0]
        self._weight = np.concatenate([self._weight, self._bounds[len(self._weight) :]])

    def _distances(self, weight: np.ndarray, sources: Iterable[int], *, reverse: bool = False) -> np.ndarray:
        graph = self._graph(weight)
        graph = csr_array(graph.T) if reverse else graph
        return dijkstra(graph, indices=list(sources), min_only=True)

    def _graph(self, weight: np.ndarray) -> csr_array:
        keep = np.isfinite(weight)
        if self._closed:
            closed = np.zeros(len(self.crossings), dtype=bool)
            closed[list(self._closed)] = True
            keep &= ~closed[self._sources] & ~closed[self._targets]
        n = len(self.crossings)
        return csr_array((weight[keep], (self._sources[keep], self._targets[keep])), shape=(n, n))

    def _chain(self, below: float) -> list[int] | None:
        """Numbers of the crossings on the path that is cheapest as far as is known."""
        distance, parent = dijkstra(self._graph(self._weight), indices=0, return_predecessors=True)
        end = min(self.ends, key=lambda i: float(distance[i]))
        if not distance[end] < below:
            return None
        out = [end]
        while out[-1] != 0:
            out.append(int(parent[out[-1]]))
        return out[::-1]

    def _cost(self, chain: Sequence[int]) -> float:
        return sum(self._weight[self._edge[a, b]] for a, b in itertools.pairwise(chain))

    def _is_exact(self, a: int, b: int) -> bool:
        layer = self.crossings[a].after
        assert layer is not None
        return self._exact.get(self._edge[a, b]) == layer.version

    def _evaluate(self, entry: Crossing) -> None:
        """The costs through the layer from one entry to all exits, past what is known to be blocked."""
        layer = entry.after
        assert layer is not None
        exits = self.exits[layer]
        costs = layer.distances(entry.vertex, [x.vertex for x in exits])
        for x, cost in zip(exits, costs.tolist(), strict=True):
            e = self._edge[entry.number, x.number]
            self._weight[e] = max(cost, _LEAST) + x.cost
            self._exact[e] = layer.version

    # -- plans ----------------------------------------------------------------------------------------------------

    def segments(self, found: Found) -> list[Segment]:
        """The motions of a path, one segment per layer."""
        out = []
        for crossing, path in zip(found.crossings, found.paths, strict=False):
            assert crossing.after is not None
            q = self.roadmap.parts(self.roadmap.q(path))
            out.append(Segment(crossing.after.mode, {r: x.copy() for r, x in zip(self.roadmap.names, q, strict=True)}))
        return out
