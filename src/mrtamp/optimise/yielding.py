"""Timing drafts: which robot is how far along its way when, with penetrations charged instead of forbidden.

Every robot keeps its way and the order of its own events; what is chosen is who goes first where ways cross.  One robot
after the other is timed against those before it by a cheapest path through their coordination space: how far along
these are by how far along it is, with the depth of penetration charged along the motion.
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import cdist

from mrtamp.modes import Attachment, Mode, object_poses, static_poses
from mrtamp.optimise.nearness import Near, Nearness, Samples, State
from mrtamp.plan import Segment, Transition
from mrtamp.problem import Problem
from mrtamp.refine import must_follow

_STEP, _PARTS = 0.3, 6
"""Distance (rad or m) along a way at which penetrations are measured, and steps of equal length from one to the next:
robots take them at the same time, which costs little only where they are about equally long."""
_SHARP = np.cos(np.deg2rad(30.0))
"""Cosine of the turn from which on a way is not cut short between steps."""
_CHARGE = (10.0, 300.0)
"""By how many times motion at a penetration of 1 m seems longer than it is: linear and quadratic in the depth."""
_EARLY = 0.3
"""By how much time counts more in the beginning than in the end where robots are to be early."""
_LASTING = 5.0
"""For how much further motion (rad or m) robots are to blame that collide in the end, since nobody leaves any more."""
_NEVER = 1e6
"""What it costs to do something too early."""


@dataclass(frozen=True, eq=False)
class Draft:
    """Motions that may still collide; `conflict` is the squared depth of penetration (m^2) along the motion (rad or m).

    What is grazed for long is easily pulled apart; robots that pass through each other are not.  `blame` has how much
    of it there is on the way to events, by their number among those that were to be timed, for all who are involved;
    robots that collide where they end have the more of it.
    """

    segments: list[Segment]
    transitions: list[Transition]
    conflict: float
    blame: Mapping[int, float]


@dataclass(frozen=True, eq=False)
class _Course:
    """The way of one robot.

    q : nodes (M, n); there are two for every event, one before and one after it.
    step : length (M,) of the step that leads to each node.
    stage : number (M,) of the robot's own events up to each node.
    held : what the robot holds after each number of events.
    done : event -> the first node after it.
    looked : numbers (C,) of the nodes at which penetrations are measured.
    state : its bodies and its load at those.
    """

    q: np.ndarray
    step: np.ndarray
    stage: np.ndarray
    held: list[Attachment | None]
    done: dict[int, int]
    looked: np.ndarray
    state: State

    def spread(self, depth: np.ndarray) -> np.ndarray:
        """Depths (M, ...) at all nodes, linear between those (C, ...) that were measured."""
        nodes = np.arange(len(self.q))
        low = np.searchsorted(self.looked, nodes, side="right") - 1
        high = np.minimum(low + 1, len(self.looked) - 1)
        part = (nodes - self.looked[low]) / np.maximum(self.looked[high] - self.looked[low], 1)
        part = part.reshape(-1, *[1] * (depth.ndim - 1))
        return (1 - part) * depth[low] + part * depth[high]

    def on_the_way_to(self, nodes: np.ndarray) -> np.ndarray:
        """The event (P,) that is next at nodes (P,), after the last of them that one; there has to be one."""
        events = np.array(list(self.done))
        return events[np.minimum(self.stage[nodes], len(events) - 1)]


@dataclass(frozen=True, eq=False)
class _Rest:
    """An object that rests at X_WO from event `since` (None: the start) until event `until` (None: the end)."""

    at: Attachment
    X_WO: np.ndarray
    since: int | None
    until: int | None


@dataclass(frozen=True, eq=False)
class _Depth:
    """Penetration (T, N) at instants of those who are timed already and nodes of the next; whose it is, or of an object
    that an event has put where it rests, or takes away."""

    depth: np.ndarray
    robots: tuple[str, ...]
    event: int | None = None


class _Situations:
    """Modes of which only a part matters, and where objects rest in them."""

    def __init__(self) -> None:
        self.modes: list[Mode] = []
        self._resting: dict[Mode, Mapping[str, np.ndarray]] = {}

    def add(self, attachments: Sequence[Attachment | None], resting: Mapping[str, np.ndarray]) -> None:
        mode = Mode(tuple(a for a in attachments if a is not None))
        self.modes.append(mode)
        self._resting[mode] = resting

    def resting(self, mode: Mode) -> Mapping[str, np.ndarray]:
        return self._resting[mode]


class Yielding:
    """Times drafts of one problem.

    Parameters
    ----------
    nearness : measures how deep solids of the problem's plants penetrate.
    """

    def __init__(self, problem: Problem, nearness: Nearness) -> None:
        self.problem = problem
        self.nearness = nearness
        # Poses of what is held are of no interest.
        nowhere = dict.fromkeys(nearness.worlds, np.eye(4))
        self._X_WP = {**static_poses(problem), **nowhere}
        self._radius = {o: r for w in nearness.worlds.values() for o, r in w.object_radius.items()}

    def time(self, segments: Sequence[Segment], transitions: Sequence[Transition], *, early: bool = False) -> Draft:
        """The same ways timed anew; events of different robots change places where nothing speaks against it.

        Where it hardly makes a difference to when all is over, robots that have to wait do so before they set out;
        `early`: as far along their ways as they can get.
        """
        courses = {r: self._course(r, segments, transitions) for r in segments[0].q}
        rests = self._rests([s.mode for s in segments])
        before = self._precedence(transitions, rests)
        names = sorted(courses, key=lambda r: -courses[r].step.sum())
        nodes = {names[0]: np.arange(len(courses[names[0]].q))}
        conflict = 0.0
        blame = defaultdict[int, float](float)
        for name in names[1:]:
            nodes, more = self._join(courses, nodes, name, rests, before, early, blame)
            conflict += more
        return Draft(*_timed(segments[0].mode, transitions, courses, nodes), conflict, blame)

    # -- ways and what stands in them -------------------------------------------------------------------------------

    def _course(self, robot: str, segments: Sequence[Segment], transitions: Sequence[Transition]) -> _Course:
        held, done = [segments[0].mode.held.get(robot)], {}
        legs: list[np.ndarray] = [segments[0].q[robot][:1]]
        stage, looked = [0], [0]
        way = [segments[0].q[robot]]
        for k in range(len(segments)):
            acts = k < len(transitions) and robot in transitions[k].active
            if k + 1 < len(segments) and not acts:
                way.append(segments[k + 1].q[robot][1:])
                continue
            for part, n in _divided(np.concatenate(way)):
                looked += range(len(stage) + _PARTS - 1, len(stage) + n * _PARTS, _PARTS)
                stage += n * _PARTS * [len(held) - 1]
                legs.append(part)
            if acts:
                done[k] = len(stage)
                held.append(segments[k + 1].mode.held.get(robot))
                way = [segments[k + 1].q[robot]]
                legs.append(way[0][:1])
                looked.append(len(stage))
                stage.append(len(held) - 1)
        nodes, stages, at = np.concatenate(legs), np.array(stage), np.array(looked)
        step = np.concatenate([[0.0], np.linalg.norm(np.diff(nodes, axis=0), axis=1)])
        samples = Samples(np.arange(len(at)), np.zeros(len(at)), stages[at])
        holding = _Situations()
        for a in held:
            holding.add([a], {})
        state = self.nearness.state(robot, nodes[at], samples, holding.modes)
        return _Course(nodes, step, stages, held, done, at, state)

    def _rests(self, modes: Sequence[Mode]) -> list[_Rest]:
        """Where objects rest that do not rest there all the time."""
        poses = [object_poses(mode, self._X_WP) for mode in modes]
        out = []
        for name in modes[0].of:
            runs = [list(run) for _, run in itertools.groupby(range(len(modes)), key=lambda k: modes[k].of[name])]
            if len(runs) == 1:
                continue
            for run in runs:
                a = modes[run[0]].of[name]
                if not a.held:
                    since = run[0] - 1 if run[0] else None
                    out.append(_Rest(a, poses[run[0]][name], since, run[-1] if run[-1] < len(modes) - 1 else None))
        return out

    def _precedence(self, transitions: Sequence[Transition], rests: Sequence[_Rest]) -> dict[int, set[int]]:
        """Event -> earlier ones that have to stay earlier: those it must follow, and those that make room for it."""
        after = {s.name: s.after for s in self.problem.subgoals}
        out: dict[int, set[int]] = {k: set() for k in range(len(transitions))}
        for j, k in itertools.combinations(range(len(transitions)), 2):
            pairs = itertools.product(transitions[j].actions, transitions[k].actions)
            if any(must_follow(a, b, after) for a, b in pairs):
                out[k].add(j)
        for x, y in itertools.permutations(rests, 2):
            if x.until is not None and y.since is not None and x.until < y.since:
                gap = np.linalg.norm(x.X_WO[:3, 3] - y.X_WO[:3, 3])
                if gap < self._radius[x.at.object] + self._radius[y.at.object]:
                    out[y.since].add(x.until)
        return out

    # -- coordination space -----------------------------------------------------------------------------------------

    def _join(
        self,
        courses: Mapping[str, _Course],
        nodes: Mapping[str, np.ndarray],
        robot: str,
        rests: Sequence[_Rest],
        before: Mapping[int, set[int]],
        early: bool,
        blame: defaultdict[int, float],
    ) -> tuple[dict[str, np.ndarray], float]:
        """Nodes (T',) of all robots at instants, and their conflict, once `robot` is timed against those in `nodes`;
        its share is added to the `blame` of events."""
        course = courses[robot]
        instants = len(next(iter(nodes.values())))
        done = {k: int(np.argmax(nodes[r] >= node)) for r in nodes for k, node in courses[r].done.items()}
        parts = list(self._depths_at_rests(courses, nodes, robot, rests, done))
        for other, at in nodes.items():
            measured = self._depths(other, courses[other], robot, course)
            parts.append(_Depth(course.spread(courses[other].spread(measured)[at].T).T, (other, robot)))
        depth = np.zeros((instants, len(course.q)))
        for part in parts:
            depth += part.depth
        never = np.zeros(depth.shape, dtype=bool)
        for k, node in course.done.items():
            for t in [done[j] for j in (*before[k], k) if j in done]:
                never[:t, node:] = True
        for k, t in done.items():
            for j in (*before[k], k):
                if j in course.done and (j == k or k not in course.done):
                    never[t:, : course.done[j]] = True
        step = np.zeros(instants)
        for r, at in nodes.items():
            step = np.maximum(step, np.where(np.diff(at, prepend=0) > 0, courses[r].step[at], 0.0))
        row, column, length = _cheapest(step, course.step, depth, never, _EARLY if early else 0.0)
        out = {**{r: at[row] for r, at in nodes.items()}, robot: column}
        conflict = 0.0
        for part in parts:
            share = length * depth[row, column] * part.depth[row, column]
            conflict += float(share.sum())
            if len(part.robots) == 2:
                share[-1] += _LASTING * part.depth[-1, -1] ** 2
            for k, much in _attributed(part, share, courses, out):
                blame[k] += much
        return out, conflict

    def _depths(self, one: str, a: _Course, two: str, b: _Course) -> np.ndarray:
        """Deepest penetration (C, D) of robots one and two where it is measured along their ways."""
        out = np.zeros((len(a.looked), len(b.looked)))
        U, N = _overlapping(a.state, b.state)
        if not len(U):
            return out
        states = a.state.of(U), b.state.of(N)
        situations = _Situations()
        for x, y in itertools.product(a.held, b.held):
            situations.add([x, y], {})
        of = a.stage[a.looked[U]] * len(b.held) + b.stage[b.looked[N]]
        samples = Samples(np.arange(len(U)), np.zeros(len(U)), of)
        near = self.nearness.between((one, two), states, samples, situations, 0.0)
        out[U, N] = _deepest(near, len(U))
        return out

    def _depths_at_rests(
        self,
        courses: Mapping[str, _Course],
        nodes: Mapping[str, np.ndarray],
        robot: str,
        rests: Sequence[_Rest],
        done: Mapping[int, int],
    ) -> Iterator[_Depth]:
        """Penetration of each robot and objects at rest, as far as it depends on when `robot` does what.

        `done` tells when the others' events happen.  What depends on robots that are timed later is charged then.
        """
        mine = courses[robot]
        instants = len(next(iter(nodes.values())))
        for name, rest in itertools.product([robot, *nodes], rests):
            course = courses[name]
            events = {k for k in (rest.since, rest.until) if k is not None}
            if not events <= {*done, *mine.done} or events <= set(course.done):
                continue
            if name != robot and not events & set(mine.done):
                continue
            there = np.ones((instants, len(mine.q)), dtype=bool)
            for k, present in ((rest.since, True), (rest.until, False)):
                if k is not None:
                    over = np.zeros(there.shape, dtype=bool)
                    over[done.get(k, instants) :] = True
                    over[:, mine.done.get(k, len(mine.q)) :] = True
                    there &= over == present
            depth = course.spread(self._depth_at(name, course, rest))
            if depth.any():
                at = depth[None] if name == robot else depth[nodes[name]][:, None]
                yield _Depth(there * at, (name,), rest.since if rest.since is not None else rest.until)

    def _depth_at(self, robot: str, course: _Course, rest: _Rest) -> np.ndarray:
        """Deepest penetration (C,) of a robot where it is measured along its way and an object where it rests."""
        out = np.zeros(len(course.looked))
        stage = course.stage[course.looked]
        item = rest.at.object
        gap = np.linalg.norm(course.state.centres - rest.X_WO[:3, 3], axis=2) - course.state.radii
        holds = np.array([a is not None and a.object == item for a in course.held])[stage]
        close = np.flatnonzero((gap.min(axis=1) < self._radius[item]) & ~holds)
        if not len(close):
            return out
        situations = _Situations()
        for a in course.held:
            situations.add([a], {item: rest.X_WO})
        samples = Samples(close, np.zeros(len(close)), stage[close])
        near = self.nearness.world(robot, course.state.of(close), samples, situations, 0.0)
        number = self.nearness.carriers.number["object", item]
        about = (near.a == number) | (near.b == number)
        out[close] = _deepest(near, len(close), about)
        return out


def _divided(way: np.ndarray) -> Iterator[tuple[np.ndarray, int]]:
    """Nodes (n * _PARTS, m) along stretches of a way (K, m) between sharp turns, without the first of each, and n."""
    way = way[np.concatenate([[True], np.any(np.diff(way, axis=0) != 0, axis=1)])]
    steps = np.diff(way, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    turns = np.einsum("ij,ij->i", steps[:-1], steps[1:]) < _SHARP * lengths[:-1] * lengths[1:]
    for a, b in itertools.pairwise([0, *(np.flatnonzero(turns) + 1).tolist(), len(steps)] if len(steps) else []):
        n = max(1, int(np.ceil((along[b] - along[a]) / _STEP - 1e-9)))
        x = np.linspace(along[a], along[b], n * _PARTS + 1)[1:]
        nodes = np.column_stack([np.interp(x, along, column) for column in way.T])
        nodes[-1] = way[b]
        yield nodes, n


def _attributed(
    part: _Depth, share: np.ndarray, courses: Mapping[str, _Course], nodes: Mapping[str, np.ndarray]
) -> Iterator[tuple[int, float]]:
    """Events and their shares of a conflict (P,) along instants (P,): all that are involved have the whole of it."""
    if part.event is not None:
        yield part.event, float(share.sum())
    for name in part.robots:
        if courses[name].done:
            events, which = np.unique(courses[name].on_the_way_to(nodes[name]), return_inverse=True)
            yield from zip(events.tolist(), np.bincount(which, share).tolist(), strict=True)


def _deepest(near: Near, n: int, among: np.ndarray | slice = slice(None)) -> np.ndarray:
    """Deepest penetration (n,) at each sample, among some of the pairs."""
    out = np.zeros(n)
    np.maximum.at(out, near.sample[among], -near.distance[among])
    return out


def _overlapping(a: State, b: State) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (P,), (P,) of samples of two robots at which bounding spheres meet."""
    out = np.zeros((len(a.x), len(b.x)), dtype=bool)
    for i, j in itertools.product(range(a.centres.shape[1]), range(b.centres.shape[1])):
        limit = a.radii[:, i, None] + b.radii[None, :, j]
        if limit.max() > 0:
            out |= cdist(a.centres[:, i], b.centres[:, j]) < limit
    row, column = np.nonzero(out)
    return row, column


def _cheapest(
    rows: np.ndarray, columns: np.ndarray, depth: np.ndarray, never: np.ndarray, early: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A cheapest monotone path from corner to corner: rows (P,), columns (P,), and how long each step takes (P,).

    A step of rows (T,) and columns (N,), or of one of them, takes as long as the longer of the two; with everything
    still ahead it costs by the share `early` more than in the end.
    """
    ahead = (rows.sum() - np.cumsum(rows))[:, None] + columns.sum() - np.cumsum(columns)
    haste = 1 + early * ahead / max(float(ahead[0, 0]), 1e-9)
    charge = (1 + _CHARGE[0] * depth + _CHARGE[1] * depth**2) * haste
    cost = np.full(depth.shape, np.inf)
    along = np.cumsum(columns * charge + _NEVER * never, axis=1)
    both = np.maximum(rows[:, None], columns[None]) * charge
    for t in range(len(rows)):
        base = np.full(len(columns), np.inf)
        if t == 0:
            base[0] = 0.0
        else:
            base = cost[t - 1] + rows[t] * charge[t] + _NEVER * never[t]
            base[1:] = np.minimum(base[1:], cost[t - 1, :-1] + both[t, 1:] + _NEVER * never[t, 1:])
        cost[t] = along[t] + np.minimum.accumulate(base - along[t])
    t, n = len(rows) - 1, len(columns) - 1
    path, length = [(t, n)], []
    while t or n:
        choices = []
        if t and n:
            choices.append((cost[t - 1, n - 1] + both[t, n], t - 1, n - 1))
        if t:
            choices.append((cost[t - 1, n] + rows[t] * charge[t, n], t - 1, n))
        if n:
            choices.append((cost[t, n - 1] + columns[n] * charge[t, n], t, n - 1))
        _, u, m = min(choices)
        length.append(max(rows[t] * (t - u), columns[n] * (n - m)))
        t, n = u, m
        path.append((t, n))
    row, column = np.array(path[::-1]).T
    return row, column, np.array([0.0, *length[::-1]])


def _timed(
    root: Mode, transitions: Sequence[Transition], courses: Mapping[str, _Course], nodes: Mapping[str, np.ndarray]
) -> tuple[list[Segment], list[Transition]]:
    """Segments and transitions of robots that are at the given nodes (T,) of their ways."""
    when = {k: int(np.argmax(nodes[r] >= node)) for r in courses for k, node in courses[r].done.items()}
    q = {r: courses[r].q[nodes[r]] for r in courses}
    segments, order, mode, low = [], sorted(when, key=lambda k: (when[k], k)), root, 0
    for k in [*order, None]:
        high = len(next(iter(q.values()))) - 1 if k is None else when[k]
        moves = [any(np.any(x[i] != x[i - 1]) for x in q.values()) for i in range(low + 1, high + 1)]
        kept = [low, *(i for i, moved in enumerate(moves, start=low + 1) if moved)]
        segments.append(Segment(mode, {r: x[kept] for r, x in q.items()}))
        if k is not None:
            mode, low = mode.after(transitions[k]), high
    return segments, [transitions[k] for k in order]
