"""The optimiser's own judge: yes-or-no collision queries at samples as fine as the planner's own."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mrtamp.collision import RESOLUTION
from mrtamp.optimise.choices import Arrangement
from mrtamp.optimise.nearness import CULL, Nearness, Samples
from mrtamp.optimise.polyline import Polyline, Stretch

_SLIVER = 1e-9
_QUARTERS = np.array([0.25, 0.5, 0.75])
_SWERVE = 1.3
"""By how much more than tracked points any other may move."""

Who = tuple[str, ...]
"""One robot (with its load against the world), or two (against each other)."""


@dataclass(frozen=True, eq=False)
class Violations:
    """Samples in collision, and who: a robot alone or two robots."""

    who: Who
    samples: Samples


def contact_of(stretches: Sequence[Stretch], robot: str, samples: Samples) -> np.ndarray:
    """What the robot's load may touch at every sample (S,): the name of a thing, or ''."""
    out = np.full(len(samples), "", dtype=object)
    time = samples.lo + samples.t
    for s in stretches:
        if s.robot == robot and s.hand == "lifting" and s.support is not None:
            if s.before:
                inside = (time >= s.far - _SLIVER) & (samples.segment <= s.event)
            else:
                inside = (time <= s.far + _SLIVER) & (samples.segment > s.event)
            out[inside] = s.support
    return out


class FineCheck:
    """Checks polylines at the planner's resolution."""

    def __init__(self, nearness: Nearness, resolution: float = RESOLUTION) -> None:
        self.nearness = nearness
        self.resolution = resolution

    def _travel(self, line: Polyline, q: np.ndarray) -> dict[str, np.ndarray]:
        """How far (m) tracked points of every robot move in every step (K - 1,)."""
        out = {}
        for robot, columns in line.columns.items():
            world = self.nearness.worlds[robot]
            x = q[:, columns]
            R, p = world.tool.pose(x)
            hand = p[:, None] + np.einsum("nij,kj->nki", R, 0.1 * np.eye(3))
            points = np.concatenate([world.bounds.spheres(x), hand], axis=1)
            out[robot] = np.linalg.norm(np.diff(points, axis=0), axis=2).max(axis=1)
        return out

    def _samples(self, line: Polyline, travel: Mapping[str, np.ndarray], between: bool) -> Samples:
        """Samples between which no tracked point of any robot moves further than the resolution, transitions twice.

        With `between`, three samples in between any two of those.
        """
        furthest = np.max(list(travel.values()), axis=0)
        pieces = np.maximum(1, np.ceil(1.1 * furthest / self.resolution)).astype(int)
        if not between:
            return knot_samples(line, pieces)
        lo = np.repeat(np.arange(line.knots - 1), 3 * pieces)
        t = np.concatenate([np.zeros(0), *(((np.arange(n)[:, None] + _QUARTERS) / n).ravel() for n in pieces.tolist())])
        return Samples(lo, t, line.segment_of_step[lo])

    def violations(
        self,
        line: Polyline,
        q: np.ndarray,
        arrangement: Arrangement,
        pinned: Mapping[str, np.ndarray],
        clearance: Mapping[Who, np.ndarray],
        between: bool = False,
    ) -> list[Violations]:
        """All samples in collision; with `between`, of the samples in between the others.

        Next to knots (K,) at which both of two robots are `pinned`, their shapes count without padding.  `clearance`
        are distances (K - 1, 3) at the beginning, the middle and the end of every step: nothing that is further apart
        at both ends of half a step than it moves in between is asked about.
        """
        travel = self._travel(line, q)
        samples = self._samples(line, travel, between)
        names = list(line.columns)
        out = []
        for i, robot in enumerate(names):
            for other in (None, *names[:i]):
                who: Who = (robot,) if other is None else (other, robot)
                moved = np.sum([travel[r] for r in who], axis=0)
                mine = samples[_doubtful(line, samples, clearance[who], moved)]
                if not len(mine):
                    continue
                x = {r: mine.at(q[:, line.columns[r]]) for r in who}
                spheres = {r: self.nearness.spheres(r, x[r], arrangement.modes, mine.segment) for r in who}
                if other is None:
                    hits = self._world(line, robot, x[robot], mine, arrangement, spheres[robot])
                else:
                    hits = self._pair(other, robot, x, mine, arrangement, spheres, pinned[other] & pinned[robot])
                if len(hits):
                    out.append(Violations(who, mine[hits]))
        return out

    def _world(
        self, line: Polyline, robot: str, x: np.ndarray, samples: Samples, arrangement: Arrangement, spheres: tuple
    ) -> np.ndarray:
        world = self.nearness.worlds[robot]
        contact = contact_of(line.stretches, robot, samples)
        hits: list[int] = []
        for s in np.unique(samples.segment).tolist():
            mode = arrangement.modes[s]
            held = mode.held.get(robot)
            slot = world.slot_of[held.object] if held else None
            here = np.flatnonzero(samples.segment == s)
            # Who stands still is looked at once.
            fresh = np.concatenate([[True], np.abs(np.diff(x[here], axis=0)).max(axis=1) > 0])
            here = here[fresh]
            rows = self.nearness.rows(
                robot, x[here], held, arrangement.resting(mode), (spheres[0][here], spheres[1][here]), CULL
            )
            for touch in set(contact[here]):
                mine = np.flatnonzero(contact[here] == touch)
                found = here[mine[_all_hits(lambda r: world.first_hit(r, touch or None, slot), rows[mine])]]  # noqa: B023
                hits += found.tolist()
        return np.array(sorted(hits), dtype=int)

    def _pair(
        self,
        a: str,
        b: str,
        x: dict[str, np.ndarray],
        samples: Samples,
        arrangement: Arrangement,
        spheres: dict,
        tight: np.ndarray,
    ) -> np.ndarray:
        close = self.nearness.close((spheres[a], spheres[b]), CULL)
        if not len(close):
            return close
        still = np.concatenate([[False], np.all(x[a][1:] == x[a][:-1], axis=1) & np.all(x[b][1:] == x[b][:-1], axis=1)])
        same = np.concatenate([[False], np.diff(samples.segment) == 0])
        close = close[~(still & same)[close]]
        collision = self.nearness.collision
        hits: list[int] = []
        for s in np.unique(samples.segment[close]).tolist():
            i = close[samples.segment[close] == s]
            held_a, held_b = (arrangement.modes[s].held.get(r) for r in (a, b))
            lo, t = samples.lo[i], samples.t[i]
            exact = (t == 0) | (t == 1) | tight[lo] | tight[np.minimum(lo + 1, len(tight) - 1)]
            qa, qb = x[a][i], x[b][i]

            def ask(k: np.ndarray) -> int:
                return collision.first_hit(a, qa[k], held_a, b, qb[k], held_b, exact=exact[k])  # noqa: B023

            hits += i[_all_hits(ask, np.arange(len(i)))].tolist()
        return np.array(sorted(hits), dtype=int)


