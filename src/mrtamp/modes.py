"""Modes: what is attached to what.  Attachment, Mode, modal state, world poses and the goal test (paper, section III).

An attachment object is created once and kept: its identity *is* the continuous part of a mode (this grasp, this
placement), so it serves as the key of every cache that depends on it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from mrtamp.kinematics import inverse
from mrtamp.problem import WORLD, AtPose, HeldBy, InRegion, Problem, RobotAt

if TYPE_CHECKING:
    from mrtamp.plan import Transition

POSITION_TOLERANCE = 1e-4
"""How far (m) an object may be from a goal pose."""
ANGLE_TOLERANCE = 1e-3
"""How far (rad) an object may be turned from a goal pose."""
JOINT_TOLERANCE = 1e-4
"""How far (rad or m) a joint may be from a goal configuration."""


@dataclass(frozen=True, eq=False)
class Attachment:
    """One object fixed to one parent.

    `parent` is a static body, another object or a robot; `X_PO` (4, 4) is the pose of the object O in the parent's body
    frame, for a robot in its grasp frame G.  `support` names the support it rests on (None while held), `width` the
    opening of the fingers (m) while held.
    """

    object: str
    parent: str
    X_PO: np.ndarray
    support: str | None = None
    width: float | None = None

    @property
    def held(self) -> bool:
        """Whether a robot holds the object."""
        return self.support is None

    @property
    def place(self) -> str:
        """The name of the parent in a modal state: the support it rests on, or the robot that holds it."""
        return self.support or self.parent


ModalState = tuple[tuple[str, str], ...]
"""Object name and the name of its support or robot, sorted by object, then the subgoals reached, each with `REACHED`:
a vertex of the modal graph."""
REACHED = "reached"


@dataclass(frozen=True, eq=False)
class Mode:
    """One attachment per object, and the subgoals that have been reached.

    Two modes are the same when their attachments are the very same objects and `done` is equal: `key` identifies a mode
    in dictionaries.  What is free of collision depends on `attachments` alone.
    """

    attachments: tuple[Attachment, ...]
    done: frozenset[str] = frozenset()

    @cached_property
    def key(self) -> tuple:
        """What identifies the mode."""
        return (self.attachments, tuple(sorted(self.done)))

    @cached_property
    def of(self) -> Mapping[str, Attachment]:
        """Attachment by object name."""
        return {a.object: a for a in self.attachments}

    @cached_property
    def held(self) -> Mapping[str, Attachment]:
        """Robot name -> the attachment it holds."""
        return {a.parent: a for a in self.attachments if a.held}

    @cached_property
    def state(self) -> ModalState:
        """The mode without its continuous part."""
        return (
            *sorted((a.object, a.place) for a in self.attachments),
            *((name, REACHED) for name in sorted(self.done)),
        )

    @cached_property
    def loaded(self) -> frozenset[str]:
        """Objects on which another object rests."""
        names = set(self.of)
        return frozenset(a.parent for a in self.attachments if a.parent in names and not a.held)

    def carrier(self, object_name: str) -> str:
        """The robot or static body at the end of the object's chain of parents."""
        a = self.of[object_name]
        while a.parent in self.of and not a.held:
            a = self.of[a.parent]
        return a.parent

    def replace(self, *changes: Attachment, done: Iterable[str] = ()) -> Mode:
        """The mode in which each changed object has its new attachment, and the subgoals `done` are reached as well."""
        new = {a.object: a for a in changes}
        return Mode(tuple(new.get(a.object, a) for a in self.attachments), self.done | frozenset(done))

    def after(self, transition: Transition) -> Mode:
        """The mode to which a transition leads."""
        changes = [a.after for a in transition.actions if a.after is not None]
        return self.replace(*changes, done=[a.subgoal for a in transition.actions if a.subgoal is not None])

    def chain(self, object_name: str) -> tuple[Attachment, ...]:
        """The attachments that fix the object's world pose: its own, its parent object's, and so on."""
        a = self.of[object_name]
        out = [a]
        while not a.held and a.parent in self.of:
            a = self.of[a.parent]
            out.append(a)
        return tuple(out)


def start_mode(problem: Problem) -> Mode:
    """The mode the problem starts in."""
    return Mode(
        tuple(
            Attachment(
                object=o.name,
                parent=o.start_on,
                X_PO=o.start_X_BO.GetAsMatrix4(),
                support=o.start_support or f"start of {o.name}",
            )
            for o in problem.objects
        )
    )


def static_poses(problem: Problem) -> dict[str, np.ndarray]:
    """World poses (4, 4) of the world frame and of every static body."""
    return {WORLD: np.eye(4), **{s.name: s.X_WB.GetAsMatrix4() for s in problem.statics}}


def object_poses(mode: Mode, X_WP: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """World poses (4, 4) of all objects, given those of static bodies and of the grasp frames of holding robots."""
    out: dict[str, np.ndarray] = {}

    def pose(name: str) -> np.ndarray:
        if name not in out:
            a = mode.of[name]
            on_object = not a.held and a.parent in mode.of
            out[name] = (pose(a.parent) if on_object else X_WP[a.parent]) @ a.X_PO
        return out[name]

    for name in mode.of:
        pose(name)
    return out


def _same_pose(X: np.ndarray, Y: np.ndarray) -> bool:
    angle = np.arccos(np.clip((np.trace(X[:3, :3].T @ Y[:3, :3]) - 1) / 2, -1, 1))
    return bool(np.linalg.norm(X[:3, 3] - Y[:3, 3]) <= POSITION_TOLERANCE and angle <= ANGLE_TOLERANCE)


def condition_holds(
    problem: Problem, condition: InRegion | AtPose | HeldBy, mode: Mode, X_WP: Mapping[str, np.ndarray]
) -> bool:
    """Whether an object condition of the goal holds in `mode`.  `X_WP`: world poses of static bodies."""
    a = mode.of[condition.object]
    if isinstance(condition, HeldBy):
        return a.held and a.parent == condition.robot
    if a.held:
        return False
    if isinstance(condition, InRegion):
        region = problem.support(condition.region)
        if a.parent != region.body:
            return False
        p = (inverse(region.X_BS.GetAsMatrix4()) @ a.X_PO)[:2, 3]
        return bool(np.all(np.abs(p) <= np.asarray(region.reach) + POSITION_TOLERANCE))
    if a.parent != condition.on:
        return False
    return condition.X_BO is None or _same_pose(a.X_PO, condition.X_BO.GetAsMatrix4())


def goal_mode(problem: Problem, mode: Mode, X_WP: Mapping[str, np.ndarray]) -> bool:
    """Whether every subgoal is reached and every object condition of the goal holds."""
    conditions = [c for c in problem.goal if not isinstance(c, RobotAt)]
    return len(mode.done) == len(problem.subgoals) and all(condition_holds(problem, c, mode, X_WP) for c in conditions)
