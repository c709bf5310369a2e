"""The tensor-product search tree T: nodes are (mode, one roadmap vertex per robot); the product is never built.

Motion nodes follow their parent by one synchronous step in which each robot moves along one edge of its roadmap or
stays; transition nodes follow theirs by a change of mode at the same vertices (paper, section V; dRRT*, Shome et al.
2020).  Every validated step and transition is kept as *proof*, and the tree is at all times the shortest-path tree
over what has been proved: a cheaper way is taken over by all that follows, also across transitions, and a step that
turns out invalid costs only what had no other way.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from mrtamp.modes import Mode
from mrtamp.plan import Segment, Transition
from mrtamp.problem import CostWeights
from mrtamp.roadmap import Roadmap

At = tuple[int, ...]
"""One roadmap vertex per robot, in the order of the problem's robots."""
_EPS = 1e-12


@dataclass(eq=False)
class Node:
    """A vertex of the search tree, with its cost-to-come.

    `steps` are the proved motions to and from nodes of the same mode (either direction, with their cost), `entries` the
    proved transitions that lead here, with their cost, by the node they start from, and `exits` the nodes that proved
    transitions lead to.
    """

    index: int
    mode: Mode
    at: At
    orbit: int
    cost: float
    parent: Node | None = None
    transition: Transition | None = None
    children: list[Node] = field(default_factory=list)
    alive: bool = True
    steps: dict[Node, float] = field(default_factory=dict)
    entries: dict[Node, tuple[Transition, float]] = field(default_factory=dict)
    exits: dict[Node, None] = field(default_factory=dict)


