"""Iterated local search: one robot's way is changed, and convex programs show what becomes of it.

Convex programs keep to the side on which robots pass each other and what stands around.  What brings a robot to the
other side is a way that it took in another plan or, where there are none, a random bend; only a piece of the plan
around it is optimised anew, which takes a fraction of the time, and takes the place of what was there where it has
become cheaper (Lourenço, Martin and Stützle, Iterated local search, 2003).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mrtamp.check_report import Report
from mrtamp.deadline import Deadline
from mrtamp.kinematics import Tool
from mrtamp.optimise.iterate import worth
from mrtamp.optimise.legs import Leg, Stock, Way, legs_of, order_of
from mrtamp.optimise.nearness import Nearness
from mrtamp.optimise.optimiser import Optimiser, first_trust
from mrtamp.optimise.piece import Piece, Whole
from mrtamp.optimise.polyline import load
from mrtamp.plan import Segment, Transition, plan_cost
from mrtamp.problem import Problem

_ASIDE = (0.4, 3.0)
"""How far a way is bent in a random direction, in first trust regions."""
_MIRRORED, _OVER, _SOME = 0.7, (1.2, 2.5), 0.25
"""Share of bends that lead a way across its chord; by how many times its distance to the chord it moves,
and how much of a random bend is added."""
_LEAST = 1.5
"""Least length of what is bent, in first trust regions; at most all between two transitions of the robot."""
_AROUND = 2.0
"""Length on both sides of a bend that is optimised with it, in first trust regions."""
_STRAY = 0.02
"""Length (rad or m) that a way is taken to have to spare where it is straight: it may be in somebody's way."""
_BENT = 0.2
"""Share of random bends where there are ways of other plans to try."""
_SHORTER, _FAVOUR = 0.1, (-3.0, 3.0)
"""Another way is tried e times as often where it is so much shorter (rad or m), within these powers of e."""
_SAME = 2
"""Decimals of lengths (rad or m) by which ways are told apart."""
_LOOK, _AHEAD, _MOST = 5, 3.0, 20
"""Programs until it is asked whether a piece becomes cheaper; those ahead that it may take at the present pace; and the
most that a piece gets."""
_FLAT = 1e-3
"""Share of its cost that a piece has to gain per program to go on once it has become cheaper."""
_LODGED = 0.03
"""Penetration (m) with which a piece does not go on for so many programs as until it is first looked at."""
_VAIN = 12
"""Changes in which the plan has to gain what is worth having."""


@dataclass(eq=False)
class _Trial:
    """A piece with a changed way, under convex programming."""

    piece: Piece
    optimiser: Optimiser
    base: float
    trail: list[float]
    depths: list[float]

    @property
    def over(self) -> bool:
        """Whether more programs promise nothing."""
        scp, trail = self.optimiser, self.trail
        if scp.converged or scp.stuck or len(trail) >= _MOST:
            return True
        if len(trail) < _LOOK:
            return False
        if scp.cost < self.base:
            return trail[-2] - trail[-1] < _FLAT * self.base
        pace = max(trail[-3] - trail[-1], 0.0) / 2
        return trail[-1] - _AHEAD * pace > self.base or min(self.depths[-_LOOK:]) > _LODGED


