"""The modal graph G_M and the orbital graph G_O as networkx graphs that a reader can print (paper, section V).

An orbit is what connectivity has been *proved*: a component of a mode's explored tensor nodes.  Two entries into one
mode are two orbits until a validated motion joins them, and an orbit falls apart when a motion that held it together
turns out invalid.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import networkx as nx

from mrtamp.modes import ModalState, Mode


class Graphs:
    """Discovered modal states and orbits, and the transitions between them.

    Attributes
    ----------
    modal : DiGraph over `ModalState`; edges carry `count`, the number of transitions discovered.
    orbital : DiGraph over orbit ids; nodes carry `mode`, edges `count`.
    """

    def __init__(self) -> None:
        self.modal = nx.DiGraph()
        self.orbital = nx.DiGraph()
        self._parent: list[int] = []
        self.orbits_of: dict[ModalState, list[int]] = {}

    def add_orbit(self, mode: Mode) -> int:
        """A new orbit of `mode`; returns its id."""
        orbit = len(self._parent)
        self._parent.append(orbit)
        self.orbital.add_node(orbit, mode=mode, visits=0)
        self.discover(mode.state)
        self.orbits_of[mode.state].append(orbit)
        return orbit

    def discover(self, state: ModalState, source: ModalState | None = None) -> None:
        """Note a modal state, and the transition that leads to it."""
        if state not in self.modal:
            self.modal.add_node(state, visits=0)
            self.orbits_of[state] = []
        if source is not None:
            count = self.modal.get_edge_data(source, state, {"count": 0})["count"]
            self.modal.add_edge(source, state, count=count + 1)

    def visits(self, state: ModalState) -> int:
        """How often guidance worked in a modal state."""
        return self.modal.nodes[state]["visits"] if state in self.modal else 0

    def find(self, orbit: int) -> int:
        """The orbit that `orbit` has been merged into."""
        while self._parent[orbit] != orbit:
            self._parent[orbit] = self._parent[self._parent[orbit]]
            orbit = self._parent[orbit]
        return orbit

    def merge(self, a: int, b: int) -> int:
        """Join two orbits of one mode that a validated motion connects; returns the surviving id."""
        a, b = sorted((self.find(a), self.find(b)))
        if a == b:
            return a
        self._parent[b] = a
        for u, _, data in list(self.orbital.in_edges(b, data=True)):
            self._count(u, a, data["count"])
        for _, v, data in list(self.orbital.out_edges(b, data=True)):
            self._count(a, v, data["count"])
        self.orbital.nodes[a]["visits"] += self.orbital.nodes[b]["visits"]
        state = self.orbital.nodes[b]["mode"].state
        self.orbital.remove_node(b)
        self.orbits_of[state].remove(b)
        return a

    def split(self, orbit: int, parts: int) -> list[int]:
        """Make `parts` new orbits out of what was proved to be one; `orbit` stays as the rest of it.

        Edges remain with `orbit` until `recount` says whose they are.
        """
        return [self.add_orbit(self.mode(orbit)) for _ in range(parts)]

    def recount(self, orbits: Iterable[int], counts: Mapping[tuple[int, int], int]) -> None:
        """Replace all edges at `orbits` by the transitions (source orbit, target orbit) -> number."""
        for orbit in orbits:
            self.orbital.remove_edges_from([*self.orbital.in_edges(orbit), *self.orbital.out_edges(orbit)])
        for (a, b), count in counts.items():
            self.orbital.add_edge(a, b, count=count)

    def transition(self, a: int, b: int) -> None:
        """Note a feasible transition from orbit a to orbit b."""
        self._count(self.find(a), self.find(b), 1)

    def _count(self, a: int, b: int, count: int) -> None:
        known = self.orbital.get_edge_data(a, b, {"count": 0})["count"]
        self.orbital.add_edge(a, b, count=known + count)

    def mode(self, orbit: int) -> Mode:
        """The mode of an orbit."""
        return self.orbital.nodes[self.find(orbit)]["mode"]
