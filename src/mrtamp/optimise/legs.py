"""The ways that robots go between their transitions, and a stock of those they went in other plans.

Two plans in which a robot goes between the same places differ in the side on which it passes what stands around and the
others.  What one of them did well, way by way, can be taken over into the other (crossover, in the language of memetic
algorithms): the best of many plans is found way by way, not by luck in all of them at once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from mrtamp.kinematics import Tool
from mrtamp.optimise.piece import Whole
from mrtamp.optimise.polyline import load
from mrtamp.plan import Segment, Transition

_SAME_ENDS = 0.2
"""How far (rad or m, any joint) the ends of two ways may be from each other if one can take the place of the other."""
_ALIKE = 0.08
"""Distance (rad or m) up to which two ways are the same everywhere."""
_SAVED = 2e-3
"""Length (rad or m) by which a way has to be shorter than one that is the same everywhere to be better."""
_BESIDE = 1e-3
"""Share of a step from a knot within which it gets no other."""
_POINTS = 40
"""At so many points, evenly along both, ways are compared."""
_KEPT = 12
"""Different ways between two transitions that are kept: the oldest ones go."""

Happening = tuple[str, str | None, str | None]
"""Kind, object and subgoal of an action."""
Name = tuple[str, Happening | None, Happening | None]
"""A robot, and what it does before and after; None at the start and the end of the plan."""


@dataclass(frozen=True)
class Leg:
    """Knots between which a robot goes from one of its transitions to the next, contact motions apart.

    `length` is how far (rad or m) that is, and `spare` by how much further than straight.
    """

    name: Name
    low: int
    high: int
    length: float
    spare: float

    @property
    def robot(self) -> str:
        """Who goes."""
        return self.name[0]


def legs_of(whole: Whole) -> list[Leg]:
    """All ways of all robots with a knot between their ends."""
    line, transitions = whole.line, whole.transitions
    out = []
    for robot, lengths in zip(line.columns, line.lengths(), strict=True):
        own = [(int(line.events[k]), _happening(t, robot)) for k, t in enumerate(transitions) if robot in t.active]
        contact = {(int(line.events[s.event]), s.before): s.far for s in line.stretches if s.robot == robot}
        q = line.of(robot)
        for (low, before), (high, after) in pairwise([(0, None), *own, (line.knots - 1, None)]):
            a, b = contact.get((low, False), low), contact.get((high, True), high)
            if b - a >= 2:
                length = float(lengths[a:b].sum())
                out.append(Leg((robot, before, after), a, b, length, length - float(np.linalg.norm(q[b] - q[a]))))
    return out


def _happening(transition: Transition, robot: str) -> Happening:
    action = next(a for a in transition.actions if robot in a.robots)
    return action.kind, action.object, action.subgoal


@dataclass(frozen=True, eq=False)
class Way:
    """How a robot went in some plan: configurations (M, n), and when each was reached.

    `clock` (M,) counts the plan's transitions, in the order `order`, as `Whole.clock` does.
    """

    q: np.ndarray
    clock: np.ndarray
    order: tuple

    @property
    def length(self) -> float:
        """How far (rad or m) it goes."""
        return float(_along(self.q)[-1])

    def beside(self, q: np.ndarray) -> float:
        """Largest distance (rad or m) from a way q (K, n), both being followed evenly."""
        return float(np.linalg.norm(self._even(self.q) - self._even(q), axis=1).max())

    @staticmethod
    def _even(q: np.ndarray) -> np.ndarray:
        along = _along(q)
        at = np.linspace(0.0, along[-1], _POINTS)
        return np.column_stack([np.interp(at, along, column) for column in q.T])

    def instead_of(self, q: np.ndarray, clock: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Parameters u (M',) of a way q (K, n) that include its own knots, and the configurations (M', n) that take the
        place of those there: all of this way's, between the ends of the other.

        They advance as those did, or are reached when this way's plan reached them, by the `clock` (K,).
        """
        if clock is None:
            at, of = _along(q), _along(self.q)
            of = of * (at[-1] / max(of[-1], 1e-12))
        else:
            at, of = clock, self.clock
        knots = np.arange(float(len(q)))
        inner = np.interp(of, at, knots)
        inner = inner[np.abs(inner - np.round(inner)) > _BESIDE]
        u = np.union1d(knots, inner)
        when = np.interp(u, knots, at)
        fresh = np.column_stack([np.interp(when, of, column) for column in self.q.T])
        fresh[[0, -1]] = self.q[[0, -1]]
        share = (u / (len(q) - 1))[:, None]
        return u, np.asarray(fresh + (1 - share) * (q[0] - fresh[0]) + share * (q[-1] - fresh[-1]))


class Stock:
    """Ways from plans of one problem, each once."""

    def __init__(self, tools: Mapping[str, Tool]) -> None:
        self._tools = tools
        self._ways: dict[Name, list[Way]] = {}

    def add(self, segments: Sequence[Segment], transitions: Sequence[Transition]) -> None:
        """Keep the ways of a plan that are different from those there are."""
        whole = Whole(load(segments, transitions, self._tools), [s.mode for s in segments], transitions)
        clock, order = whole.clock(), order_of(transitions)
        for leg in legs_of(whole):
            part = slice(leg.low, leg.high + 1)
            q = whole.line.of(leg.robot)[part]
            known = self._ways.setdefault(leg.name, [])
            if leg.length <= _ALIKE:
                continue
            alike = [w for w in known if _near_ends(w.q, q) and w.beside(q) < _ALIKE]
            if all(leg.length < w.length - _SAVED for w in alike):
                others = [w for w in known if w not in alike]
                known[:] = [*others[1 - _KEPT :], Way(q.copy(), clock[part], order)]

    def others(self, leg: Leg, q: np.ndarray) -> list[Way]:
        """Ways that could take the place of that of a leg, q (K, n), and are different from it, or shorter."""
        if leg.length <= _ALIKE:
            return []
        return [
            w
            for w in self._ways.get(leg.name, [])
            if _near_ends(w.q, q) and (w.length < leg.length - _SAVED or w.beside(q) >= _ALIKE)
        ]


def order_of(transitions: Sequence[Transition]) -> tuple:
    """What happens in which order, and who takes part."""
    return tuple((a.kind, a.robots, a.object, a.subgoal) for t in transitions for a in t.actions)


def _near_ends(a: np.ndarray, b: np.ndarray) -> bool:
    return bool(np.abs(a[[0, -1]] - b[[0, -1]]).max() <= _SAME_ENDS)


def _along(q: np.ndarray) -> np.ndarray:
    """Lengths (K,) from the first of the configurations q (K, n) to each; they hardly ever stay the same."""
    steps = np.linalg.norm(np.diff(q, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(np.maximum(steps, 1e-12))])