class LocalSearch:
    """Improves one plan way by way; transitions stay as they are.

    Parameters
    ----------
    nearness : measures distances in the problem's plants.
    segments, transitions : a valid plan.
    stock : ways that robots took in other plans, which may become more while this goes on.
    level, deadline : how finely pieces are optimised, and until when (see `Optimiser`).

    Attributes
    ----------
    cost : cost of the plan as it is by now.
    converged : whether further changes promise little.
    steps : conic programs solved so far.
    knots : number of knots that the last of them was about.
    """

    stuck = False

    def __init__(
        self,
        problem: Problem,
        nearness: Nearness,
        segments: Sequence[Segment],
        transitions: Sequence[Transition],
        rng: np.random.Generator,
        *,
        stock: Stock | None = None,
        level: int = 0,
        deadline: Deadline | None = None,
    ) -> None:
        self.problem = problem
        self.nearness = nearness
        self.transitions = list(transitions)
        self.rng = rng
        self.stock = stock or Stock(tools_of(nearness))
        self.level = level
        self.deadline = deadline
        self.steps = self.knots = 0
        self._reach = first_trust(nearness)
        self._tools = tools_of(nearness)
        self._trial: _Trial | None = None
        self._tried: set[tuple[Way, float]] = set()
        """Ways of other plans, and how long (rad or m, roughly) the one was whose place they were to take."""
        self._take(segments)
        self._sure = self._whole
        self._costs = [self.cost]
        """After every change since something was last worth having."""

    def _take(self, segments: Sequence[Segment]) -> None:
        line = load(segments, self.transitions, self._tools)
        self._whole = Whole(line, [s.mode for s in segments], self.transitions)
        self.cost = plan_cost(self._whole.segments(), self.transitions, self.problem.cost)
        legs = legs_of(self._whole)
        self._legs = legs if sum(x.spare for x in legs) > worth(self.level) * self.cost else []

    @property
    def outlook(self) -> float:
        """The same as `cost`: what is on trial says little."""
        return self.cost

    @property
    def converged(self) -> bool:
        """Whether no way is longer than it must be, or the last changes were in vain and there is no other to try."""
        gained = self._costs[0] - self.cost
        vain = len(self._costs) > _VAIN and gained < worth(self.level) * self.cost
        return not self._legs or (vain and not self._others())

    def segments(self) -> list[Segment]:
        """Segments of the plan as it is by now."""
        return self._whole.segments()

    def latest(self) -> tuple[list[Segment], list[Transition]]:
        """Segments and transitions of the plan as it is by now."""
        return self.segments(), self.transitions

    def confirm(self) -> None:
        """The judge accepted the plan: `tighten` will not go back behind it."""
        self._sure = self._whole

    def tighten(self, report: Report) -> None:
        """The judge refused the plan: mend it, or else go back to what was accepted."""
        self._trial = None
        sure = plan_cost(self._sure.segments(), self.transitions, self.problem.cost)
        scp = self._optimiser(self._whole.segments(), self.transitions, to_beat=sure)
        scp.tighten(report)
        self._take(scp.segments() if scp.cost < sure else self._sure.segments())
        self._costs = [self.cost]

    def step(self) -> float:
        """Solve one conic program; returns by how much the plan has become cheaper."""
        trial = self._trial = self._trial or self._changed()
        if trial is None:
            return 0.0
        scp = trial.optimiser
        scp.step()
        self.steps += 1
        self.knots = scp.knots
        trial.trail.append(scp.current)
        trial.depths.append(scp.deepest)
        if not trial.over:
            return 0.0
        self._trial = None
        before = self.cost
        scp.finish()
        if scp.cost < trial.base:
            self._take(trial.piece.replaced(scp.segments()))
        self._costs = [*self._costs, self.cost][-_VAIN - 1 :]
        return before - self.cost

    # -- changes ----------------------------------------------------------------------------------------------------

    def _changed(self) -> _Trial | None:
        """A piece of the plan with another way of one robot; None if all of them are straight."""
        if not self._legs:
            return None
        line = self._whole.line
        others = self._others() if self.rng.uniform() >= _BENT else []
        robot, low, u, way = self._from_stock(others) if others else self._bent()
        whole = self._whole.at(np.concatenate([np.arange(low), u, np.arange(u[-1] + 1, line.knots)]))
        line, high = whole.line, low + len(u) - 1
        q = line.q.copy()
        q[low : high + 1, line.columns[robot]] = way
        along = line.along()
        bounds, margin = whole.bounds(), _AROUND * self._reach
        first = int(np.searchsorted(along, along[low] - margin))
        last = int(np.searchsorted(along, along[high] + margin))
        piece = whole.piece(int(bounds[bounds <= first][-1]), int(bounds[bounds >= min(last, line.knots - 1)][0]))
        transitions = piece.transitions
        base = plan_cost(piece.segments(line.q), list(transitions), self.problem.cost)
        scp = self._optimiser(piece.segments(q), transitions, fixed_end=not piece.is_last, to_beat=base)
        if others:
            # Programs might not find back to what was free of collision and shorter.
            scp.take_as_given()
        return _Trial(piece, scp, base, [], [])

    def _others(self) -> list[tuple[Leg, Way]]:
        """Ways of other plans that have not been tried, and whose place they would take."""
        line = self._whole.line
        return [
            (leg, way)
            for leg in self._legs
            for way in self.stock.others(leg, line.of(leg.robot)[leg.low : leg.high + 1])
            if (way, round(leg.length, _SAME)) not in self._tried
        ]

    def _from_stock(self, others: Sequence[tuple[Leg, Way]]) -> tuple[str, int, np.ndarray, np.ndarray]:
        """Who goes another plan's way, from which knot on, at which parameters (M,) of the plan's knots, and the way
        (M, n); shorter ones more often."""
        shorter = np.array([leg.length - way.length for leg, way in others]) / _SHORTER
        weights = np.exp(np.clip(shorter, *_FAVOUR))
        leg, way = others[int(self.rng.choice(len(weights), p=weights / weights.sum()))]
        self._tried.add((way, round(leg.length, _SAME)))
        part = slice(leg.low, leg.high + 1)
        at_its_time = way.order == order_of(self.transitions) and self.rng.uniform() < 0.5
        clock = self._whole.clock()[part] if at_its_time else None
        chain = self.nearness.worlds[leg.robot].chain
        u, fresh = way.instead_of(self._whole.line.of(leg.robot)[part], clock)
        return leg.robot, leg.low, leg.low + u, np.clip(fresh, chain.lower, chain.upper)

    def _bent(self) -> tuple[str, int, np.ndarray, np.ndarray]:
        """Whose way is bent at random, from which knot on, at which parameters (M,) of the plan's knots, and the way
        (M, n); ways with more to spare more often."""
        weights = np.array([x.spare + _STRAY for x in self._legs])
        leg = self._legs[int(self.rng.choice(len(weights), p=weights / weights.sum()))]
        along = self._whole.line.along()
        low, high = self._part(along, leg)
        way = self._whole.line.of(leg.robot)[low : high + 1]
        return leg.robot, low, np.arange(low, high + 1), self._bend(leg.robot, way, along[low : high + 1])

    def _bend(self, robot: str, way: np.ndarray, along: np.ndarray) -> np.ndarray:
        """A way (M, n) that leads elsewhere between its ends; it is as long as `along` (M,) says."""
        chain, rng = self.nearness.worlds[robot].chain, self.rng
        u = ((along - along[0]) / (along[-1] - along[0]))[:, None]
        aside = rng.normal(size=chain.n)
        aside = np.sin(np.pi * u) * aside * (self._reach * rng.uniform(*_ASIDE) / np.linalg.norm(aside))
        if rng.uniform() < _MIRRORED:
            # Whatever it goes around is on the side of the chord.
            aside = _SOME * aside - rng.uniform(*_OVER) * (way - way[0] - u * (way[-1] - way[0]))
        return np.clip(way + aside, chain.lower, chain.upper)

    def _part(self, along: np.ndarray, leg: Leg) -> tuple[int, int]:
        """Knots between which a leg is bent: all of it or, as often for every order of magnitude, some of it."""
        a, b, least = along[leg.low], along[leg.high], _LEAST * self._reach
        if b - a > least:
            width = np.exp(self.rng.uniform(np.log(least), np.log(b - a)))
            begin = self.rng.uniform(a - width / 2, b - width / 2)
            low = max(leg.low, int(np.searchsorted(along, begin)))
            high = min(leg.high, int(np.searchsorted(along, begin + width)))
            if high - low >= 2:
                return low, high
        return leg.low, leg.high

    def _optimiser(
        self,
        segments: Sequence[Segment],
        transitions: Sequence[Transition],
        *,
        fixed_end: bool = False,
        to_beat: float = np.inf,
    ) -> Optimiser:
        return Optimiser(
            self.problem,
            self.nearness,
            segments,
            transitions,
            {},
            level=self.level,
            levels=self.level,
            slide=False,
            draft=True,
            fixed_end=fixed_end,
            to_beat=to_beat,
            deadline=self.deadline,
        )


def tools_of(nearness: Nearness) -> dict[str, Tool]:
    """The grasp frames of all robots."""
    return {r: w.tool for r, w in nearness.worlds.items()}
