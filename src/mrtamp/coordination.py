"""Letting robots move at the same time: every motion of a plan begins as early as the others allow.

A plan found one robot at a time is a list of legs and events.  In their order, each leg is inserted into the schedule
of what came before: the earliest timing along its path that keeps clear of the others' timed motions, of their
standing where they stopped, and of objects as they lie at that moment.  Waiting until everything before is over is
always possible, so the result is never longer than the plan (list scheduling; DESIGN section 9, insertion).
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mrtamp.collision import RESOLUTION, Collision, bisection_order
from mrtamp.modes import Attachment, Mode
from mrtamp.plan import Segment, Transition
from mrtamp.validity import Validity

STEP = 0.12
"""Longest motion (rad or m) of a robot in one step of the schedule."""
_NEAR = 0.012
"""Clearance (m) of bounding spheres below which Drake is asked."""
_EPS = 1e-9


@dataclass(frozen=True, eq=False)
class _Leg:
    """Robots that move together through rows of their tables; `path` maps each to (m + 1) row numbers."""

    path: Mapping[str, list[int]]
    mode: Mode

    @property
    def robots(self) -> tuple[str, ...]:
        return tuple(self.path)

    @property
    def length(self) -> int:
        return len(next(iter(self.path.values()))) - 1


@dataclass(frozen=True, eq=False)
class _Move:
    """What one robot does in one step: from row `a` to row `b` of its table; free among objects as in `mode`."""

    a: int
    b: int
    mode: Mode | None


class _Clearance:
    """Cached answers: pairs of moving robots, and robots against objects that were elsewhere when they were checked."""

    def __init__(self, collision: Collision, validity: Validity, names: Sequence[str]) -> None:
        self.collision = collision
        self.validity = validity
        self.worlds = {r: collision.worlds[r] for r in names}
        self.tables: dict[str, list[np.ndarray]] = {r: [] for r in names}
        self._pairs: dict[tuple, bool] = {}
        self._objects: dict[tuple, bool] = {}
        self._sampled: dict[tuple[str, int, int], tuple[np.ndarray, np.ndarray, np.ndarray, float]] = {}
        self._balls: dict[tuple, tuple[np.ndarray, np.ndarray]] = {}

    def row(self, robot: str, q: np.ndarray) -> int:
        """Put a configuration into a robot's table."""
        self.tables[robot].append(q)
        return len(self.tables[robot]) - 1

    def prepare(self, robot: str, moves: Sequence[tuple[int, int]]) -> None:
        """Sample moves (pairs of rows) at their ends and middles, all at once: bodies, hand and displacement."""
        world = self.worlds[robot]
        table = self.tables[robot]
        fresh = [m for m in dict.fromkeys(moves) if (robot, *m) not in self._sampled]
        if not fresh:
            return
        q = np.array([[table[a], (table[a] + table[b]) / 2, table[b]] for a, b in fresh])
        flat = q.reshape(-1, q.shape[2])
        centres = world.bounds.spheres(flat).reshape(len(fresh), 3, -1, 3)
        R, p = world.tool.pose(flat)
        R, p = R.reshape(-1, 3, 3, 3), p.reshape(-1, 3, 3)
        tracked = np.concatenate([centres, p[:, :, None]], axis=2)
        travel = 2.2 * np.linalg.norm(np.diff(tracked, axis=1), axis=3).max(axis=(1, 2))
        for k, (i, j) in enumerate(fresh):
            self._sampled[robot, i, j] = (centres[k], R[k], p[k], float(travel[k]))

    def _sample(self, robot: str, a: int, b: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        if (robot, a, b) not in self._sampled:
            self.prepare(robot, [(a, b)])
        return self._sampled[robot, a, b]

    def _ball(self, robot: str, a: int, b: int, held: Attachment | None) -> tuple[np.ndarray, np.ndarray]:
        """Balls (B, 3), (B,) that hold every body, and the load, all through a move."""
        key = (robot, a, b, held)
        if key not in self._balls:
            world = self.worlds[robot]
            centres, R, p, _ = self._sample(robot, a, b)
            radii = world.bounds.radii
            if held is not None:
                centres = np.concatenate([centres, (p + R @ held.X_PO[:3, 3])[:, None]], axis=1)
                radii = np.append(radii, world.object_radius[held.object])
            middle = (centres.min(axis=0) + centres.max(axis=0)) / 2
            self._balls[key] = (middle, radii + np.linalg.norm(centres - middle, axis=2).max(axis=0))
        return self._balls[key]

    def _samples(self, robots: Sequence[tuple[str, _Move]]) -> int:
        """How many samples of a step keep every tracked point within the resolution from one to the next."""
        travel = max(self._sample(robot, move.a, move.b)[3] for robot, move in robots)
        return max(2, int(np.ceil(travel / RESOLUTION)) + 1)

    def apart(
        self, one: str, a: _Move, held_a: Attachment | None, two: str, b: _Move, held_b: Attachment | None
    ) -> bool:
        """Whether two robots keep clear of each other in one step."""
        if one > two:
            one, a, held_a, two, b, held_b = two, b, held_b, one, a, held_a
        key = (one, a.a, a.b, held_a, two, b.a, b.b, held_b)
        known = self._pairs.get(key)
        if known is None:
            known = self._pairs[key] = self._apart(one, a, held_a, two, b, held_b)
        return known

    def _apart(
        self, one: str, a: _Move, held_a: Attachment | None, two: str, b: _Move, held_b: Attachment | None
    ) -> bool:
        ca, ra = self._ball(one, a.a, a.b, held_a)
        cb, rb = self._ball(two, b.a, b.b, held_b)
        gap = np.linalg.norm(ca[:, None] - cb[None], axis=2) - ra[:, None] - rb[None]
        if gap.min() > _NEAR:
            return True
        n = self._samples([(one, a), (two, b)]) if (a.a, b.a) != (a.b, b.b) else 1
        t = np.linspace(0, 1, n)[bisection_order(n)][:, None]
        qa = (1 - t) * self.tables[one][a.a] + t * self.tables[one][a.b]
        qb = (1 - t) * self.tables[two][b.a] + t * self.tables[two][b.b]
        pair, swapped = self.collision.pair(one, two)
        hit = pair.first_hit(qb, held_b, qa, held_a) if swapped else pair.first_hit(qa, held_a, qb, held_b)
        return hit < 0

    def among(self, robot: str, move: _Move, held: Attachment | None, mode: Mode) -> bool:
        """Whether a move keeps clear of the objects that rest in `mode` but not in the mode it was checked in."""
        if move.mode is mode:
            return True
        known = {r.chain for r in self.validity.resting(move.mode)} if move.mode is not None else set()
        return all(
            self._misses(robot, move, held, r.name, r.chain, r.X_WO)
            for r in self.validity.resting(mode)
            if r.chain not in known
        )

    def _misses(
        self, robot: str, move: _Move, held: Attachment | None, item: str, chain: tuple, X_WO: np.ndarray
    ) -> bool:
        if held is not None and held.object == item:
            return True
        key = (robot, move.a, move.b, held, chain)
        known = self._objects.get(key)
        if known is None:
            centres, radii = self._ball(robot, move.a, move.b, held)
            world = self.worlds[robot]
            gap = np.linalg.norm(centres - X_WO[:3, 3], axis=1) - radii - world.object_radius[item]
            known = bool(gap.min() > _NEAR)
            if not known:
                n = self._samples([(robot, move)]) if move.a != move.b else 1
                t = np.linspace(0, 1, n)[:, None]
                q = (1 - t) * self.tables[robot][move.a] + t * self.tables[robot][move.b]
                known = world.first_hit(world.rows(q, held, {item: X_WO})) < 0
            self._objects[key] = known
        return known


class _Schedule:
    """Timed moves of all robots, grown leg by leg and event by event; one step is one unit of time."""

    def __init__(self, clearance: _Clearance, segments: Sequence[Segment]) -> None:
        self.clearance = clearance
        self.modes = [s.mode for s in segments]
        self.names = list(segments[0].q)
        self.moves: dict[str, list[_Move]] = {r: [] for r in self.names}
        self.held: dict[str, list[Attachment | None]] = {r: [] for r in self.names}
        self.at: dict[str, int] = {r: clearance.row(r, segments[0].q[r][0]) for r in self.names}
        self.free_from = dict.fromkeys(self.names, 0)
        self.events: list[int] = []

    @property
    def end(self) -> int:
        """When everything scheduled so far is over."""
        return max([*self.free_from.values(), *self.events[-1:]])

    def _mode(self, t: int) -> Mode:
        """The mode of the step from t to t + 1."""
        return self.modes[sum(e <= t for e in self.events)]

    def _move(self, robot: str, t: int) -> _Move:
        moves = self.moves[robot]
        return moves[t] if t < len(moves) else _Move(self.at[robot], self.at[robot], None)

    def _holds(self, robot: str, t: int) -> Attachment | None:
        held = self.held[robot]
        return held[t] if t < len(held) else self._mode(t).held.get(robot)

    def _clear(self, robot: str, move: _Move, held: Attachment | None, t: int, others: Sequence[str]) -> bool:
        return self.clearance.among(robot, move, held, self._mode(t)) and all(
            self.clearance.apart(robot, move, held, o, self._move(o, t), self._holds(o, t)) for o in others
        )

    def insert(self, leg: _Leg) -> None:
        """Schedule a leg as early as it can end."""
        begin = max(self.free_from[r] for r in leg.robots)
        times = self._earliest(leg, begin)
        for r in leg.robots:
            self._wait(r, begin)
            path = leg.path[r]
            for i, j in itertools.pairwise(times):
                self.moves[r].append(_Move(path[i], path[j], leg.mode))
                self.held[r].append(leg.mode.held.get(r))
            self.at[r] = path[-1]
            self.free_from[r] = begin + len(times) - 1

    def _wait(self, robot: str, until: int) -> None:
        for t in range(len(self.moves[robot]), until):
            self.held[robot].append(self._holds(robot, t))
            self.moves[robot].append(_Move(self.at[robot], self.at[robot], None))

    def _earliest(self, leg: _Leg, begin: int) -> list[int]:
        """Index along the leg at every instant from `begin` to its arrival: A* over (time, index), waiting allowed."""
        m, last = leg.length, max(self.end, begin)
        others = [r for r in self.names if r not in leg.path]
        parent: dict[tuple[int, int], tuple[int, int] | None] = {(begin, 0): None}
        queue: list[tuple[int, int, int]] = [(begin + m, 0, begin)]
        while queue:
            _, minus_i, t = heapq.heappop(queue)
            i = -minus_i
            if i == m and self._may_stay(leg, others, t, last):
                times, back = [], parent[t, i]
                while back is not None:
                    times.append(back[1])
                    back = parent[back]
                return [*times[::-1], m]
            for j in (i + 1, i) if i < m else (i,):
                state = (t + 1, j)
                # Once all others have come to rest there is nothing to wait for.
                if state in parent or (j == i and t >= last) or not self._step(leg, others, i, j, t):
                    continue
                parent[state] = (t, i)
                heapq.heappush(queue, (t + 1 + m - j, -j, t + 1))
        return [*([0] * (last - begin)), *range(m + 1)]

    def _step(self, leg: _Leg, others: Sequence[str], i: int, j: int, t: int) -> bool:
        return all(
            self._clear(r, _Move(path[i], path[j], leg.mode if i != j else None), leg.mode.held.get(r), t, others)
            for r, path in leg.path.items()
        )

    def _may_stay(self, leg: _Leg, others: Sequence[str], t: int, last: int) -> bool:
        m = leg.length
        return all(self._step(leg, others, m, m, s) for s in range(t, last))

    def happen(self, active: Sequence[str]) -> None:
        """Schedule the next event as early as its robots are there and the motions after it bear the new mode."""
        t = max([*self.events[-1:], *(self.free_from[r] for r in active)])
        end = self.end
        for r in active:
            self._wait(r, t)
        while t < end and not self._bears(active, t, end):
            for r in active:
                self._wait(r, t + 1)
            t += 1
        self.events.append(t)
        for r in active:
            self.free_from[r] = t

    def _bears(self, active: Sequence[str], t: int, end: int) -> bool:
        """Whether all that is scheduled from t to the end is free in the mode after an event at t."""
        self.events.append(t)
        try:
            return all(
                self._clear(r, self._move(r, s), self._holds(r, s), s, self.names[k + 1 :])
                for s in range(t, end)
                for k, r in enumerate(self.names)
            )
        finally:
            self.events.pop()

    def segments(self) -> list[Segment]:
        """The schedule as segments, one per mode."""
        end = self.end
        tables = self.clearance.tables
        for r in self.names:
            self._wait(r, end)
        rows = {r: [*(m.a for m in self.moves[r][:end]), self.at[r]] for r in self.names}
        q = {r: np.array([tables[r][i] for i in rows[r]]) for r in self.names}
        bounds = [0, *self.events, end]
        return [
            Segment(mode, {r: q[r][a : b + 1].copy() for r in self.names})
            for mode, a, b in zip(self.modes, bounds[:-1], bounds[1:], strict=True)
        ]


def coordinate(
    segments: Sequence[Segment],
    transitions: Sequence[Transition],
    collision: Collision,
    validity: Validity,
    step: float = STEP,
) -> list[Segment]:
    """The same motions and transitions, in the same order of transitions, at the earliest times.

    Parameters
    ----------
    step : resolution of the schedule (rad or m of joint motion).
    """
    clearance = _Clearance(collision, validity, list(segments[0].q))
    schedule = _Schedule(clearance, segments)
    for k, segment in enumerate(segments):
        for leg in _legs(segment, clearance, schedule.at, step):
            schedule.insert(leg)
        if k < len(transitions):
            schedule.happen(transitions[k].active)
    return schedule.segments()


def _legs(segment: Segment, clearance: _Clearance, at: Mapping[str, int], step: float) -> list[_Leg]:
    """Runs of steps in which the same robots move, cut into pieces of at most `step`."""
    deltas = {r: np.linalg.norm(np.diff(q, axis=0), axis=1) for r, q in segment.q.items()}
    movers = [tuple(r for r in deltas if deltas[r][k] > _EPS) for k in range(segment.length - 1)]
    legs: list[_Leg] = []
    now = dict(at)
    for robots, run in itertools.groupby(range(segment.length - 1), key=lambda k: movers[k]):
        if not robots:
            continue
        path = {r: [now[r]] for r in robots}
        for k in run:
            pieces = max(1, int(np.ceil(max(deltas[r][k] for r in robots) / step)))
            for j in range(1, pieces + 1):
                for r in robots:
                    a, b = segment.q[r][k], segment.q[r][k + 1]
                    path[r].append(clearance.row(r, b if j == pieces else a + (b - a) * (j / pieces)))
        now |= {r: rows[-1] for r, rows in path.items()}
        for r, rows in path.items():
            clearance.prepare(r, [*itertools.pairwise(rows), *zip(rows, rows, strict=True)])
        legs.append(_Leg(path, segment.mode))
    return legs