class TensorTree:
    """Nodes, proofs and costs.  Validation happens before a step is offered here."""

    def __init__(self, roadmaps: Sequence[Roadmap], weights: CostWeights) -> None:
        self.roadmaps = roadmaps
        self.weights = weights
        self.nodes: list[Node] = []
        self._find: dict[tuple[tuple, At], Node] = {}
        self._entries: dict[tuple, list[Node]] = {}
        self._of_mode: dict[tuple, _Rows] = {}
        self.of_orbit: dict[int, list[Node]] = {}

    def step_cost(self, a: At, b: At) -> float:
        """Cost of one synchronous step."""
        lengths = [
            float(np.linalg.norm(g.q[v] - g.q[u])) for g, u, v in zip(self.roadmaps, a, b, strict=True) if u != v
        ]
        if not lengths:
            return 0.0
        return self.weights.makespan * max(lengths) + self.weights.path_length * sum(lengths)

    def find(self, mode: Mode, at: At) -> Node | None:
        """The node at these vertices in this mode."""
        return self._find.get((mode.key, at))

    def entry(self, mode: Mode) -> Node | None:
        """The first node by which `mode` was entered that still stands."""
        return next((x for x in self._entries.get(mode.key, []) if x.alive), None)

    def adjacent(self, node: Node) -> tuple[list[Node], np.ndarray]:
        """The other nodes of the mode of which every vertex is the node's own or adjacent to it, and step costs (N,).

        These are its neighbours in the tensor product of the roadmaps, whatever orbit they are in.
        """
        rows = self._of_mode[node.mode.key]
        at = rows.at[: len(rows.nodes)]
        near = np.ones(len(at), dtype=bool)
        for i, (g, v) in enumerate(zip(self.roadmaps, node.at, strict=True)):
            mask = np.zeros(len(g.q), dtype=bool)
            mask[g.neighbours(v)] = True
            mask[v] = True
            near &= mask[at[:, i]]
        found = [int(k) for k in np.flatnonzero(near) if rows.nodes[k].alive and rows.nodes[k] is not node]
        lengths = np.array(
            [
                np.linalg.norm(g.q[at[found, i]] - g.q[v], axis=1)
                for i, (g, v) in enumerate(zip(self.roadmaps, node.at, strict=True))
            ]
        )
        costs = self.weights.makespan * lengths.max(axis=0) + self.weights.path_length * lengths.sum(axis=0)
        return [rows.nodes[k] for k in found], costs

    # -- growth ---------------------------------------------------------------------------------------------------

    def add_root(self, mode: Mode, at: At, orbit: int) -> Node:
        """The start."""
        return self._add(mode, at, orbit, 0.0, None, None)

    def insert(self, parent: Node, at: At) -> tuple[Node, bool]:
        """Take in a validated step within the parent's mode; returns (the node at its end, whether it is new)."""
        node, cost = self.find(parent.mode, at), self.step_cost(parent.at, at)
        new = node is None
        if node is None:
            node = self._add(parent.mode, at, parent.orbit, parent.cost + cost, parent, None)
        self._prove(parent, node, cost)
        return node, new

    def connect(self, a: Node, b: Node) -> None:
        """Take in a validated step between two nodes of one mode."""
        self._prove(a, b, self.step_cost(a.at, b.at))

    def _prove(self, a: Node, b: Node, cost: float) -> None:
        if a is b:
            return
        a.steps[b] = b.steps[a] = cost
        self._relax([a, b])

    def insert_transition(
        self, parent: Node, transition: Transition, mode: Mode, orbit: int | None, cost: float
    ) -> Node:
        """Take in a transition at the parent's vertices; `cost` is the transition's own, `orbit` that of a new node."""
        node = self.find(mode, parent.at)
        if node is None:
            assert orbit is not None
            node = self._add(mode, parent.at, orbit, parent.cost + cost, parent, transition)
        known = node.entries.get(parent)
        if known is None or cost < known[1]:
            node.entries[parent] = (transition, cost)
            parent.exits[node] = None
            self._relax([parent])
        return node

    def _add(
        self, mode: Mode, at: At, orbit: int, cost: float, parent: Node | None, transition: Transition | None
    ) -> Node:
        node = Node(len(self.nodes), mode, at, orbit, cost, parent, transition)
        self.nodes.append(node)
        self._find[mode.key, at] = node
        self.of_orbit.setdefault(orbit, []).append(node)
        if mode.key not in self._of_mode:
            self._of_mode[mode.key] = _Rows(len(at))
        self._of_mode[mode.key].append(node)
        if parent is None or transition is not None:
            self._entries.setdefault(mode.key, []).append(node)
        if parent is not None:
            parent.children.append(node)
        return node

    # -- costs ----------------------------------------------------------------------------------------------------

    def _relax(self, seeds: Iterable[Node]) -> None:
        """Spread costs from nodes whose cost or proofs changed for the better (Dijkstra's order)."""
        heap = [(x.cost, x.index, x) for x in seeds]
        heapq.heapify(heap)
        while heap:
            cost, _, x = heapq.heappop(heap)
            if cost != x.cost:
                continue
            for y, transition, step in self._leads_to(x):
                total = cost + step
                if total < y.cost - _EPS or (y.parent is x and total != y.cost):
                    self._adopt(x, y, transition, total)
                    heapq.heappush(heap, (total, y.index, y))

    @staticmethod
    def _leads_to(x: Node) -> Iterator[tuple[Node, Transition | None, float]]:
        for y, step in x.steps.items():
            yield y, None, step
        for y in x.exits:
            transition, step = y.entries[x]
            yield y, transition, step

    def _adopt(self, parent: Node, node: Node, transition: Transition | None, cost: float) -> None:
        if node.parent is not None and node.parent is not parent:
            node.parent.children.remove(node)
        if node.parent is not parent:
            parent.children.append(node)
        node.parent, node.transition, node.cost = parent, transition, cost

    # -- withdrawal -----------------------------------------------------------------------------------------------

    def refute(self, pairs: Iterable[tuple[Node, Node]]) -> list[Node]:
        """Withdraw proofs: the steps, or the transitions, from the first node of each pair to the second.

        What hung on them is attached by the cheapest proved way that is left; nodes without one are removed and
        returned.
        """
        loose: dict[Node, None] = {}
        for a, b in pairs:
            within = a.mode.key == b.mode.key
            if within:
                a.steps.pop(b, None)
                b.steps.pop(a, None)
            else:
                b.entries.pop(a, None)
                a.exits.pop(b, None)
            for x, y in ((a, b), (b, a)):
                if y.parent is x and (y.transition is None) == within:
                    loose[y] = None
        return self._reattach(loose)

    def _reattach(self, loose: Iterable[Node]) -> list[Node]:
        """Find new parents for nodes that lost theirs, and for all that follow them."""
        affected: dict[Node, None] = {}
        stack = list(loose)
        while stack:
            x = stack.pop()
            if x not in affected:
                affected[x] = None
                stack += x.children
        for x in affected:
            if x.parent is not None:
                x.parent.children.remove(x)
            x.parent, x.transition, x.cost = None, None, np.inf
        around = {y: None for x in affected for y in (*x.steps, *x.entries) if y.alive and y not in affected}
        self._relax(around)
        lost = [x for x in affected if x.parent is None]
        self._remove(lost)
        return lost

    def cut(self, node: Node) -> list[Node]:
        """Remove a node with everything that hangs on it; returns what was removed."""
        if node.parent is not None:
            node.parent.children.remove(node)
            node.parent = None
        gone, stack = [], [node]
        while stack:
            x = stack.pop()
            gone.append(x)
            stack += x.children
        self._remove(gone)
        return gone

    def _remove(self, gone: list[Node]) -> None:
        for x in gone:
            x.alive = False
            self._find.pop((x.mode.key, x.at), None)
            for y in x.steps:
                y.steps.pop(x, None)
            for y in x.entries:
                y.exits.pop(x, None)
            for y in x.exits:
                y.entries.pop(x, None)
            x.steps, x.entries, x.exits = {}, {}, {}
        for orbit in {x.orbit: None for x in gone}:
            self.of_orbit[orbit] = [x for x in self.of_orbit[orbit] if x.alive]

    # -- orbits ---------------------------------------------------------------------------------------------------

    def merge_orbits(self, kept: int, gone: int) -> None:
        """Relabel the nodes of an orbit that was merged into another."""
        for node in self.of_orbit.pop(gone, []):
            node.orbit = kept
            self.of_orbit.setdefault(kept, []).append(node)

    def components(self, orbit: int) -> list[list[Node]]:
        """The nodes of an orbit by what proved steps connect, in the order in which the components were entered."""
        out: list[list[Node]] = []
        seen: set[int] = set()
        for first in self.of_orbit.get(orbit, []):
            if first.index in seen:
                continue
            component, stack = [], [first]
            seen.add(first.index)
            while stack:
                x = stack.pop()
                component.append(x)
                fresh = [y for y in x.steps if y.index not in seen]
                seen.update(y.index for y in fresh)
                stack += fresh
            out.append(sorted(component, key=lambda x: x.index))
        return out

    def split_orbit(self, orbit: int, parts: Mapping[int, Sequence[Node]]) -> None:
        """Relabel parts of an orbit as orbits of their own."""
        for label, nodes in parts.items():
            for x in nodes:
                x.orbit = label
            self.of_orbit[label] = list(nodes)
        self.of_orbit[orbit] = [x for x in self.of_orbit[orbit] if x.orbit == orbit]

    # -- reading --------------------------------------------------------------------------------------------------

    def branch(self, node: Node) -> list[Node]:
        """Nodes from the root to `node`."""
        out = [node]
        while out[-1].parent is not None:
            out.append(out[-1].parent)
        return out[::-1]

    def trace(self, node: Node) -> tuple[list[Segment], list[Transition], list[list[Node]]]:
        """The motion to `node` as segments and transitions, and the nodes behind the waypoints of each segment."""
        groups: list[list[Node]] = []
        transitions: list[Transition] = []
        for x in self.branch(node):
            if x.parent is None or x.transition is not None:
                if x.transition is not None:
                    transitions.append(x.transition)
                groups.append([])
            groups[-1].append(x)
        segments = [
            Segment(g[0].mode, {m.name: m.q[[x.at[i] for x in g]].copy() for i, m in enumerate(self.roadmaps)})
            for g in groups
        ]
        return segments, transitions, groups


class _Rows:
    """The nodes of a mode and their vertices as rows of an array (N, robots), for vectorised look-ups."""

    def __init__(self, robots: int) -> None:
        self.nodes: list[Node] = []
        self.at = np.empty((16, robots), dtype=np.int64)

    def append(self, node: Node) -> None:
        """Add a node."""
        n = len(self.nodes)
        if n == len(self.at):
            self.nodes = [x for x in self.nodes if x.alive]
            n = len(self.nodes)
            kept = np.array([x.at for x in self.nodes], dtype=np.int64).reshape(n, self.at.shape[1])
            self.at = np.concatenate([kept, np.empty_like(self.at)])
        self.at[n] = node.at
        self.nodes.append(node)


def as_mapping(roadmaps: Sequence[Roadmap], at: At) -> Mapping[str, int]:
    """Robot name -> vertex."""
    return {g.name: v for g, v in zip(roadmaps, at, strict=True)}
