"""The composite polyline that is optimised: knots, the knot of every transition, and the contact motions beside them.

A contact motion is the straight motion of a robot right before or after an attachment changes: the hand closing in on
an object, or lifting it off.  What lies on it moves only together with the contact configuration.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Literal

import numpy as np

from mrtamp.kinematics import Tool
from mrtamp.modes import Mode
from mrtamp.plan import Action, Segment, Transition

REACH = 0.005
"""Length (m) of a contact motion, measured at the hand: the approach distance of the contact sampler."""
_STILL = 1e-12
_STRAIGHT = 1e-6
"""Largest 1 - cos of the angle between consecutive steps of one straight motion."""
_DEVIATION = 0.02
"""How far (rad, m) a knot may be from the chord that replaces it."""

Hand = Literal["empty", "lifting", "exchanging"]


@dataclass(frozen=True)
class Stretch:
    """The contact motion of `robot` on one side of transition `event`.

    Its knots run from `far` to `near`, where the contact configuration is reached; from `near` to the transition's knot
    the robot stands.  `hand` says what moves: an empty hand, an object lifted off or put on `support`, or an object in
    an exchange between hands.
    """

    robot: str
    event: int
    before: bool
    far: int
    near: int
    hand: Hand
    support: str | None = None

    def fractions(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Knots strictly between `far` and `near`, and how far (0 to 1) along the motion each lies; q (K, n)."""
        low, high = sorted((self.far, self.near))
        knots = np.arange(low + 1, high)
        whole = q[self.near] - q[self.far]
        return knots, np.clip((q[knots] - q[self.far]) @ whole / max(float(whole @ whole), 1e-300), 0.0, 1.0)

    def shifted(self, index: np.ndarray) -> Stretch:
        """The same stretch where knot k has become index[k]."""
        return replace(self, far=int(index[self.far]), near=int(index[self.near]))


@dataclass(frozen=True, eq=False)
class Polyline:
    """Composite knots q (K, N), columns per robot, and the knots (T,) at which transitions happen."""

    columns: Mapping[str, slice]
    q: np.ndarray
    events: np.ndarray
    stretches: tuple[Stretch, ...] = field(default=())

    @property
    def knots(self) -> int:
        """Number of knots K."""
        return len(self.q)

    @property
    def segment_of_step(self) -> np.ndarray:
        """Index (K - 1,) of the segment in which every step lies."""
        return np.searchsorted(self.events, np.arange(self.knots - 1), side="right")

    def of(self, robot: str) -> np.ndarray:
        """Knots (K, n) of one robot."""
        return self.q[:, self.columns[robot]]

    def lengths(self, q: np.ndarray | None = None) -> np.ndarray:
        """Joint length (R, K - 1) of every robot in every step."""
        q = self.q if q is None else q
        return np.array([np.linalg.norm(np.diff(q[:, c], axis=0), axis=1) for c in self.columns.values()])

    def along(self) -> np.ndarray:
        """When every knot (K,) is reached: lengths of the robots that move most, added up."""
        return np.concatenate([[0.0], np.cumsum(self.lengths().max(axis=0))])

    def parts(self, q: np.ndarray) -> list[dict[str, np.ndarray]]:
        """Waypoints per segment and robot for knots q (K, N)."""
        bounds = [0, *self.events.tolist(), self.knots - 1]
        return [{r: q[a : b + 1, c].copy() for r, c in self.columns.items()} for a, b in pairwise(bounds)]

    def segments(self, q: np.ndarray, modes: Sequence[Mode]) -> list[Segment]:
        """Segments in the given modes for knots q (K, N)."""
        return [Segment(mode, part) for mode, part in zip(modes, self.parts(q), strict=True)]

    def at(self, u: np.ndarray) -> Polyline:
        """The polyline with knots at parameters u (K',), ascending, which include all events and ends of stretches."""
        low = np.minimum(u.astype(int), max(self.knots - 2, 0))
        high = np.minimum(low + 1, self.knots - 1)
        t = (u - low)[:, None]
        q = np.where(
            t == 0, self.q[low], np.where(t == 1, self.q[high], self.q[low] + t * (self.q[high] - self.q[low]))
        )
        index = np.searchsorted(u, np.arange(self.knots))
        stretches = tuple(s.shifted(index) for s in self.stretches)
        return Polyline(self.columns, q, index[self.events], stretches)

    def resampled(self, knot: float, level: int = 0) -> np.ndarray:
        """Parameters u of a polyline of steps of at most `knot` (rad), and not much less where that costs no detail.

        At higher levels steps beside bends are shorter, by a factor of two per level.
        """
        anchors = {0, self.knots - 1, *self.events.tolist()}
        for s in self.stretches:
            anchors |= {s.far, s.near}
        deviation = _DEVIATION / 4**level
        along = self.along()
        out: list[float] = [0.0]
        i = 0
        while i < self.knots - 1:
            j = i + 1
            while j not in anchors and self._straight(i, j + 1, deviation):
                j += 1
            pieces = max(1, int(np.ceil(self._span(i, j) / knot - 1e-9)))
            inner = along[i] + (along[j] - along[i]) * np.arange(1, pieces) / pieces
            out += [*np.interp(inner, along[i : j + 1], np.arange(i, j + 1)).tolist(), float(j)]
            i = j
        u = np.array(out)
        return u if level == 0 else self._finer(u, knot / 2**level, deviation / 2)

    def _finer(self, u: np.ndarray, knot: float, deviation: float) -> np.ndarray:
        """Parameters with steps of at most `knot` on both sides of every bend."""
        q = self.at(u).q
        bend = np.zeros(len(u), dtype=bool)
        for k in range(1, len(u) - 1):
            whole = q[k + 1] - q[k - 1]
            t = np.clip((q[k] - q[k - 1]) @ whole / max(float(whole @ whole), 1e-300), 0.0, 1.0)
            bend[k] = np.abs(q[k] - q[k - 1] - t * whole).max() > deviation
        length = np.max([np.linalg.norm(np.diff(q[:, c], axis=0), axis=1) for c in self.columns.values()], axis=0)
        pieces = np.where(bend[:-1] | bend[1:], np.maximum(np.ceil(length / knot - 1e-9), 1), 1).astype(int)
        inner = [a + (b - a) * np.arange(n) / n for a, b, n in zip(u[:-1], u[1:], pieces, strict=True)]
        return np.concatenate([*inner, u[-1:]])

    def _span(self, i: int, j: int) -> float:
        return max(float(np.linalg.norm(self.q[j, c] - self.q[i, c])) for c in self.columns.values())

    def _straight(self, i: int, j: int, deviation: float) -> bool:
        """Whether the chord from knot i to knot j stands for all between them."""
        whole = self.q[j] - self.q[i]
        inner = self.q[i + 1 : j] - self.q[i]
        t = np.clip(inner @ whole / max(float(whole @ whole), 1e-300), 0.0, 1.0)
        return bool(np.abs(inner - t[:, None] * whole).max() <= deviation)


