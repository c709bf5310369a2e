"""Collision rows of the program: linearised distances at knots, midpoints, and wherever a step went wrong before."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from mrtamp.optimise.choices import Arrangement
from mrtamp.optimise.fine import Violations, Who, knot_samples, near_to
from mrtamp.optimise.nearness import Near, Nearness, Samples, State
from mrtamp.optimise.polyline import Polyline

Demands = dict[Who, dict[tuple[int, float, int], int]]
"""Who -> (step, fraction, segment) -> how often they have to be clearer there than elsewhere."""

_NEAR = 0.06
"""Distance (m) below which pairs of solids enter the program."""
_PIECES = (2, 4)
"""Samples per step, at the coarse level and at finer ones, where less is left to mend then."""
_MARGIN = 1.5e-3
"""Clearance (m) that the program asks for at its samples."""
_STRICTER = 1e-3
"""Additional clearance (m) for every time that a sample was in collision."""
_FINER = 3.0
"""By how much the clearance is less at every finer level."""
_TOUCHING = -3e-4
"""Clearance (m) asked of an object and what it is lifted off or put on."""
_USED = 0.95
"""Share of the tolerated penetration that is made use of."""
_CONTENDS = 3e-3
"""Distance (m) from which on a pair of solids has a share in it: the more the closer."""
_FAINT = 1e-6
"""What farther pairs claim where no pair is as close as that: the closest has it all."""
_DEAD = 1e-9
"""Penetration (m) that counts, and sum of derivatives below which no joint changes it."""
_PARTS = 24
"""Places in a step at which violations are remembered."""


@dataclass(frozen=True, eq=False)
class CollisionRows:
    """Linearised distances: A (P, K * N + coordinates) of `distance` (P,), and the clearance `asked` (P,) of each.

    More clearance may be asked of those that are `padded` (P,).  `clearance` is the least distance (K - 1, m + 1) at
    equal intervals along every step, as far as it is less than what enters programs.
    """

    A: sparse.csr_array
    distance: np.ndarray
    asked: np.ndarray
    padded: np.ndarray
    clearance: dict[Who, np.ndarray]

    @property
    def gap(self) -> np.ndarray:
        """How far (P,) each may shrink."""
        return self.distance - self.asked

    @property
    def depth(self) -> np.ndarray:
        """Penetration (P,) in m beyond what is allowed."""
        return np.minimum(self.asked, 0) - self.distance

    def deepest(self, tolerance: float) -> float:
        """The largest penetration (m) beyond what is allowed and tolerated."""
        return max(0.0, float(self.depth.max(initial=0.0)) - tolerance)

    def lost(self, tolerance: float) -> bool:
        """Whether something penetrates further than is tolerated and no joint can do anything about it nearby.

        The shortest way out of what is flat may be across the plane in which robots slide.
        """
        deep = self.A[np.flatnonzero(self.depth > tolerance + _DEAD)]
        return bool(np.any(np.abs(deep).sum(axis=1) < _DEAD))

    def knots_beyond(self, depth: float, shape: tuple[int, int]) -> np.ndarray:
        """Numbers of those of the knots (K, N) at or next to which some penetration is larger than `depth` (m)."""
        columns = self.A[np.flatnonzero(self.depth > depth)].indices
        return np.unique(columns[columns < shape[0] * shape[1]] // shape[1])

    def joined(self, other: CollisionRows) -> CollisionRows:
        """These rows and others."""
        A = sparse.csr_array(sparse.vstack([self.A, other.A]))
        distance, asked, padded = (
            np.concatenate([getattr(x, name) for x in (self, other)]) for name in ("distance", "asked", "padded")
        )
        return CollisionRows(A, distance, asked, padded, self.clearance)

    def stricter(self, by: float) -> CollisionRows:
        """The same with `by` (m) more clearance asked for."""
        return replace(self, asked=self.asked + by * self.padded)


@dataclass(frozen=True, eq=False)
class _Found:
    """What is near for one robot alone or two of them, and the clearance `margin` (S,) asked for at every sample.

    What penetration is tolerated is shared by all that is about to collide at the same instant.
    """

    samples: Samples
    states: Mapping[str, State]
    near: Near
    touching: np.ndarray
    margin: np.ndarray

    @property
    def _claims(self) -> np.ndarray:
        distance = self.near.distance
        claims = np.maximum(_CONTENDS - distance, 0.0) + _FAINT * np.exp(-np.maximum(distance, 0.0) / _CONTENDS)
        return np.where(self.touching, 0.0, claims)

    @property
    def claimed(self) -> np.ndarray:
        """What all pairs claim together at each sample (S,)."""
        return np.bincount(self.near.sample, weights=self._claims, minlength=len(self.samples))

    def shares(self, contention: np.ndarray) -> np.ndarray:
        """Share (P,) of every pair, where all pairs of all robots claim so much at each sample (S,)."""
        return self._claims / np.maximum(contention[self.near.sample], 1e-300)


def _contention(found: Sequence[_Found], n: int) -> list[np.ndarray]:
    """What all of them together claim at each sample of each; the first n samples are the same for all."""
    claimed = [x.claimed for x in found]
    common = np.sum([x[:n] for x in claimed], axis=0)
    places = [np.column_stack([x.samples.lo, np.round(_PARTS * x.samples.t), x.samples.segment])[n:] for x in found]
    which = np.unique(np.concatenate(places), axis=0, return_inverse=True)[1].reshape(-1)
    total = np.bincount(which, weights=np.concatenate([x[n:] for x in claimed]))
    ends = np.cumsum([0, *map(len, places)])
    return [np.concatenate([common, total[which[a:b]]]) for a, b in itertools.pairwise(ends.tolist())]


class Collisions:
    """Linearises distances along polylines, and remembers where more clearance is needed than was asked for.

    Parameters
    ----------
    nearness : measures distances.
    tolerance : penetration (m) that the problem tolerates at an instant.
    pieces : samples per step; by default more of them at a finer level.
    reach : distance (m) below which pairs of solids enter programs.
    margin, stricter : clearance (m) that is asked for, and how much more for every time that a sample was in collision.
    """

    def __init__(
        self,
        nearness: Nearness,
        tolerance: float,
        *,
        pieces: int | None = None,
        reach: float = _NEAR,
        margin: float = _MARGIN,
        stricter: float = _STRICTER,
    ) -> None:
        self.nearness = nearness
        self.tolerance = tolerance
        self._pieces = pieces
        self.reach = reach
        self.margin = margin
        self.stricter = stricter
        self.level = 0
        self.pad = 0.0
        """Clearance (m) that is asked for everywhere on top, to come free of collision between samples too."""
        self.demands: Demands = {}
        """Where more clearance is asked for; steps are those of the polyline at hand."""

    @property
    def pieces(self) -> int:
        """Samples per step."""
        return self._pieces or _PIECES[min(self.level, 1)]

    # -- demands ----------------------------------------------------------------------------------------------------

    def forget(self) -> None:
        """Ask for no more than everywhere."""
        self.demands = {}

    def learn(self, violations: Sequence[Violations], *, as_deep: bool = False) -> Demands:
        """Every violating sample becomes a row of the next programs, stricter each time it recurs; returns them.

        `as_deep`: stricter by what the penetration is, too.
        """
        fresh: Demands = {}
        for v in violations:
            depth = v.depth if as_deep else np.zeros(len(v.depth))
            for lo, t, s, d in zip(
                *(x.tolist() for x in (v.samples.lo, v.samples.t, v.samples.segment, depth)), strict=True
            ):
                key = self.demand(v.who, lo, t, s, d)
                fresh.setdefault(v.who, {})[key] = self.demands[v.who][key]
        return fresh

    def demand(self, who: Who, lo: int, t: float, segment: int, depth: float = 0.0) -> tuple[int, float, int]:
        """Ask for more clearance at one place, where the penetration was `depth` (m)."""
        rows = self.demands.setdefault(who, {})
        key = (lo, round(t * _PARTS) / _PARTS, segment)
        rows[key] = rows.get(key, 0) + 1 + int(np.ceil(depth / self.stricter))
        return key

    def move(self, u: np.ndarray) -> None:
        """The polyline now has knots at parameters u of the one before."""
        moved: Demands = {}
        for who, rows in self.demands.items():
            moved[who] = {}
            for (lo, t, segment), strict in rows.items():
                at = float(np.interp(lo + t, u, np.arange(len(u))))
                k = min(int(at), max(len(u) - 2, 0))
                moved[who][k, round((at - k) * _PARTS) / _PARTS, segment] = strict
        self.demands = moved

    def _samples(self, n: int, extra: Mapping[tuple[int, float, int], int]) -> tuple[Samples, np.ndarray]:
        """The samples demanded, and the clearance asked for at n common ones and at each of them."""
        least = self.margin / _FINER**self.level + self.pad
        margin = np.full(n, least)
        if not extra:
            return Samples.none(), margin
        lo, t, segment = (np.array(x) for x in zip(*extra, strict=True))
        strict = least + self.stricter * np.array(list(extra.values()))
        return Samples(lo, t, segment), np.concatenate([margin, strict])

    # -- rows -------------------------------------------------------------------------------------------------------

    def rows(self, line: Polyline, q: np.ndarray, arrangement: Arrangement) -> CollisionRows:
        """Distances and their gradients at samples of all steps, and wherever they were demanded, at knots q (K, N)."""
        return self._rows(line, q, arrangement, knot_samples(line, np.full(line.knots - 1, self.pieces)), self.demands)

    def more(self, line: Polyline, q: np.ndarray, arrangement: Arrangement, demands: Demands) -> CollisionRows:
        """The same at some demanded places only."""
        return self._rows(line, q, arrangement, Samples.none(), demands)

    def _rows(
        self, line: Polyline, q: np.ndarray, arrangement: Arrangement, base: Samples, demands: Demands
    ) -> CollisionRows:
        found: list[_Found] = []
        clearance: dict[Who, np.ndarray] = {}
        names, ask = list(line.columns), self.nearness
        knots = {r: q[:, c] for r, c in line.columns.items()}
        common = {r: ask.state(r, knots[r], base, arrangement.modes) for r in names}
        for i, robot in enumerate(names):
            for other in (None, *names[:i]):
                who: Who = (robot,) if other is None else (other, robot)
                extra, margin = self._samples(len(base), demands.get(who, {}))
                samples, states = base, {r: common[r] for r in who}
                if len(extra):
                    samples = base.joined(extra)
                    more = {r: ask.state(r, knots[r], extra, arrangement.modes) for r in who}
                    states = {r: common[r].joined(more[r]) for r in who}
                near, touching = near_to(ask, line, who, [states[r] for r in who], samples, arrangement, _NEAR)
                clearance[who] = self._clearance(line, base, near)
                if self.reach < _NEAR:
                    close = near.distance < self.reach
                    near, touching = near.of(close), touching[close]
                if len(near.distance):
                    found.append(_Found(samples, states, near, touching, margin))
        tolerated = bool(found) and self.tolerance > 0
        contention = _contention(found, len(base)) if tolerated else [np.zeros(0)] * len(found)
        blocks: list[sparse.csr_array] = [sparse.csr_array((0, q.size + len(arrangement.c)))]
        parts: list[tuple[np.ndarray, ...]] = [(np.zeros(0), np.zeros(0), np.zeros(0, dtype=bool))]
        for x, claimed in zip(found, contention, strict=True):
            asked = x.margin[x.near.sample]
            if tolerated:
                asked = asked - _USED * self.tolerance * x.shares(claimed)
            blocks.append(self.gradient(line, x.samples, x.near, x.states, arrangement))
            asked = np.where(x.touching, _TOUCHING, asked)
            parts.append((x.near.distance, asked, ~x.touching))
        distance, wanted, padded = (np.concatenate(x) for x in zip(*parts, strict=True))
        return CollisionRows(sparse.csr_array(sparse.vstack(blocks)), distance, wanted, padded, clearance)

    def gradient(
        self, line: Polyline, samples: Samples, near: Near, states: Mapping[str, State], arrangement: Arrangement
    ) -> sparse.csr_array:
        """Rows over flattened knots and coordinates: a row between two knots involves both."""
        N = line.q.shape[1]
        lo, t = samples.lo[near.sample], samples.t[near.sample]
        P = len(lo)
        values, rows, columns = [], [], []
        for robot, state in states.items():
            G = self.nearness.joint_gradient(robot, state, near)
            cols = line.columns[robot]
            joint = np.arange(cols.start, cols.stop)
            for knot, weight in ((lo, 1 - t), (np.minimum(lo + 1, line.knots - 1), t)):
                values.append((G * weight[:, None]).reshape(-1))
                rows.append(np.repeat(np.arange(P), len(joint)))
                columns.append((knot[:, None] * N + joint).reshape(-1))
        H = self.nearness.choice_gradient(near, samples, states, arrangement)
        r, k = np.nonzero(H)
        values.append(H[r, k])
        rows.append(r)
        columns.append(line.q.size + k)
        entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
        out = sparse.csr_array(entries, shape=(P, line.q.size + len(arrangement.c)))
        out.eliminate_zeros()
        return out

    def _clearance(self, line: Polyline, base: Samples, near: Near) -> np.ndarray:
        """Least distances (K - 1, pieces + 1) at equal intervals along every step, at most _NEAR."""
        least = np.full(len(base), _NEAR)
        mine = near.sample < len(base)
        np.minimum.at(least, near.sample[mine], near.distance[mine])
        out = np.full((line.knots - 1, self.pieces + 1), _NEAR)
        own = base.segment == line.segment_of_step[base.lo] if len(base) else np.zeros(0, dtype=bool)
        place = np.round(self.pieces * base.t).astype(int)
        np.minimum.at(out, (base.lo[own], place[own]), least[own])
        # The end of a step is the beginning of the next, but where a transition happens in between.
        of_step = line.segment_of_step
        same = np.flatnonzero(of_step[1:] == of_step[:-1])
        out[same, -1] = out[same + 1, 0]
        return out
