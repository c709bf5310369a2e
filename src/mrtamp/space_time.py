"""Motions of several robots in space and time: timed moves along given paths, inserted one after another.

One step of time is one move of every robot, of at most `STEP`.  Legs (paths without times) and changes of mode go in,
segments come out.  A leg is inserted at the earliest timing along its path that keeps clear of the others' timed moves,
of their standing where they stopped, and of objects as they lie at that moment (DESIGN section 9, insertion).
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mrtamp.bounding import Balls
from mrtamp.check_report import Report, Violation
from mrtamp.collision import RESOLUTION, Collision, Posed, bisection_order
from mrtamp.modes import Attachment, Mode
from mrtamp.plan import Segment
from mrtamp.validity import Validity

STEP = 0.3
"""Longest motion (rad or m) of a robot in one step of time."""
_NEAR = 0.012
"""Clearance (m) of bounding spheres below which Drake is asked."""


@dataclass(frozen=True, eq=False)
class Leg:
    """Robots that move together through rows of their tables, free of the world and of objects as in `mode`.

    `path` maps each of them to m + 1 row numbers.
    """

    path: Mapping[str, list[int]]
    mode: Mode

    @property
    def robots(self) -> tuple[str, ...]:
        """Who moves."""
        return tuple(self.path)

    @property
    def length(self) -> int:
        """Number of moves m."""
        return len(next(iter(self.path.values()))) - 1


@dataclass(frozen=True, eq=False)
class Move:
    """What one robot does in one step: from row `a` to row `b` of its table; free among objects as in `mode`."""

    a: int
    b: int
    mode: Mode


class Blamed(NamedTuple):
    """A move with which a robot, with its load, hits `obstacle` in `mode`: an object at rest, the world or itself."""

    robot: str
    move: Move
    mode: Mode
    obstacle: str


class _Sampled(NamedTuple):
    """Centres (3, K, 3) of the beads and the grasp frame G at both ends and the middle of a move.

    No tracked point's way is longer than `travel` (m).
    """

    beads: np.ndarray
    R_WG: np.ndarray
    p_WG: np.ndarray
    travel: float


class Clearances:
    """Tables of configurations, and cached answers about moves between their rows.

    The questions: robots against each other, and robots against objects that were elsewhere when their moves were
    checked.  Answers hold whatever else is scheduled, so that schedules may share them.

    Attributes
    ----------
    tables : robot -> configurations (n,), which only become more: see `row`.
    """

    def __init__(self, collision: Collision, validity: Validity, names: Sequence[str]) -> None:
        self.collision = collision
        self.validity = validity
        self.worlds = {r: collision.worlds[r] for r in names}
        self.tables: dict[str, list[np.ndarray]] = {r: [] for r in names}
        self._pairs: dict[tuple, bool] = {}
        self._objects: dict[tuple, bool] = {}
        self._sampled: dict[tuple[str, int, int], _Sampled] = {}
        self._samples: dict[tuple, tuple[np.ndarray, Posed]] = {}
        self._balls: dict[tuple, Balls] = {}

    @property
    def size(self) -> int:
        """Number of cached answers and samples."""
        return len(self._pairs) + len(self._objects) + len(self._samples) + len(self._balls) + len(self._sampled)

    def row(self, robot: str, q: np.ndarray) -> int:
        """Put a configuration (n,) into a robot's table; the number of its row."""
        self.tables[robot].append(q)
        return len(self.tables[robot]) - 1

    def prepare(self, robot: str, moves: Sequence[tuple[int, int]]) -> None:
        """Sample moves (pairs of rows) at their ends and middles, all at once.

        Nothing has to be prepared, but many moves at once take far less time than each when it is asked about.
        """
        world = self.worlds[robot]
        table = self.tables[robot]
        fresh = [m for m in dict.fromkeys(moves) if (robot, *m) not in self._sampled]
        if not fresh:
            return
        q = np.array([[table[a], (table[a] + table[b]) / 2, table[b]] for a, b in fresh])
        flat = q.reshape(-1, q.shape[2])
        Rs, ps, _ = world.chain.sweep(flat)
        beads, spheres = (x.placed(Rs, ps).reshape(len(fresh), 3, -1, 3) for x in (world.beads, world.bounds))
        R_WG, p_WG = (x.reshape(len(fresh), 3, *x.shape[1:]) for x in world.tool.carried(Rs, ps))
        # Many are kept: single precision will do.
        beads = beads.astype(np.float32)
        tracked = np.concatenate([spheres, p_WG[:, :, None]], axis=2)
        # Points move neither evenly nor straight: twice the faster half, and a tenth more.
        travel = 2.2 * np.linalg.norm(np.diff(tracked, axis=1), axis=3).max(axis=(1, 2))
        for k, (a, b) in enumerate(fresh):
            self._sampled[robot, a, b] = _Sampled(beads[k], R_WG[k], p_WG[k], float(travel[k]))

    def _sample(self, robot: str, a: int, b: int) -> _Sampled:
        if (robot, a, b) not in self._sampled:
            self.prepare(robot, [(a, b)])
        return self._sampled[robot, a, b]

    def _ball(self, robot: str, a: int, b: int, held: Attachment | None) -> Balls:
        """Balls (K,) that hold every bead, and the load, all through a move."""
        key = (robot, a, b, held)
        if key not in self._balls:
            world = self.worlds[robot]
            centres, R_WG, p_WG, _ = self._sample(robot, a, b)
            radii = world.beads.radii
            if held is not None:
                # What a hand holds has the grasp frame G for its parent P.
                load = (p_WG + R_WG @ held.X_PO[:3, 3]).astype(np.float32)
                centres = np.concatenate([centres, load[:, None]], axis=1)
                radii = np.append(radii, world.object_radius[held.object])
            middle = (centres.min(axis=0) + centres.max(axis=0)) / 2
            self._balls[key] = Balls(middle, radii + np.linalg.norm(centres - middle, axis=2).max(axis=0))
        return self._balls[key]

    def _density(self, robots: Sequence[tuple[str, Move]]) -> int:
        """How many samples of a step keep every tracked point within the resolution from one to the next."""
        travel = max(self._sample(robot, move.a, move.b).travel for robot, move in robots)
        return max(2, int(np.ceil(travel / RESOLUTION)) + 1)

    def apart(self, one: str, a: Move, held_a: Attachment | None, two: str, b: Move, held_b: Attachment | None) -> bool:
        """Whether two robots, with what they hold, keep clear of each other in one step."""
        if one > two:
            one, a, held_a, two, b, held_b = two, b, held_b, one, a, held_a
        key = _pair_key(one, a, held_a, two, b, held_b)
        known = self._pairs.get(key)
        if known is None:
            known = self._pairs[key] = self._apart(one, a, held_a, two, b, held_b)
        return known

    def forbid(self, moves: Mapping[str, tuple[Move, Attachment | None]]) -> None:
        """Two robots, with what they hold, do not keep clear of each other in one step, whatever samples say."""
        (one, (a, held_a)), (two, (b, held_b)) = sorted(moves.items())
        self._pairs[_pair_key(one, a, held_a, two, b, held_b)] = False

    def _apart(
        self, one: str, a: Move, held_a: Attachment | None, two: str, b: Move, held_b: Attachment | None
    ) -> bool:
        if not self._ball(one, a.a, a.b, held_a).near(self._ball(two, b.a, b.b, held_b), _NEAR):
            return True
        n = self._density([(one, a), (two, b)]) if (a.a, b.a) != (a.b, b.b) else 1
        qa, posed_a = self._along(one, a, held_a, n)
        qb, posed_b = self._along(two, b, held_b, n)
        ends = np.arange(n)[bisection_order(n)] % max(n - 1, 1) == 0
        hit = self.collision.first_hit(one, qa, held_a, two, qb, held_b, exact=ends, posed=(posed_a, posed_b))
        return hit < 0

    def _along(self, robot: str, move: Move, held: Attachment | None, n: int) -> tuple[np.ndarray, Posed]:
        """Samples (n, dof) of a move in bisection order, and the robot there: one pose will do where it stands."""
        stands = move.a == move.b
        key = (robot, move.a, move.b, held, 1 if stands else n)
        known = self._samples.get(key)
        if known is None:
            t = np.linspace(0, 1, key[-1])[bisection_order(key[-1])][:, None]
            q = (1 - t) * self.tables[robot][move.a] + t * self.tables[robot][move.b]
            known = (q, self.worlds[robot].posed(q, held))
            self._samples[key] = known
        q, posed = known
        if not stands or n == 1:
            return known
        loads = None if posed.loads is None else np.broadcast_to(posed.loads, (n, posed.loads.shape[1]))
        return np.broadcast_to(q, (n, q.shape[1])), Posed(posed.balls, loads)

    def among(self, robot: str, move: Move, held: Attachment | None, mode: Mode) -> bool:
        """Whether a move keeps clear of the objects that rest in `mode` but not in the mode it was checked in."""
        if move.mode is mode:
            return True
        known = {r.chain for r in self.validity.resting(move.mode)}
        return all(
            self._misses(robot, move, held, r.name, r.chain, r.X_WO)
            for r in self.validity.resting(mode)
            if r.chain not in known
        )

    def _misses(
        self, robot: str, move: Move, held: Attachment | None, item: str, chain: tuple, X_WO: np.ndarray
    ) -> bool:
        if held is not None and held.object == item:
            return True
        key = (robot, move.a, move.b, held, chain)
        known = self._objects.get(key)
        if known is None:
            balls = self._ball(robot, move.a, move.b, held)
            world = self.worlds[robot]
            gap = np.linalg.norm(balls.centres - X_WO[:3, 3], axis=1) - balls.radii - world.object_radius[item]
            known = bool(gap.min() > _NEAR)
            if not known:
                n = self._density([(robot, move)]) if move.a != move.b else 1
                t = np.linspace(0, 1, n)[:, None]
                q = (1 - t) * self.tables[robot][move.a] + t * self.tables[robot][move.b]
                known = world.first_hit(world.rows(q, held, {item: X_WO})) < 0
            self._objects[key] = known
        return known