def load(segments: Sequence[Segment], transitions: Sequence[Transition], tools: Mapping[str, Tool]) -> Polyline:
    """The polyline of a plan's segments, contact motions found, steps in which nobody moves dropped."""
    robots = list(segments[0].q)
    widths = [segments[0].q[r].shape[1] for r in robots]
    ends = np.cumsum(widths)
    columns = {r: slice(int(b - n), int(b)) for r, n, b in zip(robots, widths, ends, strict=True)}
    blocks = [np.concatenate([s.q[r] for r in robots], axis=1)[0 if k == 0 else 1 :] for k, s in enumerate(segments)]
    events = np.cumsum([len(b) for b in blocks])[:-1] - 1
    q = np.concatenate(blocks)
    keep = np.concatenate([[True], np.abs(np.diff(q, axis=0)).max(axis=1) > _STILL])
    index = np.cumsum(keep) - 1
    line = Polyline(columns, q[keep], index[events])
    cuts: set[float] = set()
    for _ in range(2):
        found = _stretches(line, transitions, tools, cuts)
        if not cuts:
            break
        line = line.at(np.union1d(np.arange(line.knots), sorted(cuts)))
        cuts = set()
    return Polyline(columns, line.q, line.events, tuple(found))


def _stretches(
    line: Polyline, transitions: Sequence[Transition], tools: Mapping[str, Tool], cuts: set[float]
) -> list[Stretch]:
    """All contact motions; where one has to end between knots, the place is added to `cuts`."""
    out = []
    for e, transition in enumerate(transitions):
        for action in transition.actions:
            if action.after is None or action.before is None:
                continue
            for robot in action.robots:
                times = [int(line.events[i]) for i, t in enumerate(transitions) if robot in t.active]
                knot = int(line.events[e])
                first = max((t for t in times if t < knot), default=0)
                last = min((t for t in times if t > knot), default=line.knots - 1)
                for step, stop in ((-1, first), (1, last)):
                    far, near = _walk(line.of(robot), knot, step, stop, tools[robot], cuts)
                    hand, support = _hand(action, robot, before=step < 0)
                    out.append(Stretch(robot, e, step < 0, far, near, hand, support))
    return out


def _hand(action: Action, robot: str, before: bool) -> tuple[Hand, str | None]:
    assert action.before is not None and action.after is not None
    own, other = (action.before, action.after) if before else (action.after, action.before)
    if not (own.held and own.parent == robot):
        return "empty", None
    return ("exchanging", None) if other.held else ("lifting", other.parent)


def _walk(q: np.ndarray, knot: int, step: int, stop: int, tool: Tool, cuts: set[float]) -> tuple[int, int]:
    """The far and near knots of the straight motion next to `knot` in direction `step`, not beyond `stop`."""

    def moves(k: int) -> np.ndarray:
        return q[k + step] - q[k]

    k = knot
    while k != stop and np.abs(moves(k)).max() <= _STILL:
        k += step
    if k == stop:
        return k, k
    near, along = k, moves(k) / np.linalg.norm(moves(k))
    home = tool.pose(q[near][None])[1][0]
    while k != stop:
        length = float(np.linalg.norm(moves(k)))
        if length > _STILL and moves(k) @ along < (1 - _STRAIGHT) * length:
            break
        t = np.linspace(0, 1, 21)
        away = np.linalg.norm(tool.pose(q[k] + t[:, None] * moves(k))[1] - home, axis=1)
        if away.max() > 1.01 * REACH:
            if k == near or away[0] < 0.5 * REACH:
                i = int(np.argmax(away > REACH))
                cuts.add(
                    k + step * float(t[i - 1] + (REACH - away[i - 1]) / (away[i] - away[i - 1]) * (t[i] - t[i - 1]))
                )
            break
        k += step
    return k, near
