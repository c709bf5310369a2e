"""The optimiser's own judge: yes-or-no collision queries at samples as fine as the planner's own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mrtamp.collision import CONTACT_DEPTH, RESOLUTION
from mrtamp.optimise.choices import Arrangement
from mrtamp.optimise.nearness import Near, Nearness, Samples, State
from mrtamp.optimise.polyline import Polyline, Stretch

_SLIVER = 1e-9
_QUARTERS = np.array([0.25, 0.5, 0.75])
_AROUND = np.array([-0.75, -0.5, -0.25, 0.25, 0.5, 0.75])
_CLOSE = 1.5e-3
"""Distance (m) at which samples in between are looked at again more closely."""
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
        self.tolerance = nearness.collision.problem.collision.tolerance
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

    def _pieces(self, travel: Mapping[str, np.ndarray]) -> np.ndarray:
        """Into how many pieces (K - 1,) every step is cut."""
        furthest = np.max(list(travel.values()), axis=0)
        return np.maximum(1, np.ceil(1.1 * furthest / self.resolution)).astype(int)

    def _samples(self, line: Polyline, travel: Mapping[str, np.ndarray], between: bool) -> Samples:
        """Samples between which no tracked point of any robot moves further than the resolution, transitions twice.

        With `between`, three samples in between any two of those.
        """
        pieces = self._pieces(travel)
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
        """All samples in collision; with `between`, of the samples in between the others, and more of a close call.

        Next to knots (K,) at which both of two robots are `pinned`, their shapes count without padding.  `clearance`
        are distances (K - 1, 3) at the beginning, the middle and the end of every step: nothing that is further apart
        at both ends of half a step than it moves in between is asked about.
        """
        travel = self._travel(line, q)
        samples = self._samples(line, travel, between)
        names = list(line.columns)
        doubtful: dict[Who, np.ndarray] = {}
        for i, robot in enumerate(names):
            for other in (None, *names[:i]):
                who: Who = (robot,) if other is None else (other, robot)
                moved = np.sum([travel[r] for r in who], axis=0)
                doubtful[who] = _doubtful(line, samples, clearance[who], moved)
        x = {r: samples.at(q[:, line.columns[r]]) for r in names}
        still = {r: _still(x[r], samples) for r in names}
        states: dict[str, tuple[np.ndarray, State]] = {}
        for robot in names:
            used = np.unique(np.concatenate([mine for who, mine in doubtful.items() if robot in who]))
            states[robot] = (
                used,
                self.nearness.state(robot, q[:, line.columns[robot]], samples[used], arrangement.modes),
            )
        out = []
        for who, all_of_them in doubtful.items():
            # Who stands still is looked at once.
            mine = all_of_them[~np.all([still[r][all_of_them] for r in who], axis=0)]
            if not len(mine):
                continue
            self.nearness.collision.counts.collision_checks += len(mine)
            at = [state.of(np.searchsorted(used, mine)) for used, state in (states[r] for r in who)]
            if len(who) == 1:
                hits, suspects = self._world(line, who[0], at[0], samples[mine], arrangement)
                if between and not len(hits) and len(suspects):
                    found = self._around(line, q, who[0], samples[mine[suspects]], arrangement, travel)
                    out += [Violations(who, found)] if len(found) else []
            else:
                hits = self._pair(who, (at[0], at[1]), samples[mine], arrangement, pinned[who[0]] & pinned[who[1]])
            if len(hits):
                out.append(Violations(who, samples[mine[hits]]))
        return out

    def _world(
        self, line: Polyline, robot: str, state: State, samples: Samples, arrangement: Arrangement
    ) -> tuple[np.ndarray, np.ndarray]:
        """Samples in collision, and samples so close to it that those around them are worth a look."""
        near = self.nearness.world(robot, state, samples, arrangement, _CLOSE)
        touching = self.nearness.touching(robot, contact_of(line.stretches, robot, samples), near)
        depth = np.where(touching & (near.distance >= -CONTACT_DEPTH), 0.0, -near.distance)
        return self._refused(near, depth, len(samples)), np.unique(near.sample[~touching])

    def _around(
        self,
        line: Polyline,
        q: np.ndarray,
        robot: str,
        samples: Samples,
        arrangement: Arrangement,
        travel: Mapping[str, np.ndarray],
    ) -> Samples:
        """What is in collision around samples of which every fourth was checked at the resolution."""
        pieces = self._pieces(travel)[samples.lo]
        t = (samples.t[:, None] + _AROUND / (4 * pieces[:, None])).ravel()
        inside = (t >= 0) & (t <= 1)
        repeat = len(_AROUND)
        more = Samples(np.repeat(samples.lo, repeat), t, np.repeat(samples.segment, repeat))[inside]
        self.nearness.collision.counts.collision_checks += len(more)
        state = self.nearness.state(robot, q[:, line.columns[robot]], more, arrangement.modes)
        return more[self._world(line, robot, state, more, arrangement)[0]]

    def _pair(
        self,
        who: Who,
        states: tuple[State, State],
        samples: Samples,
        arrangement: Arrangement,
        tight: np.ndarray,
    ) -> np.ndarray:
        near = self.nearness.between((who[0], who[1]), states, samples, arrangement, 0.0)
        lo, t = samples.lo, samples.t
        exact = (t == 0) | (t == 1) | tight[lo] | tight[np.minimum(lo + 1, len(tight) - 1)]
        bare = exact[near.sample] | (self.tolerance > 0)
        return self._refused(near, -near.distance - np.where(bare, near.padding, 0.0), len(samples))

    def _refused(self, near: Near, depth: np.ndarray, n: int) -> np.ndarray:
        """Samples of n at which all penetrations together are more than is tolerated."""
        total = np.bincount(near.sample, weights=np.maximum(depth, 0.0), minlength=n)
        return np.flatnonzero(total > self.tolerance)


def _still(x: np.ndarray, samples: Samples) -> np.ndarray:
    """Samples (S,) at which configurations x (S, n) are those of the sample before, in the same segment."""
    out = np.zeros(len(x), dtype=bool)
    out[1:] = np.all(x[1:] == x[:-1], axis=1) & (np.diff(samples.segment) == 0)
    return out


def _doubtful(line: Polyline, samples: Samples, clearance: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Samples that the distances at the ends of their half of a step do not settle."""
    half = (samples.t > 0.5).astype(int)
    apart = clearance[samples.lo, half] + clearance[samples.lo, half + 1]
    own = samples.segment == line.segment_of_step[samples.lo]
    return np.flatnonzero(~own | (apart <= _SWERVE * moved[samples.lo] / 2))


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
