"""Refinement of a plan: shortcuts robot by robot, and re-timing of a robot across its own events (DESIGN section 8).

A plan becomes a sequence of knots, one configuration per robot at each, with the knot at which every action happens.
A shortcut changes one robot between two of its anchors while the others stay as they are.  A re-timing keeps all paths
and moves one robot along its own earlier or later than before, past events of the others where nothing forbids it: so
plans that move one robot at a time come to move them together.  Proposals are priced first and checked only when they
pay.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from mrtamp.clearance import Clearance, Track
from mrtamp.collision import RESOLUTION
from mrtamp.modes import Mode
from mrtamp.plan import Action, Plan, Segment, Transition
from mrtamp.retiming import Grid, Timing, cut, duration, simple_timing
from mrtamp.validity import Resting, Validity

_KNOT = 0.3
"""Largest distance (rad) between knots after subdivision."""
_MERGED = 0.12
"""Longest step (rad) that comes of dropping a needless knot."""
_LONGEST = 40
_CONTACT = 0.015
"""How far (m) the hand moves in the straight motions next to a change of attachment that stay as they are."""
_NEAR, _FINER = 0.05, 5
"""Within this distance (m) of such a change the hand's motion is sampled so many times as densely."""
_STRAIGHT = 1e-6
_SLICES = 20
_FLOOR = 0.08
"""Least share of the work for every kind of proposal; the rest goes by what each has gained for its work."""
_PROPOSAL = 30.0
_TRY = 200.0
"""What a proposal, and the geometry of a re-timing, cost beside their checks, in checks."""
_LEAST = 5e-5
"""Gain, relative to the cost, below which a proposal is not worth its checks."""
_FADE = 0.99
_CELLS = 1500
_DETOURS = 5
_EPS = 1e-9


@dataclass(frozen=True)
class _Happening:
    """An action, the knot at which it happens, and the straight lengths (rad) of its robots' motions beside it."""

    action: Action
    knot: int
    contact: tuple[tuple[float, float], ...]

    def at(self, knot: int) -> _Happening:
        return _Happening(self.action, knot, self.contact)


def must_follow(a: Action, b: Action, after: Mapping[str, Sequence[str]]) -> bool:
    """Whether b has to stay after an action a that comes before it.

    So it is when they share a robot or an object, when one object rests on the other before or afterwards, and when b
    reaches a subgoal that is to come `after` (name -> names) that of a.
    """
    if set(a.robots) & set(b.robots) or (a.object is not None and a.object == b.object):
        return True
    for x, y in ((a, b), (b, a)):
        parents = {c.parent for c in (x.before, x.after) if c is not None and not c.held}
        if y.object in parents:
            return True
    return b.subgoal is not None and a.subgoal in after.get(b.subgoal, ())


