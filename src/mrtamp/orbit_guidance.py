"""Which orbit to work in next, and which elementary transitions to sample there (paper, algorithm 1).

Before there is a plan the modal frontier is followed, afterwards half of the time the incumbent's orbits; a share of
all choices ignores guidance for ever, so that no orbit and no transition is starved.
"""

from __future__ import annotations

import numpy as np

from mrtamp.graphs import Graphs
from mrtamp.guidance import Choice, ModalGuidance, Outline
from mrtamp.modes import Mode
from mrtamp.tensor_tree import TensorTree

_VISIT = 0.8
"""How much farther a modal state seems for the square root of its visits."""
_TIE = 0.25
"""Difference of optimistic estimates within which guidance chooses at random."""


class OrbitGuidance:
    """Chooses among the orbits that the tree has nodes in.

    Parameters
    ----------
    modal : estimates how far modes are from the goal.
    persistent : share of choices that ignore guidance.
    by_mode : whether modal guidance is used at all; without it orbits and transitions are random.
    along_path : whether the incumbent's orbits are preferred once there is a plan.

    Attributes
    ----------
    path : orbits on the incumbent's path (L_O in the paper), as they were numbered when it was found.
    guided : whether the transitions chosen last are those that guidance prefers; if not, nothing may be left out.
    """

    def __init__(
        self,
        graphs: Graphs,
        tree: TensorTree,
        modal: ModalGuidance,
        rng: np.random.Generator,
        *,
        persistent: float,
        by_mode: bool = True,
        along_path: bool = True,
    ) -> None:
        self.graphs = graphs
        self.tree = tree
        self.modal = modal
        self.rng = rng
        self.persistent = persistent
        self.by_mode = by_mode
        self.along_path = along_path
        self.path: list[int] = []
        self.guided = by_mode

    def choose(self, *, improving: bool) -> tuple[int, list[Choice]]:
        """Orbit to work in and the elementary transitions Gamma to sample there (one per robot, disjoint).

        `improving` says whether there is a plan, whose path may be followed.
        """
        explore = self.rng.random() < self.persistent
        self.guided = self.by_mode and not explore
        along = improving and self.along_path and self.rng.random() < 0.5
        if explore or not (along or self.by_mode):
            orbit = self.any_orbit()
        elif along:
            orbit = self._orbit_path_guidance()
        else:
            orbit = self._modal_frontier()
        self.graphs.orbital.nodes[orbit]["visits"] += 1
        mode = self.graphs.mode(orbit)
        self.modal.visit(mode)
        if not self.guided:
            return orbit, self.modal.feasible_sets(mode, self.rng)
        return orbit, self._optimistic_choices(mode)

    def any_orbit(self) -> int:
        """A living orbit, drawn uniformly from all or from those of a modal state that is drawn first.

        Orbits grow in number for ever and so does, slowly, the count of draws of each; modal states are finitely many,
        and so is what can be done in them: that keeps its share.
        """
        known = [[o for o in orbits if self.tree.of_orbit.get(o)] for orbits in self.graphs.orbits_of.values()]
        known = [orbits for orbits in known if orbits]
        if self.rng.random() < 0.5:
            known = [[o for orbits in known for o in orbits]]
        orbits = known[int(self.rng.integers(len(known)))]
        return orbits[int(self.rng.integers(len(orbits)))]

    def _modal_frontier(self) -> int:
        """The orbit whose modes are optimistically nearest to the goal, visits to modes alike held against it."""
        least: dict[Outline, tuple[int, int]] = {}
        for orbit, nodes in self.tree.of_orbit.items():
            if nodes:
                outline = self.modal.outline(self.graphs.mode(orbit))
                entry = (self.graphs.orbital.nodes[orbit]["visits"], orbit)
                least[outline] = min(least.get(outline, entry), entry)
        best, chosen = np.inf, 0
        for outline, (_, orbit) in least.items():
            score = self.modal.remaining(self.graphs.mode(orbit)) + _VISIT * np.sqrt(self.modal.visits(outline))
            if score <= best:
                best, chosen = score, orbit
        return chosen

    def _orbit_path_guidance(self) -> int:
        """An orbit on the incumbent's path."""
        path = [o for o in {self.graphs.find(o): None for o in self.path} if self.tree.of_orbit.get(o)]
        return path[int(self.rng.integers(len(path)))] if path else self._modal_frontier()

    def _optimistic_choices(self, mode: Mode) -> list[Choice]:
        """A transition of those that are optimistically best."""
        ties = self._ties(mode)
        if not ties:
            return []
        # Whoever acted longest ago acts next: alternating robots can move at the same time later on.
        last = self._last_actions(mode)
        oldest = min(max(last.get(r, -1) for r in c.robots) for c in ties)
        ties = [c for c in ties if max(last.get(r, -1) for r in c.robots) == oldest]
        return [ties[int(self.rng.integers(len(ties)))]]

    def still_best(self, mode: Mode, choice: Choice) -> bool:
        """Whether a transition is among those that are optimistically best, by what is known now."""
        return choice in self._ties(mode)

    def _ties(self, mode: Mode) -> list[Choice]:
        proposals = self.modal.proposals(mode)
        return [c for score, c in proposals if score <= proposals[0][0] + _TIE]

    def _last_actions(self, mode: Mode) -> dict[str, int]:
        """When each robot last acted on the way to `mode`, counted in transitions."""
        node = self.tree.entry(mode)
        if node is None:
            return {}
        actions = [x.transition for x in self.tree.branch(node) if x.transition is not None]
        return {r: i for i, t in enumerate(actions) for r in t.active}
