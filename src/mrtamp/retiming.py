"""Re-timing one robot against the others: a path in the plane of two clocks (DESIGN sections 8 and 9).

`c` is how far the others have come (the longest of them per step), `p` how far the robot has come along its own path.
Any monotone polyline from (0, 0) to (T, L) is a timing; a leg of it takes max(dc, dp).  Events of the others happen at
given c, events of the robot at given p, so their order follows from the polyline.  No geometry here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

_EPS = 1e-9
_SAME = 1e-12


def duration(path: np.ndarray) -> float:
    """How long a timing (n, 2) takes (rad): the longer of both in every leg."""
    return float(np.abs(np.diff(path, axis=0)).max(axis=1).sum())


def simple_timing(T: float, L: float, rng: np.random.Generator) -> np.ndarray:
    """A random timing (n, 2): early, late, delayed, even, or in two goes with a pause between."""
    kind = rng.random()
    both = min(T, L)
    if kind < 0.3:
        corners = [[both, both]]
    elif kind < 0.5:
        corners = [[T - both, L - both]]
    elif kind < 0.7:
        d = rng.random() * T
        m = min(T - d, L)
        corners = [[d, 0.0], [d + m, m]]
    elif kind < 0.8:
        corners = []
    else:
        first = rng.random() * L
        a, b = min(first, T), min(L - first, T)
        corners = [[a, first], [T - b, first]] if a + b <= T else [[T * first / L, first]]
    return np.array([[0.0, 0.0], *corners, [T, L]])


@dataclass(frozen=True, eq=False)
class Timing:
    """A timing cut at every knot of the others, every vertex of the robot's path and every event.

    `c`, `p` (M,) are the clocks at the new knots; `events` are the new knots of the given events, in order.
    """

    c: np.ndarray
    p: np.ndarray
    events: list[int]


def cut(
    path: np.ndarray,
    clock: np.ndarray,
    progress: np.ndarray,
    events: Sequence[tuple[bool, float]],
    before: Sequence[Sequence[int]],
) -> Timing | None:
    """Cut a timing into steps that are linear for everybody; None when an event would come before one it must follow.

    Parameters
    ----------
    path : (n, 2) corners in the plane of c and p.
    clock, progress : c and p of the old knots.
    events : (whether it is the robot's own, its p or c), in their old order.
    before : for each event the indices of earlier ones in the list that it must not precede.
    """
    along = np.concatenate([[0.0], np.cumsum(np.diff(path, axis=0).sum(axis=1))])
    keep = np.concatenate([[True], np.diff(along) > _SAME])
    along, path = along[keep], path[keep]

    def when(values: np.ndarray, column: int, last: bool) -> np.ndarray:
        """Where on the polyline a clock first, or last, shows the values."""
        x = path[:, column]
        side = np.searchsorted(x, values + (_SAME if last else -_SAME), side="right" if last else "left")
        k = np.clip(side, 1, len(x) - 1)
        rise = x[k] - x[k - 1]
        t = np.where(rise > _SAME, (values - x[k - 1]) / np.where(rise > _SAME, rise, 1.0), 1.0 if last else 0.0)
        return along[k - 1] + np.clip(t, 0.0, 1.0) * (along[k] - along[k - 1])

    marks: list[float] = []
    for n, (own, value) in enumerate(events):
        x = np.array([value])
        low, high = (float(when(x, int(own), last)[0]) for last in (False, True))
        mark = max([low, *(marks[b] for b in before[n])])
        if mark > high + _EPS:
            return None
        marks.append(mark)
    knots = np.unique(
        np.concatenate([along, when(np.unique(clock), 0, False), when(np.unique(progress), 1, False), marks])
    )
    # Knots closer than rounding are one.
    first = np.concatenate([[True], np.diff(knots) > 1e-10])
    number = np.cumsum(first) - 1
    index = number[np.searchsorted(knots, marks)] if marks else np.zeros(0, int)
    knots = knots[first]
    c, p = (np.interp(knots, along, path[:, column]) for column in (0, 1))
    return Timing(c, p, [int(k) for k in index])


class Grid:
    """Shortest timings by search on a grid in the plane of both clocks, around what is known to be blocked."""

    def __init__(self, cs: np.ndarray, ps: np.ndarray) -> None:
        self.cs, self.ps = cs, ps
        number = np.arange(len(cs) * len(ps)).reshape(len(cs), len(ps))
        pairs = [(number[:-1], number[1:]), (number[:, :-1], number[:, 1:]), (number[:-1, :-1], number[1:, 1:])]
        self._from = np.concatenate([a.ravel() for a, _ in pairs])
        self._to = np.concatenate([b.ravel() for _, b in pairs])
        dc = cs[self._to // len(ps)] - cs[self._from // len(ps)]
        dp = ps[self._to % len(ps)] - ps[self._from % len(ps)]
        # Of equally long timings the one that moves both at a time, with fewer corners.
        self._cost = np.maximum(np.maximum(dc, dp) + 1e-6 * (dc + dp), 1e-12)

    def forbid(self, c: float, p: float, robot_waits: bool) -> None:
        """The robot may not pass p before the others have come to c, or the others may not pass c before it did."""
        n = len(self.ps)
        # With grid lines at c and p a move lies in the forbidden quarter if its middle does.
        middle_c = (self.cs[self._from // n] + self.cs[self._to // n]) / 2
        middle_p = (self.ps[self._from % n] + self.ps[self._to % n]) / 2
        early, late = (middle_c, middle_p) if robot_waits else (middle_p, middle_c)
        here, there = (c, p) if robot_waits else (p, c)
        self._cost[(early < here - _EPS) & (late > there + _EPS)] = np.inf

    def block(self, a: np.ndarray, b: np.ndarray) -> None:
        """Take the moves out that overlap the leg from a to b, both (c, p)."""
        n = len(self.ps)
        u, v = self._from, self._to
        inside = (self.cs[u // n] < b[0] + _EPS) & (self.cs[v // n] > a[0] - _EPS)
        inside &= (self.ps[u % n] < b[1] + _EPS) & (self.ps[v % n] > a[1] - _EPS)
        self._cost[inside] = np.inf

    def timing(self) -> np.ndarray | None:
        """The shortest timing (n, 2) that is not blocked, without needless corners."""
        n = len(self.ps)
        size = len(self.cs) * n
        use = np.isfinite(self._cost)
        graph = csr_array((self._cost[use], (self._from[use], self._to[use])), shape=(size, size))
        distance, parent = dijkstra(graph, indices=0, return_predecessors=True)
        if not np.isfinite(distance[-1]):
            return None
        nodes = [size - 1]
        while nodes[-1] != 0:
            nodes.append(int(parent[nodes[-1]]))
        index = np.array(nodes[::-1])
        path = np.column_stack([self.cs[index // n], self.ps[index % n]])
        d = np.diff(path, axis=0)
        turn = np.abs(d[:-1, 0] * d[1:, 1] - d[:-1, 1] * d[1:, 0]) > _SAME
        return path[np.concatenate([[True], turn, [True]])]