def _pair_key(one: str, a: Move, held_a: Attachment | None, two: str, b: Move, held_b: Attachment | None) -> tuple:
    return (one, a.a, a.b, held_a, two, b.a, b.b, held_b)


class SpaceTime:
    """Timed moves of all robots, grown leg by leg and event by event; one step is one unit of time.

    Attributes
    ----------
    modes : one after another; each event is a change to the next one, so one more mode has to be there than events.
    events : when the mode changes, in order.
    moves, held : robot -> what it does, and holds, in each step until its last leg ends; later it stands.
    at : robot -> row of its table where it stands in the end.
    free_from : robot -> when its last leg or event is over, so that another one may begin.
    alone : whether each robot is scheduled as if there were no other.
    """

    def __init__(
        self, clearances: Clearances, start: Mapping[str, np.ndarray], modes: Sequence[Mode], *, alone: bool = False
    ) -> None:
        self.clearances = clearances
        self.alone = alone
        self.modes = list(modes)
        self.names = list(start)
        self.moves: dict[str, list[Move]] = {r: [] for r in self.names}
        self.held: dict[str, list[Attachment | None]] = {r: [] for r in self.names}
        self.at: dict[str, int] = {r: clearances.row(r, q) for r, q in start.items()}
        self._stands_in: dict[str, Mode] = dict.fromkeys(self.names, self.modes[0])
        self.free_from = dict.fromkeys(self.names, 0)
        self.events: list[int] = []

    def copy(self) -> SpaceTime:
        """A schedule to try things on; tables and answers are shared."""
        other = object.__new__(SpaceTime)
        other.clearances, other.alone, other.names = self.clearances, self.alone, self.names
        other.modes, other.events = list(self.modes), list(self.events)
        other.moves = {r: list(x) for r, x in self.moves.items()}
        other.held = {r: list(x) for r, x in self.held.items()}
        other.at, other.free_from = dict(self.at), dict(self.free_from)
        other._stands_in = dict(self._stands_in)
        return other

    @property
    def end(self) -> int:
        """When everything scheduled so far is over."""
        return max([*self.free_from.values(), *self.events[-1:]])

    def _mode(self, t: int) -> Mode:
        """The mode of the step from t to t + 1."""
        return self.modes[sum(e <= t for e in self.events)]

    def _move(self, robot: str, t: int) -> Move:
        moves = self.moves[robot]
        return moves[t] if t < len(moves) else self.standing(robot)

    def standing(self, robot: str) -> Move:
        """A robot's waiting where its last leg ended."""
        return Move(self.at[robot], self.at[robot], self._stands_in[robot])

    def _holds(self, robot: str, t: int) -> Attachment | None:
        held = self.held[robot]
        return held[t] if t < len(held) else self._mode(t).held.get(robot)

    def _apart(
        self, one: str, a: Move, held_a: Attachment | None, two: str, b: Move, held_b: Attachment | None
    ) -> bool:
        """Whether two robots do not get in each other's way, which nobody does where each is scheduled alone."""
        return self.alone or self.clearances.apart(one, a, held_a, two, b, held_b)

    def _clear(self, robot: str, move: Move, held: Attachment | None, t: int, others: Sequence[str]) -> bool:
        """Whether a move in the step from t to t + 1 keeps clear of objects and of what the others do then."""
        return self.clearances.among(robot, move, held, self._mode(t)) and all(
            self._apart(robot, move, held, o, self._move(o, t), self._holds(o, t)) for o in others
        )

    def insert(self, leg: Leg, *, certain: bool = False) -> bool:
        """Schedule a leg as early as it can end; False if that is never.

        `certain`: it is known to be free once everything scheduled so far is over.
        """
        begin = max(self.free_from[r] for r in leg.robots)
        times = self._earliest(leg, begin)
        if times is None:
            if not certain:
                return False
            times = [*([0] * (max(self.end, begin) - begin)), *range(leg.length + 1)]
        for r in leg.robots:
            self._wait(r, begin)
            path = leg.path[r]
            for i, j in itertools.pairwise(times):
                self.moves[r].append(Move(path[i], path[j], leg.mode))
                self.held[r].append(leg.mode.held.get(r))
            self.at[r], self._stands_in[r] = path[-1], leg.mode
            self.free_from[r] = begin + len(times) - 1
        return True

    def _wait(self, robot: str, until: int) -> None:
        for t in range(len(self.moves[robot]), until):
            self.held[robot].append(self._holds(robot, t))
            self.moves[robot].append(self.standing(robot))

    def _earliest(self, leg: Leg, begin: int) -> list[int] | None:
        """Index along the leg at every instant from `begin` to its arrival: A* over (time, index), waiting allowed."""
        m, last = leg.length, max(self.end, begin)
        others = [r for r in self.names if r not in leg.path]
        if self.in_the_way(leg, [o for o in others if self.free_from[o] <= begin]):
            # They stand there all the time.
            return None
        if not self._step(leg, others, m, m, last):
            # Where it ends it would be in the way of who comes to rest.
            return None
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
        return None

    def _step(self, leg: Leg, others: Sequence[str], i: int, j: int, t: int) -> bool:
        return all(
            self._clear(r, Move(path[i], path[j], leg.mode), leg.mode.held.get(r), t, others)
            for r, path in leg.path.items()
        )

    def _may_stay(self, leg: Leg, others: Sequence[str], t: int, last: int) -> bool:
        m = leg.length
        return all(self._step(leg, others, m, m, s) for s in range(t, last))

    def in_the_way(self, leg: Leg, among: Sequence[str] | None = None) -> list[str]:
        """Robots (of `among`, default all) that block a leg from where they stand in the end."""
        return [
            o
            for o in (self.names if among is None else among)
            if o not in leg.path
            and not all(
                self._apart(
                    r,
                    Move(path[i], path[min(i + 1, leg.length)], leg.mode),
                    leg.mode.held.get(r),
                    o,
                    self.standing(o),
                    self._holds(o, self.end),
                )
                for r, path in leg.path.items()
                for i in range(leg.length + 1)
            )
        ]

    def happen(self, active: Sequence[str], *, certain: bool = False) -> bool:
        """Schedule the next event as early as its robots are there and all motions bear the new mode; False if never.

        `certain`: it is known to be possible once everything scheduled so far is over.
        """
        t = max([*self.events[-1:], *(self.free_from[r] for r in active)])
        end = max(self.end, t)
        while t <= end and not self._bears(active, t, end):
            t += 1
        if t > end:
            if not certain:
                return False
            t = end
        for r in active:
            self._wait(r, t)
        self.events.append(t)
        for r in active:
            self.free_from[r] = t
            self._stands_in[r] = self.modes[len(self.events)]
        return True

    def _bears(self, active: Sequence[str], t: int, end: int) -> bool:
        """Whether all that is scheduled from t to the end is free in the mode after an event at t."""
        self.events.append(t)
        try:
            after = self.modes[len(self.events)]
            for s in range(t, max(end, t + 1)):
                moves = {r: self._move(r, s) for r in self.names}
                for r in active:
                    moves[r] = Move(moves[r].a, moves[r].b, after)
                held = {r: after.held.get(r) if r in active else self._holds(r, s) for r in self.names}
                for k, r in enumerate(self.names):
                    if not self.clearances.among(r, moves[r], held[r], after):
                        return False
                    if not all(self._apart(r, moves[r], held[r], o, moves[o], held[o]) for o in self.names[k + 1 :]):
                        return False
            return True
        finally:
            self.events.pop()

    def forbid(self, report: Report) -> tuple[bool, list[Blamed]]:
        """Learn where the judge found robots in each other's way, or in that of things that lie about.

        Returns
        -------
        Whether moves will be seen otherwise from now on, and the moves that were bad whatever the other robots did.
        Where collisions of several robots with the world are reported of one step, it may be their sum that is not
        tolerated: then they do not happen at the same time again.
        """
        bounds = [0, *self.events]
        steps: dict[int, list[Violation]] = {}
        for v in report.violations:
            if v.kind == "collision" and v.segment is not None and v.step is not None:
                steps.setdefault(bounds[v.segment] + v.step, []).append(v)
        learnt, alone = False, list[Blamed]()
        for t, violations in steps.items():
            mode = self._mode(t)
            held = {r: self._holds(r, t) for r in self.names}
            carriers = {a.object: r for r, a in held.items() if a is not None}
            found = [v.guilty(carriers, self.names) for v in violations]
            pairs = {robots for robots, _ in found if len(robots) == 2}
            depths: dict[str, float] = {}
            for v, (robots, _) in zip(violations, found, strict=True):
                if len(robots) == 1:
                    depths[robots[0]] = depths.get(robots[0], 0.0) + (v.value or 0.0)
            if len(depths) > 1:
                one, two, *_ = sorted(depths, key=lambda r: -depths[r])
                pairs.add((one, two))
            for pair in pairs:
                self.clearances.forbid({r: (self._move(r, t), held[r]) for r in pair})
                learnt = True
            if not pairs:
                for robots, obstacle in found:
                    if robots and obstacle is not None:
                        alone.append(Blamed(robots[0], self._move(robots[0], t), mode, obstacle))
        return learnt, alone

    def segments(self) -> list[Segment]:
        """The schedule as segments, one per mode."""
        end = self.end
        tables = self.clearances.tables
        for r in self.names:
            self._wait(r, end)
        rows = {r: [*(m.a for m in self.moves[r][:end]), self.at[r]] for r in self.names}
        q = {r: np.array([tables[r][i] for i in rows[r]]) for r in self.names}
        bounds = [0, *self.events, end]
        return [
            Segment(mode, {r: q[r][a : b + 1].copy() for r in self.names})
            for mode, a, b in zip(self.modes, bounds[:-1], bounds[1:], strict=True)
        ]
