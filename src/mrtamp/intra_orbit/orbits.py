"""InsertAndRewire, and the orbits that it proves (paper, algorithm 1 and section V; dRRT*, Shome et al. 2020).

This is the one place where the tree and the orbital graph change together: a validated step may join two orbits of a
mode, and a step that the judge refutes may break one into several.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

from mrtamp.graphs import Graphs
from mrtamp.intra_orbit.lazy_validate import step_is_valid
from mrtamp.modes import Mode
from mrtamp.plan import Transition
from mrtamp.roadmap import Roadmap
from mrtamp.tensor_tree import At, Node, TensorTree, as_mapping
from mrtamp.validity import Validity

_EPS = 1e-9


class Orbits:
    """Grows and prunes the tree; orbits are at all times the components of its living nodes under proved steps.

    Parameters
    ----------
    tree, graphs : what grows.
    roadmaps, validity : what connections are validated with.
    rewirings : validations per insertion that may be spent on better parents and on rewiring neighbours; 0 switches
        rewiring off, which is fastest while any plan at all is wanted.
    """

    def __init__(
        self,
        tree: TensorTree,
        graphs: Graphs,
        roadmaps: Sequence[Roadmap],
        validity: Validity,
        rewirings: int = 0,
    ) -> None:
        self.tree = tree
        self.graphs = graphs
        self.roadmaps = list(roadmaps)
        self.validity = validity
        self.rewirings = rewirings
        self._invalid: set[tuple[int, int]] = set()

    def insert(self, node: Node, at: At) -> tuple[Node, bool]:
        """InsertAndRewire: a validated step from `node` to `at`; returns (the node at its end, whether it is new)."""
        for g, u, v in zip(self.roadmaps, node.at, at, strict=True):
            # A step that comes from outside the search is an edge of the roadmaps from now on, open to all.
            if u != v:
                g.edge(u, v)
        reached, new = self.tree.insert(node, at)
        self._join(node, reached)
        if self.rewirings:
            # Known nodes too: what the bound left out last time, or has become worth it since, gets its turn.
            self.rewire(reached)
        return reached, new

    def enter(self, node: Node, transition: Transition, mode: Mode, cost: float) -> Node:
        """Take in a validated transition at the vertices of `node`; `cost` is the transition's own."""
        known = self.tree.find(mode, node.at)
        seen = known is not None and node in known.entries
        orbit = self.graphs.add_orbit(mode) if known is None else None
        after = self.tree.insert_transition(node, transition, mode, orbit, cost)
        if not seen:
            self.graphs.discover(mode.state, node.mode.state)
            self.graphs.transition(node.orbit, after.orbit)
        return after

    def rewire(self, node: Node) -> int:
        """Look for a better parent among the node's neighbours in the tensor product, then be one to them.

        A connection is validated only when it would lower a cost; returns the number of validations.
        """
        near, steps = self.tree.adjacent(node)
        unproved = [
            (x, float(c))
            for x, c in zip(near, steps, strict=True)
            if x not in node.steps and (min(x.index, node.index), max(x.index, node.index)) not in self._invalid
        ]
        left = self.rewirings
        for x, step in sorted(unproved, key=lambda item: (item[0].cost + item[1], item[0].index)):
            if not left or x.cost + step >= node.cost - _EPS:
                break
            left -= 1
            if self._connect(x, node):
                break
        for x, step in sorted(unproved, key=lambda item: (item[1] - item[0].cost, item[0].index)):
            if not left:
                break
            # Earlier connections may have made this one cheaper already.
            if node.cost + step < x.cost - _EPS:
                left -= 1
                self._connect(node, x)
        return self.rewirings - left

    def _connect(self, a: Node, b: Node) -> bool:
        if not step_is_valid(self.roadmaps, self.validity, a.mode, a.at, b.at):
            self._invalid.add((min(a.index, b.index), max(a.index, b.index)))
            return False
        self.tree.connect(a, b)
        self._join(a, b)
        return True

    def _join(self, a: Node, b: Node) -> None:
        if a.orbit != b.orbit:
            one, two = a.orbit, b.orbit
            kept = self.graphs.merge(one, two)
            self.tree.merge_orbits(kept, two if kept == one else one)

    # -- withdrawal -----------------------------------------------------------------------------------------------

    def refute(self, before: Node, after: Node, guilty: tuple[str, ...], obstacle: str | None = None) -> None:
        """The step between two nodes collides after all: forbid it, and withdraw every proof that rests on the same.

        `guilty` and `obstacle` are as for `Validity.forbid`: the one or two robots it is about, and what one hits.
        """
        one, two = as_mapping(self.roadmaps, before.at), as_mapping(self.roadmaps, after.at)
        wrong = [(before, after)] if after in before.steps else []
        others = self._forbid(before.mode, {r: (one[r], two[r]) for r in guilty}, obstacle)
        self._withdraw([*wrong, *(pair for pair in others if set(pair) != {before, after})])

    def refute_edge(self, mode: Mode, robot: str, edge: tuple[int, int], obstacle: str) -> None:
        """A robot's edge (from, to) hits `obstacle` in `mode` after all: forbid it, withdraw what rests on it."""
        self._withdraw(self._forbid(mode, {robot: edge}, obstacle))

    def _forbid(
        self, mode: Mode, edges: Mapping[str, tuple[int, int]], obstacle: str | None
    ) -> list[tuple[Node, Node]]:
        """Forbid edges of one or two robots in both directions; the steps of the tree that are invalid for it."""
        one, two = ({r: e[k] for r, e in edges.items()} for k in (0, 1))
        self.validity.forbid(mode, one, two, tuple(edges), obstacle)
        self.validity.forbid(mode, two, one, tuple(edges), obstacle)
        taken = [(i, set(edges[g.name])) for i, g in enumerate(self.roadmaps) if g.name in edges]
        return [
            (x, y)
            for x in self.tree.nodes
            for y in x.steps
            if x.index < y.index
            and all({x.at[i], y.at[i]} == edge for i, edge in taken)
            and not step_is_valid(self.roadmaps, self.validity, x.mode, x.at, y.at)
        ]

    def refute_entries(self, node: Node) -> None:
        """The change of mode that leads to `node` is invalid at its vertices: withdraw every transition to it."""
        self._withdraw([(x, node) for x in node.entries])

    def remove(self, node: Node) -> None:
        """Remove a node, with everything that hangs on it, for a reason that no single step is to blame for."""
        gone = self.tree.cut(node)
        self._split({x.orbit: None for x in gone})

    def _withdraw(self, pairs: Sequence[tuple[Node, Node]]) -> None:
        lost = self.tree.refute(pairs)
        self._split({x.orbit: None for x in [*lost, *(x for pair in pairs for x in pair)]})

    def _split(self, orbits: Iterable[int]) -> None:
        """Make every component of these orbits an orbit of its own, and give transitions to where they belong."""
        changed: dict[int, None] = {}
        for orbit in orbits:
            others = self.tree.components(orbit)[1:]
            labels = self.graphs.split(orbit, len(others))
            self.tree.split_orbit(orbit, dict(zip(labels, others, strict=True)))
            changed.update(dict.fromkeys([orbit, *labels]))
        counts: Counter[tuple[int, int]] = Counter()
        for orbit in changed:
            for x in self.tree.of_orbit.get(orbit, []):
                counts.update((y.orbit, orbit) for y in x.entries)
                # An edge between two changed orbits is counted where it ends.
                counts.update((orbit, y.orbit) for y in x.exits if y.orbit not in changed)
        self.graphs.recount(changed, counts)
