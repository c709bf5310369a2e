"""Space-time of prioritised planning: whole sequences of one robot are fitted in around what is scheduled already.

A course is a path of one robot with the changes of mode it makes on the way.  It keeps its path; when it moves and
when it waits is found by A* over time and progress, so that it ends as early as it can.  What was scheduled before
never changes.
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

State = tuple[int, int]
"""Time, and progress along a course."""
_State = tuple[list[Move], int, int, Mode]
"""Moves of a robot, where it stands in the end, when that is, and the mode in which it may stand there."""


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


@dataclass(frozen=True)
class Scheduled:
    """An action and when it happens."""

    time: int
    number: int
    action: Action


class Timeline:
    """Timed moves of all robots, and the actions among them; one step is one unit of time.

    Attributes
    ----------
    at : robot -> row of its table where it stands in the end.
    free_from : robot -> when its last course ends.
    actions : what happens, in the order in which it was scheduled.
    """

    def __init__(self, clearance: Clearances, start: Mapping[str, np.ndarray], root: Mode) -> None:
        self.clearance = clearance
        self.names = list(start)
        self.root = root
        self.at = {r: clearance.row(r, q) for r, q in start.items()}
        self.free_from = dict.fromkeys(self.names, 0)
        self.actions: list[Scheduled] = []
        self._moves: dict[str, list[Move]] = {r: [] for r in self.names}
        self._stands_in = dict.fromkeys(self.names, root)
        self._modes: dict[tuple[int, ...], Mode] = {(): root}
        self.blame: dict[str, int] = {}
        self._retreats: dict[str, tuple[_State, tuple[Piece, ...]]] = {}

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
        return self._mode(parked[0][2] if parked is not None else self.free_from[robot])

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
            later = self._state(robot)
            self._restore(robot, parked[0])
            times = self._fit(robot, course, retreat)
            if times is not None:
                return times
            self._restore(robot, later)
            course = [*(Piece(p.b, p.a, p.mode) for p in reversed(parked[1])), *course]
        return self._fit(robot, course, retreat)

    def _fit(self, robot: str, course: Sequence[Piece], retreat: Sequence[Piece]) -> list[int] | None:
        if not retreat:
            return self._schedule(robot, course)
        before = self._state(robot), len(self.actions)
        times = self._schedule(robot, [*course, *retreat])
        if times is None:
            return self._schedule(robot, course)
        # The same moves once more, without the retreat: that is where the next course may begin.
        moves, rest = self._moves[robot], len(retreat)
        n = len(moves)
        while rest and n > len(before[0][0]):
            n -= 1
            rest -= moves[n].a != moves[n].b
        last = course[-1].b if course else before[0][1]
        stands = course[-1].mode if course else before[0][3]
        self._retreats[robot] = ((moves[:n], last, n, stands), tuple(retreat))
        return times

    def _state(self, robot: str) -> _State:
        return list(self._moves[robot]), self.at[robot], self.free_from[robot], self._stands_in[robot]

    def _restore(self, robot: str, state: _State) -> None:
        self._moves[robot], self.at[robot], self.free_from[robot], self._stands_in[robot] = state
        self._moves[robot] = list(self._moves[robot])

    def _schedule(self, robot: str, course: Sequence[Piece]) -> list[int] | None:
        if not course:
            return []
        begin, last = self.free_from[robot], max(self.end, *(p.earliest for p in course))
        others = [r for r in self.names if r != robot]
        marks = [k for k, p in enumerate(course) if p.action is not None]
        first = len(self.actions)
        self.blame = {}
        moves_left = [*np.cumsum([p.action is None for p in reversed(course)])[::-1].tolist(), 0]
        parent: dict[State, State | None] = {(begin, 0): None}
        # Times of the own actions on the way to a state, all that the mode depends on beside the time.
        acted: dict[State, tuple[int, ...]] = {(begin, 0): ()}
        queue: list[tuple[int, int, int]] = [(begin + moves_left[0], 0, begin)]

        def own(state: State) -> list[Scheduled]:
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
            following: list[State] = []
            if i < len(course) and course[i].action is not None:
                if t >= course[i].earliest and self._bears(robot, course[i], t, [*done, self._next(course, done, t)]):
                    following.append((t, i + 1))
            elif i < len(course) and self._clear(robot, course[i], t, done, others):
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
        action = [p.action for p in course if p.action is not None][len(done)]
        return Scheduled(t, len(self.actions) + len(done), action)

    @staticmethod
    def _wait(course: Sequence[Piece], i: int) -> Piece:
        piece = course[min(i, len(course) - 1)]
        row = piece.a if i < len(course) else piece.b
        # At a change of mode one may stand before it as the piece before says, afterwards as the next one does.
        mode = course[i - 1].mode if i > 0 else piece.mode
        return Piece(row, row, mode)

    def _clear(self, robot: str, piece: Piece, t: int, done: Sequence[Scheduled], others: Sequence[str]) -> bool:
        mode = self._mode(t, done)
        held = mode.held.get(robot)
        move = Move(piece.a, piece.b, piece.mode)
        if not self.clearance.among(robot, move, held, mode):
            self._note("world")
            return False
        for o in others:
            if not self.clearance.apart(robot, move, held, o, self._move(o, t), self._held(o, t)):
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
        return self._all_clear(t, done, [robot], {robot: Piece(piece.b, piece.b, self._mode(t, done))})

    def _all_clear(self, t: int, done: Sequence[Scheduled], active: Sequence[str], stand: Mapping[str, Piece]) -> bool:
        """Whether all others keep clear, from t on, of resting objects, and at t of what the active robots hold."""
        now = self._mode(t, done)
        for r, piece in stand.items():
            if not all(
                self.clearance.apart(
                    r, Move(piece.a, piece.a, piece.mode), now.held.get(r), o, self._move(o, t), self._held(o, t)
                )
                for o in self.names
                if o not in active
            ):
                return False
        for s in range(t, max(self.end, t) + 1):
            mode = self._mode(s, done)
            for o in self.names:
                if o not in active and not self.clearance.among(o, self._move(o, s), self._held(o, s), mode):
                    self._note(o)
                    return False
        return True

    def _commit(
        self,
        robot: str,
        course: Sequence[Piece],
        state: State,
        parent: Mapping[State, State | None],
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
                piece = course[i] if j > i else self._wait(course, i)
                moves.append(Move(piece.a, piece.b, piece.mode))
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
            stand = {r: Piece(self.at[r], self.at[r], mode) for r in robots}
            if not self._all_clear(u, done, robots, stand):
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
        tables = self.clearance.tables
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
