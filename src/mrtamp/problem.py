"""What is to be planned, as plain data: robots, static world, supports, objects, goal and cost.

A `Problem` comes from a YAML file (`mrtamp.problem_file`), from a generator (`mrtamp.tasks`) or is built in
Python; everything downstream reads it and nothing changes it.  Poses are Drake `RigidTransform`s in monogram
notation: `X_WB` is the pose of B in the world W.  Lengths are metres, angles radians.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform

WORLD = "world"


class MrtampError(Exception):
    """Base class of every error a user of mrtamp can cause; its text says what to change."""


class ProblemError(MrtampError):
    """A problem or robot description is wrong: names the file, the key, what was found and the valid choices."""


@dataclass(frozen=True)
class Shape:
    """A primitive solid centred on its own frame.

    `kind` and `size` (full sizes): box (x, y, z); cylinder (radius, length along z); capsule (radius, length of
    the cylindrical part along z); sphere (radius,).
    """

    kind: str
    size: tuple[float, ...]

    @property
    def half_height(self) -> float:
        """Distance from the centre to the bottom face, measured along -z (m)."""
        if self.kind == "box":
            return self.size[2] / 2
        if self.kind == "cylinder":
            return self.size[1] / 2
        if self.kind == "capsule":
            return self.size[1] / 2 + self.size[0]
        return self.size[0]


@dataclass(frozen=True, eq=False)
class Gripper:
    """A parallel gripper: the bodies allowed to touch what is held, and how an opening width sets its joints.

    `joints` maps joint name to factor: joint position = factor * opening width.
    """

    bodies: tuple[str, ...]
    joints: dict[str, float]
    max_width: float


@dataclass(frozen=True, eq=False)
class RobotModel:
    """A robot description file (models/robots/*.yaml): any URDF or SDF arm, without code.

    `grasp_body` and `X_BG` place the grasp frame G: z is the approach direction, y the direction in which the
    fingers open, the origin lies between the finger pads.  A robot without gripper has `gripper=None` and can
    only move.
    """

    name: str
    model: str
    base: str
    arm_joints: tuple[str, ...]
    home: tuple[float, ...]
    gripper: Gripper | None
    grasp_body: str
    X_BG: RigidTransform
    collision_exceptions: tuple[tuple[str, str], ...] = ()
    file: Path | None = None


@dataclass(frozen=True, eq=False)
class Robot:
    """One robot of a problem: a model welded at `X_WB`, starting at `start` and at home at `home` (n joints)."""

    name: str
    model: RobotModel
    X_WB: RigidTransform
    home: np.ndarray
    start: np.ndarray


@dataclass(frozen=True, eq=False)
class StaticBody:
    """A fixed part of the world: a primitive shape or a model file, at `X_WB`."""

    name: str
    X_WB: RigidTransform
    shape: Shape | None = None
    model: str | None = None
    color: tuple[float, float, float, float] = (0.7, 0.7, 0.7, 1.0)


@dataclass(frozen=True, eq=False)
class Support:
    """A named region on a body (static, or an object) where things may be put.

    `X_BS` is the surface frame S in the body B: origin in the middle, z out of the surface.  An object is *in*
    the region when its origin lies within `size` (full sizes along x, y of S) and at least `margin` (m) from the rim;
    where that leaves nothing, in the middle.  With `X_BO` the support is one exact pose of the object in B.  `objects`
    restricts who may be put there (None: any).
    """

    name: str
    body: str
    X_BS: RigidTransform
    size: tuple[float, float]
    yaw: tuple[float, float] = (-np.pi, np.pi)
    X_BO: RigidTransform | None = None
    objects: tuple[str, ...] | None = None
    color: tuple[float, float, float, float] | None = None
    margin: float = 0.0

    @property
    def reach(self) -> tuple[float, float]:
        """How far (m) from the middle, along x and y of S, the origin of an object in the region may be."""
        return max(self.size[0] / 2 - self.margin, 0.0), max(self.size[1] / 2 - self.margin, 0.0)


@dataclass(frozen=True, eq=False)
class AntipodalGrasps:
    """Grasps on opposite faces of a box (or around a cylinder), approached along the given object axes.

    The approach direction z_G is one of `approaches` (e.g. "-z": from above); the fingers close along an axis
    perpendicular to it (a box: one of the other two axes, whose extent must fit the gripper; a cylinder approached
    along its axis or its side: every angle in between).  The grasp point slides along the face by up to `offset` (m,
    each way, along the remaining axis) and sinks `depth` (m) from the object's near face towards its far face: a range.
    `robots` says which robots may grasp so (None: all).
    """

    approaches: tuple[str, ...]
    offset: float
    depth: tuple[float, float]
    robots: tuple[str, ...] | None = None


@dataclass(frozen=True, eq=False)
class ExplicitGrasp:
    """One grasp frame pose in the object frame, with the opening width of the fingers when closed on it (m).

    `robots` says which robots may grasp so (None: all).
    """

    X_OG: RigidTransform
    width: float
    robots: tuple[str, ...] | None = None


@dataclass(frozen=True, eq=False)
class MovableObject:
    """An object that robots may carry.  It starts at `start_X_BO` on body `start_on`, inside support `start_support`.

    `resting_faces` names the faces ("-z", "+x", ...) on which it can stand when it is put somewhere.
    """

    name: str
    start_on: str
    start_X_BO: RigidTransform
    start_support: str | None = None
    shape: Shape | None = None
    model: str | None = None
    mass: float = 0.1
    color: tuple[float, float, float, float] = (0.8, 0.3, 0.2, 1.0)
    resting_faces: tuple[str, ...] = ("-z",)
    grasps: tuple[AntipodalGrasps | ExplicitGrasp, ...] = ()


@dataclass(frozen=True)
class InRegion:
    """Goal: `object` rests with its origin inside the support `region`, `Support.margin` away from the rim."""

    object: str
    region: str


@dataclass(frozen=True, eq=False)
class AtPose:
    """Goal: `object` rests on body `on` (static body or object) at exactly `X_BO` in that body's frame.

    `X_BO=None` (only on an object): anywhere on that object's default top support.
    """

    object: str
    on: str
    X_BO: RigidTransform | None


@dataclass(frozen=True)
class HeldBy:
    """Goal: `object` is held by `robot`."""

    object: str
    robot: str


@dataclass(frozen=True, eq=False)
class RobotAt:
    """Goal: `robot` ends at configuration `q` (its home when the file says `home`)."""

    robot: str
    q: np.ndarray


Condition = InRegion | AtPose | HeldBy | RobotAt


@dataclass(frozen=True, eq=False)
class AtConfiguration:
    """Target of a robot in a subgoal: exactly configuration `q` (n joints, rad or m)."""

    q: np.ndarray


@dataclass(frozen=True, eq=False)
class HandAt:
    """Target of a robot in a subgoal: its grasp frame G at `X_WG`; the arm's posture is free."""

    X_WG: RigidTransform


@dataclass(frozen=True, eq=False)
class HandIn:
    """Target of a robot in a subgoal: the origin of its grasp frame inside a box (full sizes `size`, m) at `X_WC`."""

    X_WC: RigidTransform
    size: tuple[float, float, float]


Target = AtConfiguration | HandAt | HandIn


@dataclass(frozen=True)
class Attach:
    """What a subgoal does to an object on arrival: from there on it is fixed to `parent` where it is.

    `parent` is a robot of the subgoal (it takes the object), or a static body, another object or the world (whoever
    holds the object lets go of it).
    """

    object: str
    parent: str


@dataclass(frozen=True, eq=False)
class Subgoal:
    """Something to be visited, the `reach` transition: each robot of `targets` at its target at the same instant.

    `after` names the subgoals that have to be reached earlier, or at the same instant at the earliest.
    """

    name: str
    targets: dict[str, Target]
    after: tuple[str, ...] = ()
    attach: Attach | None = None


@dataclass(frozen=True)
class CollisionRules:
    """What does not count as a collision.

    `ignore` lists pairs of things that may overlap, each a robot ("left"), one of its bodies ("left/link7"), a static
    body or an object.  A configuration is free when its penetrations (m) add up to no more than `tolerance`.
    """

    ignore: tuple[tuple[str, str], ...] = ()
    tolerance: float = 0.0


@dataclass(frozen=True)
class CostWeights:
    """J = sum over synchronous steps of makespan * max_r |dq_r| + path_length * sum_r |dq_r|, plus transition costs."""

    makespan: float = 1.0
    path_length: float = 0.01
    transitions: dict[str, float] = field(default_factory=dict)

    def of_changes(self, kinds: Iterable[str]) -> float:
        """What transitions of these kinds cost together."""
        return sum(self.transitions.get(kind, 0.0) for kind in kinds)


@dataclass(frozen=True, eq=False)
class Problem:
    """Everything a planner needs to know.

    `supports` includes those synthesised from exact poses and from goals on objects, so every place where an object may
    rest (start, goal, intermediate) is one of them.  Every one of `subgoals` has to be reached, and `goal` holds at the
    end.
    """

    name: str
    robots: tuple[Robot, ...]
    statics: tuple[StaticBody, ...]
    supports: tuple[Support, ...]
    objects: tuple[MovableObject, ...]
    goal: tuple[Condition, ...]
    cost: CostWeights = CostWeights()
    description: str = ""
    subgoals: tuple[Subgoal, ...] = ()
    collision: CollisionRules = CollisionRules()
    package_paths: tuple[Path, ...] = ()
    source: dict | None = None

    def robot(self, name: str) -> Robot:
        """The robot called `name`."""
        return next(r for r in self.robots if r.name == name)

    def object(self, name: str) -> MovableObject:
        """The object called `name`."""
        return next(o for o in self.objects if o.name == name)

    def support(self, name: str) -> Support:
        """The support called `name`."""
        return next(s for s in self.supports if s.name == name)

    def subgoal(self, name: str) -> Subgoal:
        """The subgoal called `name`."""
        return next(s for s in self.subgoals if s.name == name)
