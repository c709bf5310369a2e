"""Stretches of motion between two samples, and what settles whether a pair of solids can meet in them.

No point moves further than its joints can carry it, nor further than its chord and twice what it strays from it
(`check_bounds`).  And where the nearest points of two solids are in line with the normal of a plane that separates them
at the other sample too, it does so all the way, if there is room for what their points stray from their chords.  The
same says how deep they penetrate at most where they do, and where that is tolerated it settles them as well.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from mrtamp.check_bounds import Snapshot
from mrtamp.check_scene import JudgeScene

if TYPE_CHECKING:
    from mrtamp.check_motion import Timeline

NOISE = 1e-4
"""Margin (m) on certificates for the accuracy of Drake's distances (2e-5)."""


class Samples:
    """Samples of a motion, which become more while stretches between them are bisected."""

    def __init__(self, world: JudgeScene, line: Timeline, s: np.ndarray) -> None:
        self.world, self.line = world, line
        self.s = s
        self.snapshot = Snapshot(line.envelopes, world.screws, line.configurations(s))

    def add(self, s: np.ndarray) -> None:
        """Samples at s, numbered on from those there are."""
        self.s = np.concatenate([self.s, s])
        new = Snapshot(self.line.envelopes, self.world.screws, self.line.configurations(s))
        self.snapshot = self.snapshot.extended(new)

    def ways(self, stretch: tuple[np.ndarray, np.ndarray], solids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How far (E,) points of solids (E,) get in stretches from sample to sample, and how far from their chords."""
        moved = self.line.travelled(self.s[stretch[1]]) - self.line.travelled(self.s[stretch[0]])
        bend = np.einsum("en,en->e", self.world.screws.bends(moved), self.line.reach[solids]) / 8.0
        return self.snapshot.chords(solids, stretch), bend


@dataclass(eq=False)
class Pairs:
    """Pairs of solids (P, 2), their displacement rates (P, N), and the window (P, 2) of s in which each is judged."""

    solids: np.ndarray
    rates: np.ndarray
    window: np.ndarray
    resolution: float

    def inside(self, s: np.ndarray, pair: Any) -> np.ndarray:
        """Whether s lies in the windows of `pair`."""
        return (s >= self.window[pair, 0]) & (s <= self.window[pair, 1])

    def unsettled(self, d: tuple[Any, Any], moved: Any, s: tuple[Any, Any], pair: Any) -> np.ndarray:
        """Whether `pair`, at least d apart at the two s, may meet in between and is sampled too coarsely there."""
        open_ = (d[0] + d[1] <= moved + NOISE) & (moved > self.resolution)
        return open_ & (s[0] < self.window[pair, 1]) & (s[1] > self.window[pair, 0])

    def stretches(self, d: np.ndarray, moved: np.ndarray, s: np.ndarray) -> np.ndarray:
        """`unsettled` for all stretches between samples s (S,) and all pairs (S - 1, P), at least d (S, P) apart."""
        return self.unsettled((d[:-1], d[1:]), moved, (s[:-1, None], s[1:, None]), slice(None))


class Allowance:
    """Penetration (m) that is tolerated, handed out to stretches that come to no more than that.

    Between any two of the samples s (S,), what all pairs have been granted there adds up to at most `tolerance`.
    """

    def __init__(self, tolerance: float, s: np.ndarray) -> None:
        self._s = s
        self._left = np.full(len(s), tolerance)
        self._of: dict[tuple[int, int], float] = {}

    def granted(self, s: np.ndarray, pair: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """Which pairs (E,) may be as deep as `depth` (E,) in stretches that begin at s (E,); the least goes first."""
        out = np.zeros(len(s), dtype=bool)
        at = np.searchsorted(self._s, s, side="right") - 1
        hopeful = np.flatnonzero(depth <= self._left[at])
        for e in hopeful[np.argsort(depth[hopeful], kind="stable")].tolist():
            k, key = int(at[e]), (int(at[e]), int(pair[e]))
            before = self._of.get(key, 0.0)
            more = max(float(depth[e]) - before, 0.0)
            if more <= self._left[k]:
                self._left[k] -= more
                self._of[key] = before + more
                out[e] = True
        return out


@dataclass(eq=False)
class Stretches:
    """Stretches of motion (E,) of one pair each that distances at their ends have not settled.

    From sample `start` to sample `end`; `d` (E, 2) are the distances there and `normal` (E, 2, 3) their directions.
    """

    start: np.ndarray
    end: np.ndarray
    pair: np.ndarray
    d: np.ndarray
    normal: np.ndarray

    def __len__(self) -> int:
        return len(self.pair)

    def unsettled(self, samples: Samples, pairs: Pairs, allowance: Allowance) -> Stretches:
        """Those that are left when the ways of points, planes between solids and the allowance have had their say."""
        ends = (self.start, self.end)
        s = (samples.s[self.start], samples.s[self.end])
        i, j = pairs.solids[self.pair].T
        joints = samples.line.travelled(s[1]) - samples.line.travelled(s[0])
        (one, bend_one), (two, bend_two) = (samples.ways(ends, solid) for solid in (i, j))
        bend = bend_one + bend_two
        # A point at a share t of its way is at most t chords and a bend from its start, 1 - t and a bend from its end.
        moved = np.minimum(np.einsum("en,en->e", joints, pairs.rates[self.pair]), one + two + 2.0 * bend)
        left = pairs.unsettled((self.d[:, 0], self.d[:, 1]), moved, s, self.pair)
        depth = (moved - self.d[:, 0] - self.d[:, 1]) / 2.0
        for end in (0, 1):
            # How far two planes between them are apart changes evenly, but for the bends.
            rows = np.flatnonzero(left)
            at = (self.start[rows], self.end[rows])
            parted = samples.snapshot.parted(i[rows], j[rows], at, self.normal[rows, end])
            depth[rows] = np.fmin(depth[rows], bend[rows] - parted)
            left[rows[depth[rows] < -NOISE]] = False
        rows = np.flatnonzero(left)
        left[rows[allowance.granted(s[0][rows], self.pair[rows], depth[rows] + NOISE)]] = False
        return self.where(left)

    def where(self, keep: np.ndarray) -> Stretches:
        """Some of them."""
        return Stretches(self.start[keep], self.end[keep], self.pair[keep], self.d[keep], self.normal[keep])

    def halves(self, middle: np.ndarray, d: np.ndarray, normal: np.ndarray) -> Stretches:
        """Both halves of each, with what is known about the samples in the middle (E,)."""
        return Stretches(
            np.concatenate([self.start, middle]),
            np.concatenate([middle, self.end]),
            np.tile(self.pair, 2),
            np.concatenate([np.stack([self.d[:, 0], d], axis=1), np.stack([d, self.d[:, 1]], axis=1)]),
            np.concatenate(
                [np.stack([self.normal[:, 0], normal], axis=1), np.stack([normal, self.normal[:, 1]], axis=1)]
            ),
        )
