"""The tensor-product search tree T: nodes are (mode, one roadmap vertex per robot); the product is never built.

Motion nodes follow their parent by one synchronous step in which each robot moves along one edge of its roadmap or
stays; transition nodes follow theirs by a change of mode at the same vertices (paper, section V; dRRT*, Shome et al.
2020).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from mrtamp.modes import Mode
from mrtamp.plan import Segment, Transition
from mrtamp.problem import CostWeights
from mrtamp.roadmap import Roadmap

At = tuple[int, ...]
"""One roadmap vertex per robot, in the order of the problem's robots."""


@dataclass(eq=False)
class Node:
    """A vertex of the search tree, with its cost-to-come."""

    index: int
    mode: Mode
    at: At
    orbit: int
    cost: float
    parent: Node | None = None
    transition: Transition | None = None
    children: list[Node] = field(default_factory=list)
    alive: bool = True


class TensorTree:
    """Nodes, costs, insertion and rewiring.  Validation happens before a step is offered here."""

    def __init__(self, roadmaps: Sequence[Roadmap], weights: CostWeights) -> None:
        self.roadmaps = roadmaps
        self.weights = weights
        self.nodes: list[Node] = []
        self._find: dict[tuple[tuple, At], Node] = {}
        self._entries: dict[tuple, list[Node]] = {}
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

    def add_root(self, mode: Mode, at: At, orbit: int) -> Node:
        """The start."""
        return self._add(mode, at, orbit, 0.0, None, None)

    def insert(self, parent: Node, at: At) -> tuple[Node, bool]:
        """Insert the end of a validated step within the parent's mode, or rewire it; returns (node, whether new)."""
        cost = parent.cost + self.step_cost(parent.at, at)
        known = self.find(parent.mode, at)
        if known is None:
            return self._add(parent.mode, at, parent.orbit, cost, parent, None), True
        if cost < known.cost - 1e-12:
            self._reparent(known, parent, cost, None)
        return known, False

    def insert_transition(
        self, parent: Node, transition: Transition, mode: Mode, orbit: int | None, cost: float
    ) -> Node:
        """Insert or rewire the node after a transition at the parent's vertices; `cost` is the transition's own."""
        known = self.find(mode, parent.at)
        total = parent.cost + cost
        if known is None:
            assert orbit is not None
            return self._add(mode, parent.at, orbit, total, parent, transition)
        if total < known.cost - 1e-12:
            self._reparent(known, parent, total, transition)
        return known

    def _add(
        self, mode: Mode, at: At, orbit: int, cost: float, parent: Node | None, transition: Transition | None
    ) -> Node:
        node = Node(len(self.nodes), mode, at, orbit, cost, parent, transition)
        self.nodes.append(node)
        self._find[mode.key, at] = node
        self.of_orbit.setdefault(orbit, []).append(node)
        if parent is None or transition is not None:
            self._entries.setdefault(mode.key, []).append(node)
        if parent is not None:
            parent.children.append(node)
        return node

    def _reparent(self, node: Node, parent: Node, cost: float, transition: Transition | None) -> None:
        ancestor: Node | None = parent
        while ancestor is not None:
            if ancestor is node:
                return
            ancestor = ancestor.parent
        if node.parent is not None:
            node.parent.children.remove(node)
        node.parent, node.transition = parent, transition
        parent.children.append(node)
        change = cost - node.cost
        stack = [node]
        while stack:
            x = stack.pop()
            x.cost += change
            stack += x.children

    def merge_orbits(self, kept: int, gone: int) -> None:
        """Relabel the nodes of an orbit that was merged into another."""
        for node in self.of_orbit.pop(gone, []):
            node.orbit = kept
            self.of_orbit.setdefault(kept, []).append(node)

    def cut(self, node: Node) -> None:
        """Remove a node whose incoming step turned out invalid, with everything that hangs on it."""
        if node.parent is not None:
            node.parent.children.remove(node)
        stack = [node]
        while stack:
            x = stack.pop()
            x.alive = False
            self._find.pop((x.mode.key, x.at), None)
            self.of_orbit[x.orbit].remove(x)
            stack += x.children

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


def as_mapping(roadmaps: Sequence[Roadmap], at: At) -> Mapping[str, int]:
    """Robot name -> vertex."""
    return {g.name: v for g, v in zip(roadmaps, at, strict=True)}
