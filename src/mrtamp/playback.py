"""A plan on the clock: when each waypoint and each transition is reached, and the pose of everything in between.

A plan has synchronous steps but no time.  To show it, a step lasts as long as its longest joint motion takes at one
constant speed, and at every transition the robots stand still while the fingers close or open.  `Playback` needs only
the plan; with a scene it also gives the plant's position vector at any time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mrtamp.kinematics import quaternions
from mrtamp.modes import Mode, object_poses, start_mode, static_poses
from mrtamp.plan import Plan, Segment, Transition, motion_lengths
from mrtamp.problem import Problem
from mrtamp.scene import Scene, chain_of

SPEED = 1.0
"""Joint speed on screen: the longest robot of a step moves this fast (rad/s, Euclidean)."""
DWELL = 0.7
"""How long the robots stand still at a transition while fingers close, then open (s)."""


@dataclass(frozen=True)
class Event:
    """A transition on the clock: the fingers move from `start` to `end` (s), the mode changes half-way."""

    start: float
    end: float
    transition: Transition


@dataclass(frozen=True, eq=False)
class _Knots:
    """Piecewise linear motion: `q` and finger openings `width` at `time`; `mode` holds from a knot to the next."""

    time: np.ndarray
    q: dict[str, np.ndarray]
    width: dict[str, np.ndarray]
    mode: list[Mode]


class Playback:
    """The motion of a plan as a function of time.

    Parameters
    ----------
    plan : the plan to play.
    speed : joint speed of the longest robot in every step (rad/s).
    dwell : duration of a transition (s).
    """

    def __init__(self, plan: Plan, *, speed: float = SPEED, dwell: float = DWELL) -> None:
        self.plan = plan
        self._knots, self.events = _schedule(plan, speed, dwell)

    @property
    def duration(self) -> float:
        """Time of the last waypoint (s)."""
        return float(self._knots.time[-1])

    def times(self, rate: float) -> np.ndarray:
        """Equally spaced times (s) from start to end, at least `rate` per second, both ends included."""
        return np.linspace(0.0, self.duration, int(np.ceil(self.duration * rate)) + 1)

    def q(self, robot: str, times: np.ndarray) -> np.ndarray:
        """Arm configurations (N, n) of `robot` at `times` (N,)."""
        knots = self._knots
        return np.column_stack([np.interp(times, knots.time, column) for column in knots.q[robot].T])

    def width(self, robot: str, times: np.ndarray) -> np.ndarray:
        """Opening of the fingers (N,) of `robot` at `times` (m); zeros for a robot without gripper."""
        return np.interp(times, self._knots.time, self._knots.width[robot])

    def mode(self, time: float) -> Mode:
        """The mode at `time`."""
        return self._knots.mode[self._index(np.array([time]))[0]]

    def _index(self, times: np.ndarray) -> np.ndarray:
        last = len(self._knots.time) - 1
        return np.clip(np.searchsorted(self._knots.time, times, side="right") - 1, 0, last)

    def grasp_frames(self, scene: Scene, robot: str, times: np.ndarray) -> np.ndarray:
        """World poses (N, 4, 4) of the robot's grasp frame at `times`."""
        return chain_of(scene, robot)[1].matrix(self.q(robot, times))

    def positions(self, scene: Scene, times: np.ndarray) -> np.ndarray:
        """Position vectors (N, nq) of the scene's plant: arms, fingers and objects (held ones follow the hand)."""
        times = np.asarray(times, dtype=float)
        out = np.zeros((len(times), scene.plant.num_positions()))
        X_WG: dict[str, np.ndarray] = {}
        for name, robot in scene.robots.items():
            out[:, robot.arm] = self.q(name, times)
            out[:, robot.fingers] = self.width(name, times)[:, None] * robot.finger_factors
            X_WG[name] = self.grasp_frames(scene, name, times)
        X_WB = static_poses(self.plan.problem)
        index = self._index(times)
        modes = [self._knots.mode[i] for i in index]
        starts = [k for k in range(len(modes)) if k == 0 or modes[k] is not modes[k - 1]]
        for a, b in zip(starts, [*starts[1:], len(modes)], strict=True):
            parents = {**X_WB, **{name: X[a:b] for name, X in X_WG.items()}}
            for name, X_WO in object_poses(modes[a], parents).items():
                X = np.broadcast_to(X_WO, (b - a, 4, 4))
                k = scene.floating[name]
                out[a:b, k : k + 4] = quaternions(X[:, :3, :3])
                out[a:b, k + 4 : k + 7] = X[:, :3, 3]
        return out


def standstill(problem: Problem) -> Plan:
    """The plan in which nothing happens: every robot stays at its start."""
    q = {r.name: np.asarray(r.start, dtype=float)[None] for r in problem.robots}
    return Plan(problem, [Segment(start_mode(problem), q)], [], 0.0)


def _widths(problem: Problem, mode: Mode) -> dict[str, float]:
    """Opening of every gripper in `mode` (m): closed on what it holds, fully open otherwise."""
    out = {}
    for robot in problem.robots:
        gripper = robot.model.gripper
        held = mode.held.get(robot.name)
        width = held.width if held is not None else None
        out[robot.name] = 0.0 if gripper is None else gripper.max_width if width is None else width
    return out


def _schedule(plan: Plan, speed: float, dwell: float) -> tuple[_Knots, tuple[Event, ...]]:
    names = [r.name for r in plan.problem.robots]
    times: list[float] = []
    modes: list[Mode] = []
    q: dict[str, list[np.ndarray]] = {name: [] for name in names}
    width: dict[str, list[float]] = {name: [] for name in names}
    events: list[Event] = []
    now = 0.0

    def knot(time: float, mode: Mode, at: Mapping[str, np.ndarray], opening: Mapping[str, float]) -> None:
        times.append(time)
        modes.append(mode)
        for name in names:
            q[name].append(np.asarray(at[name], dtype=float))
            width[name].append(opening[name])

    for k, segment in enumerate(plan.segments):
        opening = _widths(plan.problem, segment.mode)
        steps = motion_lengths(segment).max(axis=0) / speed
        clock = now + np.concatenate([[0.0], np.cumsum(steps)])
        for i in range(segment.length):
            knot(float(clock[i]), segment.mode, {name: segment.q[name][i] for name in names}, opening)
        now = float(clock[-1])
        if k < len(plan.transitions):
            after = plan.segments[k + 1].mode
            then = _widths(plan.problem, after)
            # The receiver closes before the giver opens: half-way every gripper is at its narrower opening.
            closed = {name: min(opening[name], then[name]) for name in names}
            at = {name: segment.q[name][-1] for name in names}
            knot(now + dwell / 2, after, at, closed)
            knot(now + dwell, after, at, then)
            events.append(Event(now, now + dwell, plan.transitions[k]))
            now += dwell
    knots = _Knots(np.array(times), {n: np.array(q[n]) for n in names}, {n: np.array(width[n]) for n in names}, modes)
    return knots, tuple(events)