def _doubtful(line: Polyline, samples: Samples, clearance: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Samples that the distances at the ends of their half of a step do not settle."""
    half = (samples.t > 0.5).astype(int)
    apart = clearance[samples.lo, half] + clearance[samples.lo, half + 1]
    own = samples.segment == line.segment_of_step[samples.lo]
    return np.flatnonzero(~own | (apart <= _SWERVE * moved[samples.lo] / 2))


def _all_hits(first_hit: Callable[[np.ndarray], int], rows: np.ndarray) -> np.ndarray:
    """All rows for which a query that returns the first hit, or -1, finds one."""
    out, start = [], 0
    while start < len(rows):
        k = first_hit(rows[start:])
        if k < 0:
            break
        out.append(start + k)
        start += k + 1
    return np.array(out, dtype=int)


def knot_samples(line: Polyline, pieces: np.ndarray) -> Samples:
    """`pieces` (K - 1,) samples per step and its end; knots of transitions belong to both segments."""
    of_step = line.segment_of_step
    lo = np.repeat(np.arange(line.knots - 1), pieces)
    t = np.concatenate([np.zeros(0), *(np.arange(n) / n for n in pieces.tolist())])
    if line.knots == 1:
        segments = np.arange(len(line.events) + 1)
        return Samples(np.zeros(len(segments), int), np.zeros(len(segments)), segments)
    ends = np.unique([line.knots - 1, *line.events.tolist()])
    ends = ends[ends > 0]
    # Segments of one waypoint, and the start of the motion right after a transition at the first knot.
    short = [s for s in range(len(line.events) + 1) if s not in set(of_step.tolist())]
    knots = [int(line.events[min(s, len(line.events) - 1)]) for s in short]
    lo_s = np.minimum(knots, line.knots - 2).astype(int)
    t_s = np.array(knots, dtype=float) - lo_s
    all_lo = np.concatenate([lo, ends - 1, lo_s])
    all_t = np.concatenate([t, np.ones(len(ends)), t_s])
    segment = np.concatenate([of_step[lo], of_step[ends - 1], np.array(short, dtype=int)])
    order = np.lexsort((all_lo + all_t, segment))
    return Samples(all_lo[order].astype(int), all_t[order], segment[order].astype(int))