class Refiner:
    """Improves one sequence of segments and transitions; configurations at transitions stay as they are.

    Attributes
    ----------
    cost : cost of the current polyline, transitions included.
    transitions, modes : what happens in the order in which it happens now, and the modes between.
    """

    def __init__(
        self, plan: Plan, validity: Validity, rng: np.random.Generator, resolution: float = RESOLUTION
    ) -> None:
        segments, collision = plan.segments, validity.collision
        self.weights = plan.problem.cost
        self.validity = validity
        self.roadmaps = validity.roadmaps
        self.rng = rng
        self.clearance = Clearance(collision, resolution, rng)
        self.names = list(segments[0].q)
        self.proposals = 0
        self._counts = collision.counts
        self._gain = np.array([0.6, 0.2, 0.2])
        self._work = np.full(3, 10 * _PROPOSAL)
        self._spent = np.zeros(3)
        self._tries = 0
        self._after = {s.name: s.after for s in collision.problem.subgoals}
        self._start = segments[0].mode
        self._load(segments, plan.transitions)
        self._subdivide()
        self._measure()
        self._settle()

    # -- representation -------------------------------------------------------------------------------------------

    def _load(self, segments: Sequence[Segment], transitions: Sequence[Transition]) -> None:
        first, *others = segments
        self._q = {r: np.concatenate([first.q[r], *(s.q[r][1:] for s in others)]) for r in self.names}
        knots = np.cumsum([s.length - 1 for s in segments[:-1]]).tolist()
        self._events: list[_Happening] = []
        for t, k in zip(transitions, knots, strict=True):
            for a in t.actions:
                contact = tuple((self._contact(r, a, k, -1), self._contact(r, a, k, 1)) for r in a.robots)
                self._events.append(_Happening(a, k, contact))

    def _contact(self, robot: str, action: Action, knot: int, step: int) -> float:
        """Length (rad) of the straight motion of a robot right before or after a change of attachment."""
        if action.after is None:
            return 0.0
        q, tool = self._q[robot], self.roadmaps[robot].world.tool
        length, direction = 0.0, None
        k = knot
        while 0 <= k + step < len(q):
            way = q[k + step] - q[k]
            size = float(np.linalg.norm(way))
            k += step
            if size <= _EPS:
                continue
            if direction is not None and way @ direction < size * (1 - _STRAIGHT):
                break
            direction = way / size
            t = np.linspace(0.0, 1.0, _SLICES + 1)
            hand = tool.pose(q[k - step] + t[:, None] * way)[1]
            away = np.flatnonzero(np.linalg.norm(hand - tool.pose(q[knot : knot + 1])[1], axis=1) >= _CONTACT)
            if len(away):
                return length + float(t[away[0]]) * size
            length += size
        return length

    def _subdivide(self) -> None:
        """Insert knots where motions that stay end, and so that no step is longer than _KNOT."""
        steps = np.array([np.linalg.norm(np.diff(q, axis=0), axis=1) for q in self._q.values()])
        if not steps.size:
            return
        pieces = np.maximum(1, np.ceil(steps.max(axis=0) / _KNOT)).astype(int)
        ts = [k + j / n for k, n in enumerate(pieces.tolist()) for j in range(n)]
        for h in self._events:
            for robot, (before, after) in zip(h.action.robots, h.contact, strict=True):
                own = steps[self.names.index(robot)]
                along = np.concatenate([[0.0], np.cumsum(own)])
                for x in (along[h.knot] - before, along[h.knot] + after):
                    k = int(np.clip(np.searchsorted(along, x) - 1, 0, len(own) - 1))
                    if own[k] > _EPS:
                        ts.append(k + float(np.clip((x - along[k]) / own[k], 0.0, 1.0)))
        t = np.unique([*ts, float(len(pieces))])
        low = np.minimum(t.astype(int), len(pieces) - 1)
        starts = np.searchsorted(t, np.arange(len(pieces) + 1))
        for r, q in self._q.items():
            self._q[r] = q[low] + (t - low)[:, None] * (q[low + 1] - q[low])
            self._q[r][starts] = q
        self._events = [h.at(int(starts[h.knot])) for h in self._events]

    def _measure(self) -> None:
        self._tracks: dict[str, Track] = {}
        self._lengths = np.array([np.linalg.norm(np.diff(self._q[r], axis=0), axis=1) for r in self.names])
        changes = self.weights.of_changes(h.action.kind for h in self._events)
        self.cost = self._price(self._lengths) + changes

    def _price(self, lengths: np.ndarray) -> float:
        if not lengths.size:
            return 0.0
        return float(self.weights.makespan * lengths.max(axis=0).sum() + self.weights.path_length * lengths.sum())

    def _settle(self) -> None:
        """Derive modes, transitions and anchors from what happens when."""
        self._modes = [self._start]
        for h in self._events:
            self._modes.append(self._modes[-1].after(Transition((h.action,))))
        self._of_step = np.searchsorted([h.knot for h in self._events], np.arange(self._lengths.shape[1]), side="right")
        self._anchor = {r: self._anchors(r) for r in self.names}

    def _anchors(self, robot: str) -> np.ndarray:
        """Knots (K,) at which the robot stays where it is: ends, its transitions and the straight motions beside."""
        K = self._lengths.shape[1] + 1
        out = np.zeros(K, dtype=bool)
        out[[0, K - 1]] = True
        along = np.concatenate([[0.0], np.cumsum(self._lengths[self.names.index(robot)])])
        for h in self._events:
            if robot not in h.action.robots:
                continue
            before, after = h.contact[h.action.robots.index(robot)]
            out[h.knot] = True
            here = along[h.knot]
            if before > 0:
                # Standing next to it may be re-timed: anchors are where the straight motion begins and ends.
                low = int(np.searchsorted(along, here - before + _EPS, side="right")) - 1
                out[max(low, 0) : int(np.searchsorted(along, here - _EPS)) + 1] = True
            if after > 0:
                high = int(np.searchsorted(along, here + after - _EPS))
                out[int(np.searchsorted(along, here + _EPS, side="right")) - 1 : min(high, K - 1) + 1] = True
        return out

    def _groups(self) -> list[tuple[int, Transition]]:
        """Actions at the same knot as one transition where they are independent, else one after the other."""
        out: list[tuple[int, tuple[Action, ...]]] = []
        for h in self._events:
            together = out and out[-1][0] == h.knot
            if together and not any(must_follow(a, h.action, self._after) for a in out[-1][1]):
                out[-1] = (h.knot, (*out[-1][1], h.action))
            else:
                out.append((h.knot, (h.action,)))
        return [(k, Transition(actions)) for k, actions in out]

    @property
    def transitions(self) -> list[Transition]:
        """The transitions in their present order."""
        return [t for _, t in self._groups()]

    @property
    def modes(self) -> list[Mode]:
        """The modes of the segments."""
        out = [self._start]
        for t in self.transitions:
            out.append(out[-1].after(t))
        return out

    def segments(self) -> list[Segment]:
        """The current polyline as segments."""
        bounds = [0, *(k for k, _ in self._groups()), self._lengths.shape[1]]
        return [
            Segment(mode, {r: self._q[r][a : b + 1].copy() for r in self.names})
            for mode, (a, b) in zip(self.modes, pairwise(bounds), strict=True)
        ]

    def _compress(self) -> None:
        """Drop knots at which nobody changes speed, and steps in which nobody moves."""
        for _ in range(3):
            K = self._lengths.shape[1] + 1
            drop = np.zeros(K, dtype=bool)
            if K > 1:
                # A knot that equals the one before is dropped; what happens there happens at the one before.
                drop[1:] = self._lengths.max(axis=0) <= _EPS
            if not drop.any() and K > 2:
                composite = np.concatenate([self._q[r] for r in self.names], axis=1)
                a, b = np.diff(composite, axis=0)[:-1], np.diff(composite, axis=0)[1:]
                la, lb = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
                bend = np.linalg.norm(a * lb[:, None] - b * la[:, None], axis=1) / (la + lb)
                peak = self._lengths.max(axis=0)
                drop[1:-1] = (bend < 1e-10) & (peak[:-1] + peak[1:] <= _MERGED)
                drop[[h.knot for h in self._events]] = False
                for k in np.flatnonzero(drop[1:] & drop[:-1]) + 1:
                    # Of neighbouring knots only every other one: the rest is judged anew.
                    drop[k] &= not drop[k - 1]
            if not drop.any():
                break
            kept = np.cumsum(~drop) - 1
            exact = [{r: self._q[r][h.knot] for r in h.action.robots} for h in self._events]
            self._q = {r: q[~drop] for r, q in self._q.items()}
            self._events = [h.at(int(kept[h.knot])) for h in self._events]
            for h, at in zip(self._events, exact, strict=True):
                for r, x in at.items():
                    self._q[r][h.knot] = x
            self._measure()
        self._settle()

    # -- proposals ------------------------------------------------------------------------------------------------

    def improve(self, proposals: int) -> float:
        """Try a number of proposals; returns by how much the cost went down."""
        before = self.cost
        for _ in range(proposals):
            self.proposals += 1
            kind = int(np.argmin(self._spent / self._shares()))
            cost, checks, self._tries = self.cost, self._counts.collision_checks, 0
            self._shortcut() if kind == 0 else self._retime(search=kind == 2)
            self._gain *= _FADE
            self._work *= _FADE
            self._gain[kind] += cost - self.cost
            work = _PROPOSAL + _TRY * self._tries + self._counts.collision_checks - checks
            self._work[kind] += work
            self._spent[kind] += work
        self._compress()
        return before - self.cost

    def _shares(self) -> np.ndarray:
        """Shares of the work for shortcuts, simple re-timings and searched ones: as they have paid."""
        if len(self.names) == 1:
            return np.array([1.0, 1e-9, 1e-9])
        rate = (self._gain + 1e-9) / self._work
        return _FLOOR + (1 - 3 * _FLOOR) * rate / rate.sum()

    def _shortcut(self) -> None:
        index = int(self.rng.integers(len(self.names)))
        robot = self.names[index]
        q, anchors = self._q[robot], np.flatnonzero(self._anchor[robot])
        gaps = np.flatnonzero(np.diff(anchors) > 1)
        if not len(gaps):
            return
        g = int(gaps[self.rng.integers(len(gaps))])
        i, j = int(anchors[g]), int(anchors[g + 1])
        if self.rng.random() < 0.6 and j - i > 2:
            a = int(self.rng.integers(i, j - 1))
            b = int(self.rng.integers(a + 2, min(j, a + _LONGEST) + 1))
            i, j = a, b
        others = np.delete(self._lengths[:, i:j], index, axis=0)
        pace = others.max(axis=0) if len(others) else np.zeros(j - i)
        fresh = self._shape(q[i : j + 1], pace)
        own = np.linalg.norm(np.diff(fresh, axis=0), axis=1)
        lengths = self._lengths[:, i:j].copy()
        old = self._price(lengths)
        lengths[index] = own
        if self._price(lengths) >= old - _LEAST * self.cost or not self._is_free(robot, i, fresh):
            return
        q[i : j + 1] = fresh
        self._tracks.pop(robot, None)
        self._lengths[index, i:j] = own
        self.cost += self._price(lengths) - old

    def _shape(self, q: np.ndarray, pace: np.ndarray) -> np.ndarray:
        """A new motion (m, n) between the same ends: straight, the same path at another time, or bent."""
        kind = self.rng.random()
        if kind < 0.5:
            path = q[[0, -1]]
        elif kind < 0.75:
            path = q
        else:
            middle = q[len(q) // 2] + self.rng.normal(scale=0.25, size=q.shape[1])
            path = np.stack([q[0], middle, q[-1]])
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
        length = along[-1]
        if length <= _EPS:
            return np.repeat(q[:1], len(q), axis=0)
        total = pace.sum()
        clock = np.concatenate([[0.0], np.cumsum(pace)])
        timing = self.rng.random()
        if total <= _EPS or timing < 0.2:
            progress = np.linspace(0, length, len(q))
        elif timing < 0.6:
            progress = clock / total * length
        elif timing < 0.8:
            progress = np.minimum(clock, length)
        else:
            progress = np.maximum(clock - total + length, 0.0)
        progress[0], progress[-1] = 0.0, length
        fresh = np.column_stack([np.interp(progress, along, path[:, d]) for d in range(q.shape[1])])
        fresh[0], fresh[-1] = q[0], q[-1]
        return fresh

    def _is_free(self, robot: str, i: int, fresh: np.ndarray) -> bool:
        """Whether the robot may move through `fresh` (m, n) from knot i on, the others as they are."""
        chain = self.roadmaps[robot].world.chain
        if np.any(fresh < chain.lower) or np.any(fresh > chain.upper):
            return False
        j = i + len(fresh) - 1
        modes = [self._modes[s] for s in self._of_step[i:j]]
        steps = np.arange(j - i)
        own = self._track(robot, fresh, modes)
        for other in self.names:
            if (
                other != robot
                and self.clearance.pair(own, self._track(other, self._q[other][i : j + 1], modes), steps) >= 0
            ):
                return False
        own.finer = self._close_to_contact(robot, own)
        return self.clearance.world(own, steps, [self.validity.resting(m) for m in modes], static=True) < 0

    def _close_to_contact(self, robot: str, track: Track) -> np.ndarray:
        """How many times as densely each step (M - 1,) has to be sampled."""
        knots = [h.knot for h in self._events if robot in h.action.robots and h.action.after is not None]
        if not knots:
            return np.ones(len(track.q) - 1, dtype=int)
        places = self.roadmaps[robot].world.tool.pose(self._q[robot][knots])[1]
        gap = np.linalg.norm(track.hand[:, None] - places, axis=2).min(axis=1)
        return np.where(np.minimum(gap[:-1], gap[1:]) < _NEAR, _FINER, 1)

    def _present(self, robot: str, i: int, j: int, modes: Sequence[Mode]) -> Track:
        """The present motion of a robot from knot i to knot j; kept until it changes."""
        q = self._q[robot]
        known = self._tracks.get(robot)
        if known is None:
            known = self._tracks[robot] = Track(self.roadmaps[robot], q, [])
        return known.part(i, j, [m.held.get(robot) for m in modes])

    def _track(self, robot: str, q: np.ndarray, modes: Sequence[Mode]) -> Track:
        return Track(self.roadmaps[robot], q, [m.held.get(robot) for m in modes])

    # -- re-timing ------------------------------------------------------------------------------------------------

    def _retime(self, search: bool) -> None:
        """Move one robot along its own path at another time, between two knots that stay."""
        index = int(self.rng.integers(len(self.names)))
        window = self._window(self.names[index])
        if window is None:
            return
        i, j = window
        pace = np.delete(self._lengths[:, i:j], index, axis=0).max(axis=0, initial=0.0)
        plane = _Plane(
            index,
            i,
            j,
            np.concatenate([[0.0], np.cumsum(pace)]),
            np.concatenate([[0.0], np.cumsum(self._lengths[index, i:j])]),
            [n for n, h in enumerate(self._events) if i < h.knot < j],
        )
        T, L = plane.clock[-1], plane.progress[-1]
        present = float(self._lengths[:, i:j].max(axis=0).sum())
        if L <= _EPS or T <= _EPS or present - max(T, L) <= self._least():
            return
        if search:
            self._search(plane, present)
        else:
            path = simple_timing(T, L, self.rng)
            if duration(path) < present - self._least():
                self._try(plane, path)

    def _least(self) -> float:
        """Least gain in time (rad) that is worth a try."""
        return _LEAST * self.cost / max(self.weights.makespan, _EPS)

    def _window(self, robot: str) -> tuple[int, int] | None:
        """Two knots between which no action needs the robot together with others."""
        K = self._lengths.shape[1] + 1
        fixed = sorted(
            {0, K - 1, *(h.knot for h in self._events if robot in h.action.robots and len(h.action.robots) > 1)}
        )
        i = int(self.rng.integers(K))
        low = max((k for k in fixed if k <= i), default=0)
        high = min((k for k in fixed if k > low), default=K - 1)
        kind = self.rng.random()
        if kind < 0.25:
            i, j = low, high
        else:
            span = 2 + int((high - low) * self.rng.random() ** 2)
            i = int(self.rng.integers(low, max(high - span, low) + 1))
            j = min(i + span, high)
        return (i, j) if j - i >= 2 else None

    def _cut(self, plane: _Plane, path: np.ndarray) -> Timing | None:
        events, before = [], []
        robot = self.names[plane.index]
        inside = [self._events[n].action for n in plane.events]
        for n, a in zip(plane.events, inside, strict=True):
            own = robot in a.robots
            events.append((own, float((plane.progress if own else plane.clock)[self._events[n].knot - plane.i])))
        for m, b in enumerate(inside):
            before.append([x for x in range(m) if must_follow(inside[x], b, self._after)])
        return cut(path, plane.clock, plane.progress, events, before)

    def _try(self, plane: _Plane, path: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Check a timing and take it; returns the leg (c, p) to (c, p) that is in the way, if any."""
        timing = self._cut(plane, path)
        if timing is None:
            return None
        self._tries += 1
        i, j, M = plane.i, plane.j, len(timing.c)
        q = {}
        for n, r in enumerate(self.names):
            clock, at = (plane.progress, timing.p) if n == plane.index else (plane.clock, timing.c)
            old = self._q[r][i : j + 1]
            q[r] = np.column_stack([np.interp(at, clock, old[:, d]) for d in range(old.shape[1])])
            q[r][0], q[r][-1] = old[0], old[-1]
        moved = [self._events[n].at(i + k) for n, k in zip(plane.events, timing.events, strict=True)]
        # The sort is stable, and actions that must follow each other are in their old order.
        moved.sort(key=lambda h: h.knot)
        for h in moved:
            for r in h.action.robots:
                old_knot = next(x.knot for x in self._events if x.action is h.action)
                q[r][h.knot - i] = self._q[r][old_knot]
        first = next((n for n, h in enumerate(self._events) if h.knot > i), len(self._events))
        modes = [self._modes[first]]
        for h in moved:
            modes.append(modes[-1].after(Transition((h.action,))))
        of_step = np.searchsorted([h.knot - i for h in moved], np.arange(M - 1), side="right")
        step = self._first_conflict(plane, timing, q, [modes[s] for s in of_step])
        if step >= 0:
            a, b = (np.array([timing.c[k], timing.p[k]]) for k in (step, step + 1))
            return a, b
        later = len(timing.c) - (j - i + 1)
        self._q = {r: np.concatenate([x[:i], q[r], x[j + 1 :]]) for r, x in self._q.items()}
        earlier = [h for h in self._events if h.knot <= i]
        self._events = [*earlier, *moved, *(h.at(h.knot + later) for h in self._events if h.knot >= j and h.knot > i)]
        self._measure()
        self._compress()
        return None

    def _first_conflict(self, plane: _Plane, timing: Timing, q: dict[str, np.ndarray], modes: list[Mode]) -> int:
        """A step of a re-timed window in which something is in the way, or -1."""
        i = plane.i
        middle_c, middle_p = ((x[1:] + x[:-1]) / 2 for x in (timing.c, timing.p))
        last = plane.j - plane.i - 1
        theirs = np.clip(np.searchsorted(plane.clock, middle_c) - 1, 0, last)
        own = np.clip(np.searchsorted(plane.progress, middle_p) - 1, 0, last)
        robot = self.names[plane.index]
        same = (np.abs(np.interp(timing.p, plane.progress, plane.clock) - timing.c) < _EPS) | (
            np.abs(np.interp(timing.c, plane.clock, plane.progress) - timing.p) < _EPS
        )
        before = [self._modes[s] for s in self._of_step[i : plane.j]]
        changed = np.array(
            [not (same[k] and same[k + 1] and theirs[k] == own[k] and m is before[own[k]]) for k, m in enumerate(modes)]
        )
        if not changed.any():
            return -1
        first, last = np.flatnonzero(changed)[[0, -1]]
        steps = np.flatnonzero(changed[first : last + 1])
        modes = modes[first : last + 1]
        tracks = {robot: self._track(robot, q[robot][first : last + 2], modes)}
        for r in self.names:
            if r != robot:
                tracks[r] = self._track(r, q[r][first : last + 2], modes)
                hit = self.clearance.pair(tracks[robot], tracks[r], steps)
                if hit >= 0:
                    return int(first) + hit
        # Each robot moves as before: only objects that did not rest there at that point of its path are new to it.
        for r in self.names:
            old = (own if r == robot else theirs)[first : last + 1]
            fresh: list[tuple[Resting, ...]] = [()] * len(modes)
            for k in steps.tolist():
                known = {x.chain for x in self.validity.resting(before[old[k]])}
                fresh[k] = tuple(x for x in self.validity.resting(modes[k]) if x.chain not in known)
            some = np.array([k for k in steps.tolist() if fresh[k]], dtype=int)
            hit = self.clearance.world(tracks[r], some, fresh, static=False)
            if hit >= 0:
                return int(first) + hit
        return -1

    def _search(self, plane: _Plane, present: float) -> None:
        """Look for the shortest timing among those that are not in conflict, on a grid of both clocks."""
        T, L = float(plane.clock[-1]), float(plane.progress[-1])
        h = max(0.1, np.sqrt(T * L / _CELLS))
        robot = self.names[plane.index]
        acts = [(robot in self._events[n].action.robots, self._events[n]) for n in plane.events]
        marks = [float((plane.progress if own else plane.clock)[e.knot - plane.i]) for own, e in acts]
        cs = _lines(T, h, [m for m, (own, _) in zip(marks, acts, strict=True) if not own])
        ps = _lines(L, h, [m for m, (own, _) in zip(marks, acts, strict=True) if own])
        grid = Grid(cs, ps)
        for x, (own_a, a) in enumerate(acts):
            for y in range(x + 1, len(acts)):
                own_b, b = acts[y]
                if own_a != own_b and must_follow(a.action, b.action, self._after):
                    c, p = (marks[y], marks[x]) if own_a else (marks[x], marks[y])
                    grid.forbid(c, p, robot_waits=own_b)
        for _ in range(_DETOURS):
            path = grid.timing()
            if path is None or duration(path) >= present - self._least():
                return
            hit = self._try(plane, path)
            if hit is None:
                return
            grid.block(*hit)


@dataclass(frozen=True, eq=False)
class _Plane:
    """A window of knots i..j of robot number `index`: the clocks of the others and its own, and the events inside."""

    index: int
    i: int
    j: int
    clock: np.ndarray
    progress: np.ndarray
    events: list[int]


def _lines(length: float, step: float, marks: list[float]) -> np.ndarray:
    """Grid lines on [0, length] at most `step` apart, with one at every mark."""
    corners = np.unique([0.0, *marks, length])
    parts = [np.linspace(a, b, max(1, int(np.ceil((b - a) / step))) + 1)[:-1] for a, b in pairwise(corners)]
    return np.concatenate([*parts, [length]])
