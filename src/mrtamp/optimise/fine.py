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
_TOLERATED = 0.98
"""Share of the tolerated penetration beyond which a sample is refused: between samples it may be a little more."""
_SWERVE = 1.3
"""By how much more than tracked points any other may move."""

Who = tuple[str, ...]
"""One robot (with its load against the world), or two (against each other)."""


@dataclass(frozen=True, eq=False)
class Violations:
    """Samples (S,) in collision, and who: a robot alone or two robots; `depth` (S,) is what is beyond the tolerated."""

    who: Who
    samples: Samples
    depth: np.ndarray


def near_to(
    nearness: Nearness,
    line: Polyline,
    who: Who,
    states: Sequence[State],
    samples: Samples,
    arrangement: Arrangement,
    reach: float,
) -> tuple[Near, np.ndarray]:
    """What is within `reach` (m) of one robot, or between two, in these states; and which of the pairs (P,) may touch,
    since an object is lifted off or put on something."""
    if len(who) == 2:
        near = nearness.between((who[0], who[1]), (states[0], states[1]), samples, arrangement, reach)
        return near, np.zeros(len(near.distance), dtype=bool)
    [robot], [state] = who, states
    near = nearness.world(robot, state, samples, arrangement, reach)
    return near, nearness.touching(robot, _contact_of(line.stretches, robot, samples), near)


def _contact_of(stretches: Sequence[Stretch], robot: str, samples: Samples) -> np.ndarray:
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
        self.tolerance = _TOLERATED * nearness.collision.problem.collision.tolerance
        self.resolution = resolution

    def _points(self, robot: str, x: np.ndarray) -> np.ndarray:
        """Where tracked points (n, P, 3) of a robot are in configurations x (n, N)."""
        spheres, R, p = self.nearness.worlds[robot].spheres_and_grasp(x)
        hand = p[:, None] + 0.1 * np.swapaxes(R, 1, 2)
        return np.concatenate([spheres, hand], axis=1)

    def _travel(self, line: Polyline, q: np.ndarray) -> dict[str, np.ndarray]:
        """How far (m) tracked points of every robot move in every step (K - 1,)."""
        points = {r: self._points(r, q[:, columns]) for r, columns in line.columns.items()}
        return {r: np.linalg.norm(np.diff(p, axis=0), axis=2).max(axis=1) for r, p in points.items()}

    def left(
        self, clearance: Mapping[Who, np.ndarray], line: Polyline, before: np.ndarray, after: np.ndarray
    ) -> dict[Who, np.ndarray]:
        """What is left at least of distances (K - 1, m + 1) along every step when knots move `before` -> `after`."""
        moved = {}
        for r, columns in line.columns.items():
            away = self._points(r, after[:, columns]) - self._points(r, before[:, columns])
            moved[r] = _SWERVE * np.linalg.norm(away, axis=2).max(axis=1)
        out = {}
        for who, distance in clearance.items():
            t = np.linspace(0, 1, distance.shape[1])
            at = np.sum([moved[r] for r in who], axis=0)
            out[who] = distance - (1 - t) * at[:-1, None] - t * at[1:, None]
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
        clearance: Mapping[Who, np.ndarray],
        between: bool = False,
    ) -> list[Violations]:
        """All samples in collision; with `between`, of the samples in between the others, and more of a close call.

        `clearance` are distances (K - 1, m + 1) at equal intervals along every step: nothing that is further apart at
        both ends of an interval than it moves in between is asked about.
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
        out, looked = [], []
        total = np.zeros(len(samples))
        for who, all_of_them in doubtful.items():
            # Who stands still is looked at once.
            stands = np.all([still[r] for r in who], axis=0)
            mine = all_of_them[~stands[all_of_them]]
            if not len(mine):
                continue
            self.nearness.collision.counts.collision_checks += len(mine)
            at = [state.of(np.searchsorted(used, mine)) for used, state in (states[r] for r in who)]
            depth = np.zeros(len(samples))
            depth[mine], suspects = self._depths(line, who, at, samples[mine], arrangement)
            if between and len(suspects) and not np.any(depth[mine] > self.tolerance):
                found = self._around(line, q, who, samples[mine[suspects]], arrangement, travel)
                out += [found] if len(found.samples) else []
            if self.tolerance > 0:
                depth = depth[np.maximum.accumulate(np.where(stands, 0, np.arange(len(samples))))]
            total += depth
            looked.append((who, depth))
        beyond = total - self.tolerance
        for who, depth in looked:
            hits = np.flatnonzero((depth > 0) & (beyond > 0))
            if len(hits):
                out.append(Violations(who, samples[hits], beyond[hits]))
        return out

    def _depths(
        self, line: Polyline, who: Who, states: Sequence[State], samples: Samples, arrangement: Arrangement
    ) -> tuple[np.ndarray, np.ndarray]:
        """All penetrations together (S,) at every sample, and samples so close to one that those around them are worth
        a look."""
        near, touching = near_to(self.nearness, line, who, states, samples, arrangement, _CLOSE)
        lifted = touching & (near.distance >= -CONTACT_DEPTH)
        depth = np.where(lifted, 0.0, -near.distance)
        close = _total(near, np.where(touching, depth, depth + _CLOSE), len(samples)) > self.tolerance
        return _total(near, depth, len(samples)), np.flatnonzero(close)

    def _around(
        self,
        line: Polyline,
        q: np.ndarray,
        who: Who,
        samples: Samples,
        arrangement: Arrangement,
        travel: Mapping[str, np.ndarray],
    ) -> Violations:
        """What is in collision around samples of which every fourth was checked at the resolution."""
        pieces = self._pieces(travel)[samples.lo]
        t = (samples.t[:, None] + _AROUND / (4 * pieces[:, None])).ravel()
        inside = (t >= 0) & (t <= 1)
        repeat = len(_AROUND)
        more = Samples(np.repeat(samples.lo, repeat), t, np.repeat(samples.segment, repeat))[inside]
        self.nearness.collision.counts.collision_checks += len(more)
        states = [self.nearness.state(r, q[:, line.columns[r]], more, arrangement.modes) for r in who]
        beyond = self._depths(line, who, states, more, arrangement)[0] - self.tolerance
        hits = np.flatnonzero(beyond > 0)
        return Violations(who, more[hits], beyond[hits])


def _total(near: Near, depth: np.ndarray, n: int) -> np.ndarray:
    """The sum of penetrations `depth` (P,) at each of n samples."""
    return np.bincount(near.sample, weights=np.maximum(depth, 0.0), minlength=n)


def _still(x: np.ndarray, samples: Samples) -> np.ndarray:
    """Samples (S,) at which configurations x (S, n) are those of the sample before, in the same segment."""
    out = np.zeros(len(x), dtype=bool)
    out[1:] = np.all(x[1:] == x[:-1], axis=1) & (np.diff(samples.segment) == 0)
    return out


def _doubtful(line: Polyline, samples: Samples, clearance: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Samples that the distances at the ends of their interval of a step do not settle."""
    m = clearance.shape[1] - 1
    k = np.minimum((m * samples.t).astype(int), m - 1)
    apart = clearance[samples.lo, k] + clearance[samples.lo, k + 1]
    own = samples.segment == line.segment_of_step[samples.lo]
    return np.flatnonzero(~own | (apart <= _SWERVE * moved[samples.lo] / m))


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
