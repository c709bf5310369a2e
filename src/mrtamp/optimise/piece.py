"""Pieces of a plan: what happens between two of its knots, taken out to be worked on and put back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mrtamp.modes import Mode
from mrtamp.optimise.polyline import Polyline
from mrtamp.plan import Segment, Transition


@dataclass(frozen=True, eq=False)
class Whole:
    """A plan as one polyline, and what is attached to what along it."""

    line: Polyline
    modes: Sequence[Mode]
    transitions: Sequence[Transition]

    def segments(self) -> list[Segment]:
        """The plan's segments."""
        return self.line.segments(self.line.q, self.modes)

    def at(self, u: np.ndarray) -> Whole:
        """The same plan with knots at parameters u (K',), ascending, which include all it has."""
        return Whole(self.line.at(u), self.modes, self.transitions)

    def clock(self) -> np.ndarray:
        """When every knot (K,) is reached, ascending: transition k, counted from 1, happens at k, the plan ends at one
        more than there are; in between time goes on as the robot that moves most."""
        line = self.line
        bounds = np.array([0, *line.events.tolist(), line.knots - 1])
        along = np.concatenate([[0.0], np.cumsum(np.maximum(line.lengths().max(axis=0, initial=0.0), 1e-9))])
        stage = np.clip(np.searchsorted(bounds, np.arange(line.knots), side="right") - 1, 0, len(bounds) - 2)
        begin, end = along[bounds[stage]], along[bounds[stage + 1]]
        return np.asarray(stage + (along - begin) / np.maximum(end - begin, 1e-9))

    def bounds(self) -> np.ndarray:
        """Knots (M,), ascending, at which it may be cut: no transition and no contact motion is there."""
        line = self.line
        free = np.ones(line.knots, dtype=bool)
        free[line.events] = False
        for s in line.stretches:
            event = int(line.events[s.event])
            free[min(s.far + 1, event) : max(s.far - 1, event) + 1] = False
        free[[0, -1]] = True
        return np.flatnonzero(free)

    def piece(self, low: int, high: int) -> Piece:
        """What happens between two of the knots in `bounds`."""
        line = self.line
        ends = low == 0, high == line.knots - 1
        inside = [
            k
            for k, e in enumerate(line.events.tolist())
            if low < e < high or (ends[0] and e == low) or (ends[1] and e == high)
        ]
        first = inside[0] if inside else int(np.searchsorted(line.events, low, side="right"))
        return Piece(self, low, high, first, len(inside))


@dataclass(frozen=True, eq=False)
class Piece:
    """Knots `low` to `high` of a plan, in which transitions `first` to `first + count - 1` happen."""

    whole: Whole
    low: int
    high: int
    first: int
    count: int

    @property
    def transitions(self) -> Sequence[Transition]:
        """What happens in it."""
        return self.whole.transitions[self.first : self.first + self.count]

    @property
    def is_last(self) -> bool:
        """Whether the plan ends with it."""
        return self.high == self.whole.line.knots - 1

    def segments(self, q: np.ndarray) -> list[Segment]:
        """Its segments where the plan's knots are q (K, N)."""
        line = self.whole.line
        events = line.events[self.first : self.first + self.count] - self.low
        part = Polyline(line.columns, q[self.low : self.high + 1], events)
        return part.segments(part.q, self.whole.modes[self.first : self.first + self.count + 1])

    def replaced(self, segments: Sequence[Segment]) -> list[Segment]:
        """The plan's segments with others in place of its own; they begin and end at the same configurations."""
        line, last = self.whole.line, self.first + self.count
        out = self.whole.segments()
        bounds = [0, *line.events.tolist(), line.knots - 1]
        before, after = line.q[bounds[self.first] : self.low], line.q[self.high + 1 : bounds[last + 1] + 1]
        for k, segment in enumerate(segments, start=self.first):
            q = dict(segment.q)
            for r, columns in line.columns.items():
                head = [before[:, columns]] if k == self.first else []
                tail = [after[:, columns]] if k == last else []
                q[r] = np.concatenate([*head, q[r], *tail])
            out[k] = Segment(out[k].mode, q)
        return out
