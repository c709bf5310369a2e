"""Space-time of prioritised planning: whole sequences of one robot are fitted in around what is scheduled already.

A course is a path of one robot with the changes of mode it makes on the way.  It keeps its path; when it moves and
when it waits is found by A* over time and progress, so that it ends as early as it can.  What was scheduled before
never changes, but for a robot's own retreats.  Courses go in, segments and transitions come out.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mrtamp.modes import Attachment, Mode
from mrtamp.plan import Action, Segment, Transition
from mrtamp.space_time import Clearances, Move

_Instant = tuple[int, int]
"""Time, and how many pieces of a course are over then."""


@dataclass(frozen=True, eq=False)
class Piece:
    """One unit of a course: a move from row `a` to `b` that is free in `mode`, or, with an action, a change of mode.

    The change happens not before the time `earliest`.
    """

    a: int
    b: int
    mode: Mode
    action: Action | None = None
    earliest: int = 0

    @property
    def move(self) -> Move:
        """What the robot does."""
        return Move(self.a, self.b, self.mode)


@dataclass(frozen=True)
class Scheduled:
    """An action and when it happens; of actions at the same time, lower numbers come first."""

    time: int
    number: int
    action: Action


@dataclass(frozen=True, eq=False)
class _Stretch:
    """What is scheduled of one robot: its moves, and the row, the time and the mode in which it stands afterwards."""

    moves: tuple[Move, ...]
    at: int
    free_from: int
    stands_in: Mode


class Timeline:
    """Timed moves of all robots, and the actions among them; one step is one unit of time.

    Attributes
    ----------
    at : robot -> row of its table where it stands in the end.
    free_from : robot -> when its last course ends.
    actions : what happens, in the order in which it was scheduled.
    blame : "world" or robot -> how often it was in the way when a course was last fitted in.
    """

    def __init__(self, clearances: Clearances, start: Mapping[str, np.ndarray], root: Mode) -> None:
        self.clearances = clearances
        self.names = list(start)
        self.root = root
        self.at = {r: clearances.row(r, q) for r, q in start.items()}
        self.free_from = dict.fromkeys(self.names, 0)
        self.actions: list[Scheduled] = []
        self._moves: dict[str, list[Move]] = {r: [] for r in self.names}
        self._stands_in = dict.fromkeys(self.names, root)
        self._modes: dict[tuple[int, ...], Mode] = {(): root}
        self.blame: dict[str, int] = {}
        # Robots that have retreated: what had been scheduled of them before, and the way they went.
        self._retreats: dict[str, tuple[_Stretch, tuple[Piece, ...]]] = {}

    @property
    def end(self) -> int:
        """When everything scheduled so far is over."""
        return max([*self.free_from.values(), *(a.time for a in self.actions)])

    @property
    def mode(self) -> Mode:
        """The mode after everything scheduled so far."""
        return self._mode(self.end)

    def present(self, robot: str) -> Mode:
        """The mode when the next course of a robot may begin."""
        parked = self._retreats.get(robot)
        return self._mode(parked[0].free_from if parked is not None else self.free_from[robot])

    def _mode(self, t: int, own: Sequence[Scheduled] = ()) -> Mode:
        """The mode from time t on; `own` are actions that are not scheduled yet."""
        happened = sorted((a for a in (*self.actions, *own) if a.time <= t), key=lambda a: (a.time, a.number))
        key = tuple(a.number for a in happened)
        found = self._modes.get(key)
        if found is None:
            found = self.root
            for a in happened:
                found = found.after(Transition((a.action,)))
            self._modes[key] = found
        return found

    def _move(self, robot: str, t: int) -> Move:
        moves = self._moves[robot]
        return moves[t] if t < len(moves) else Move(self.at[robot], self.at[robot], self._stands_in[robot])

    def _held(self, robot: str, t: int) -> Attachment | None:
        return self._mode(t).held.get(robot)

    # -- courses --------------------------------------------------------------------------------------------------

    def insert(self, robot: str, course: Sequence[Piece], retreat: Sequence[Piece] = ()) -> list[int] | None:
        """Schedule a course of a robot; when its actions happen, or None if it cannot be fitted in.

        A robot may have to get out of the way afterwards: `retreat` comes after the course if that fits in, and the
        next course begins before it again, if that does.
        """
        parked = self._retreats.pop(robot, None)
        if parked is not None:
            before, aside = parked
            after = self._stretch(robot)
            self._restore(robot, before)
            times = self._fit(robot, course, retreat)
            if times is not None:
                return times
            self._restore(robot, after)
            course = [*(Piece(p.b, p.a, p.mode) for p in reversed(aside)), *course]
        return self._fit(robot, course, retreat)

    def _fit(self, robot: str, course: Sequence[Piece], retreat: Sequence[Piece]) -> list[int] | None:
        if not retreat:
            return self._schedule(robot, course)
        before = self._stretch(robot)
        times = self._schedule(robot, [*course, *retreat])
        if times is None:
            return self._schedule(robot, course)
        # The same moves once more, without the retreat: that is where the next course may begin.
        moves, rest = self._moves[robot], len(retreat)
        n = len(moves)
        while rest and n > len(before.moves):
            n -= 1
            rest -= moves[n].a != moves[n].b
        last = course[-1].b if course else before.at
        stands = course[-1].mode if course else before.stands_in
        self._retreats[robot] = (_Stretch(tuple(moves[:n]), last, n, stands), tuple(retreat))
        return times

    def _stretch(self, robot: str) -> _Stretch:
        """All that is scheduled of a robot so far, for `_restore`."""
        return _Stretch(tuple(self._moves[robot]), self.at[robot], self.free_from[robot], self._stands_in[robot])

    def _restore(self, robot: str, was: _Stretch) -> None:
        self._moves[robot], self.at[robot] = list(was.moves), was.at
        self.free_from[robot], self._stands_in[robot] = was.free_from, was.stands_in

    def _schedule(self, robot: str, course: Sequence[Piece]) -> list[int] | None:
        """Fit in a course so that it ends as early as it can; when its actions happen, or None."""
        if not course:
            return []
        begin, last = self.free_from[robot], max(self.end, *(p.earliest for p in course))
        others = [r for r in self.names if r != robot]
        marks = [k for k, p in enumerate(course) if p.action is not None]
        first = len(self.actions)
        self.blame = {}
        moves_left = [*np.cumsum([p.action is None for p in reversed(course)])[::-1].tolist(), 0]
        parent: dict[_Instant, _Instant | None] = {(begin, 0): None}
        # Times of the own actions on the way to a state, all that the mode depends on beside the time.
        acted: dict[_Instant, tuple[int, ...]] = {(begin, 0): ()}
        queue: list[tuple[int, int, int]] = [(begin + moves_left[0], 0, begin)]

        def own(state: _Instant) -> list[Scheduled]:
            out: list[Scheduled] = []
            for k, t in zip(marks, acted[state], strict=False):
                action = course[k].action
                assert action is not None
                out.append(Scheduled(t, first + len(out), action))
            return out

        while queue:
            _, minus_i, t = heapq.heappop(queue)
            i, state = -minus_i, (t, -minus_i)
            done = own(state)
            if i == len(course) and self._may_stay(robot, course, t, last, done, others):
                return self._commit(robot, course, state, parent, done, begin)
            following: list[_Instant] = []
            if i < len(course) and course[i].action is not None:
                if t >= course[i].earliest and self._bears(robot, course[i], t, [*done, self._next(course, done, t)]):
                    following.append((t, i + 1))
            elif i < len(course) and self._clear(robot, course[i].move, t, done, others):
                following.append((t + 1, i + 1))
            if t < last and self._clear(robot, self._wait(course, i), t, done, others):
                following.append((t + 1, i))
            for new in following:
                if new not in parent:
                    parent[new] = state
                    acted[new] = (*acted[state], t) if new[0] == t else acted[state]
                    heapq.heappush(queue, (new[0] + moves_left[new[1]], -new[1], new[0]))
        return None

    def _next(self, course: Sequence[Piece], done: Sequence[Scheduled], t: int) -> Scheduled:
        """The first action of a course that is not done, at time t."""
        action = [p.action for p in course if p.action is not None][len(done)]
        return Scheduled(t, len(self.actions) + len(done), action)

    @staticmethod
    def _wait(course: Sequence[Piece], i: int) -> Move:
        """Standing still when i pieces of a course are over."""
        piece = course[min(i, len(course) - 1)]
        row = piece.a if i < len(course) else piece.b
        # At a change of mode one may stand before it as the piece before says, afterwards as the next one does.
        mode = course[i - 1].mode if i > 0 else piece.mode
        return Move(row, row, mode)

    def _clear(self, robot: str, move: Move, t: int, done: Sequence[Scheduled], others: Sequence[str]) -> bool:
        """Whether a move in the step from t to t + 1, own actions `done`, keeps clear of objects and of others."""
        mode = self._mode(t, done)
        held = mode.held.get(robot)
        if not self.clearances.among(robot, move, held, mode):
            self._note("world")
            return False
        for o in others:
            if not self.clearances.apart(robot, move, held, o, self._move(o, t), self._held(o, t)):
                self._note(o)
                return False
        return True

    def _note(self, who: str) -> None:
        self.blame[who] = self.blame.get(who, 0) + 1

    def _may_stay(
        self,
        robot: str,
        course: Sequence[Piece],
        t: int,
        last: int,
        done: Sequence[Scheduled],
        others: Sequence[str],
    ) -> bool:
        stay = self._wait(course, len(course))
        return all(self._clear(robot, stay, s, done, others) for s in range(t, max(last, t) + 1))

    def _bears(self, robot: str, piece: Piece, t: int, done: Sequence[Scheduled]) -> bool:
        """Whether what the others do from t on keeps clear of where things are after a change of mode."""
        return self._all_clear(t, done, {robot: Move(piece.b, piece.b, self._mode(t, done))})

    def _all_clear(self, t: int, done: Sequence[Scheduled], active: Mapping[str, Move]) -> bool:
        """Whether all others keep clear, from t on, of resting objects, and at t of the active robots and their loads.

        `active` : robot -> its standing at t.
        """
        now = self._mode(t, done)
        for r, stand in active.items():
            if not all(
                self.clearances.apart(r, stand, now.held.get(r), o, self._move(o, t), self._held(o, t))
                for o in self.names
                if o not in active
            ):
                return False
        for s in range(t, max(self.end, t) + 1):
            mode = self._mode(s, done)
            for o in self.names:
                if o not in active and not self.clearances.among(o, self._move(o, s), self._held(o, s), mode):
                    self._note(o)
                    return False
        return True

    def _commit(
        self,
        robot: str,
        course: Sequence[Piece],
        state: _Instant,
        parent: Mapping[_Instant, _Instant | None],
        done: Sequence[Scheduled],
        begin: int,
    ) -> list[int]:
        way = [state]
        while (before := parent[way[-1]]) is not None:
            way.append(before)
        moves = self._moves[robot]
        moves += [self._move(robot, t) for t in range(len(moves), begin)]
        for (t, i), (u, j) in itertools.pairwise(way[::-1]):
            if u > t:
                moves.append(course[i].move if j > i else self._wait(course, i))
        self.at[robot] = course[-1].b
        self.actions += done
        self.free_from[robot] = state[0]
        self._stands_in[robot] = self._mode(state[0])
        return [a.time for a in done]

    def together(self, robots: Sequence[str], action: Action, earliest: int) -> int | None:
        """Schedule an action of several robots that stand where it happens; when it does, or None if it cannot.

        They stand there from the ends of their courses on.
        """
        t = max(earliest, *(self.free_from[r] for r in robots))
        for u in range(t, max(self.end, t) + 1):
            done = [Scheduled(u, len(self.actions), action)]
            mode = self._mode(u, done)
            if not self._all_clear(u, done, {r: Move(self.at[r], self.at[r], mode) for r in robots}):
                continue
            for r in robots:
                self._moves[r] += [self._move(r, s) for s in range(len(self._moves[r]), u)]
                self.free_from[r] = u
            self.actions += done
            for r in robots:
                self._stands_in[r] = mode
            return u
        return None

    def plan(self) -> tuple[list[Segment], list[Transition]]:
        """The schedule as segments and the transitions between them."""
        end = self.end
        happened = sorted(self.actions, key=lambda a: (a.time, a.number))
        tables = self.clearances.tables
        q = {r: np.array([tables[r][self._move(r, t).a] for t in range(end + 1)]) for r in self.names}
        for r in self.names:
            q[r][end] = tables[r][self.at[r]]
        bounds = [0, *(a.time for a in happened), end]
        modes, transitions = [self.root], [Transition((a.action,)) for a in happened]
        for transition in transitions:
            modes.append(modes[-1].after(transition))
        segments = [
            Segment(mode, {r: q[r][a : b + 1].copy() for r in self.names})
            for mode, (a, b) in zip(modes, itertools.pairwise(bounds), strict=True)
        ]
        return segments, transitions
