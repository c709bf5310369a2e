"""A toy for tests: discs of radius 0.2 that slide over a plane, and a token that they take along and let go of.

The joints (x, y) of a disc are the world position of its axis.  `errand` is a plan written by hand: disc a visits its
place while disc b takes the token and drops it elsewhere.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform

from mrtamp.modes import Attachment, Mode, object_poses, start_mode
from mrtamp.plan import Action, Plan, Segment, Transition, plan_cost
from mrtamp.problem import (
    WORLD,
    AtConfiguration,
    Attach,
    HandAt,
    HandIn,
    MovableObject,
    Problem,
    Robot,
    RobotAt,
    RobotModel,
    Shape,
    StaticBody,
    Subgoal,
    Target,
)

RADIUS = 0.2
HEIGHT = 0.06
"""Height (m) of the middle of discs and token over the plane."""

_INERTIA = '<inertial><mass value="1"/><inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial>'
_DISC = f"""<robot name="disc">
  <link name="base">{_INERTIA}</link><link name="slide">{_INERTIA}</link>
  <link name="disc">{_INERTIA}<collision><origin xyz="0 0 {HEIGHT}"/>
    <geometry><cylinder radius="{RADIUS}" length="0.1"/></geometry></collision></link>
  <joint name="x" type="prismatic"><parent link="base"/><child link="slide"/><axis xyz="1 0 0"/>
    <limit lower="-2" upper="2" effort="10" velocity="1"/></joint>
  <joint name="y" type="prismatic"><parent link="slide"/><child link="disc"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="10" velocity="1"/></joint>
</robot>
"""
_ROBOT_FILE = f"""
mrtamp_robot: 1
name: disc
model: disc.urdf
base: base
arm_joints: [x, y]
home: [0, 0]
grasp_frame: {{body: disc, X_BG: {{translation: [0, 0, {HEIGHT}]}}}}
"""


def disc_model(folder: Path) -> RobotModel:
    """The robot model, its URDF and its robot file written into `folder`; it has no gripper."""
    (folder / "disc.urdf").write_text(_DISC)
    (folder / "disc.yaml").write_text(_ROBOT_FILE)
    X_BG = RigidTransform([0, 0, HEIGHT])
    return RobotModel("disc", "disc.urdf", "base", ("x", "y"), (0.0, 0.0), None, "disc", X_BG, (), folder / "disc.yaml")


def disc_problem(folder: Path) -> Problem:
    """Two discs, a wall along the x axis, and a token in the air beside the place where b takes it."""
    model = disc_model(folder)
    starts = {"a": np.array([-0.5, -0.5]), "b": np.array([0.5, -0.5])}
    there = RigidTransform([0.5, 0.5, HEIGHT])
    subgoals = (
        Subgoal("visit", {"a": AtConfiguration(np.array([-0.5, -0.9]))}),
        Subgoal("take", {"b": HandAt(RigidTransform([0.9, -0.5, HEIGHT]))}, (), Attach("token", "b")),
        Subgoal("drop", {"b": HandIn(there, (0.2, 0.0, 0.1))}, ("take",), Attach("token", WORLD)),
    )
    wall = StaticBody("wall", RigidTransform([-0.3, 0, 0.05]), Shape("box", (1.0, 0.1, 0.1)))
    token = MovableObject("token", WORLD, RigidTransform([0.9, -0.8, HEIGHT]), None, Shape("box", (0.1, 0.1, 0.1)))
    return Problem(
        name="discs",
        robots=tuple(Robot(name, model, RigidTransform(), q, q) for name, q in starts.items()),
        statics=(wall,),
        supports=(),
        objects=(token,),
        goal=(RobotAt("a", starts["a"]),),
        subgoals=subgoals,
    )


class Errands:
    """Writes a plan of discs down move by move; `reach` ends a segment at the subgoals named."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.q = {r.name: [r.start] for r in problem.robots}
        self.mode: Mode = start_mode(problem)
        self.segments: list[Segment] = []
        self.transitions: list[Transition] = []

    def move(self, **targets: tuple[float, float]) -> Errands:
        """One synchronous step; robots that are not named stand still."""
        for name, rows in self.q.items():
            rows.append(np.array(targets.get(name, rows[-1]), dtype=float))
        return self

    def _end(self) -> None:
        self.segments.append(Segment(self.mode, {n: np.array(rows) for n, rows in self.q.items()}))
        self.q = {n: [rows[-1]] for n, rows in self.q.items()}

    def reach(self, *names: str) -> Errands:
        """A transition in which the robots of all the named subgoals reach them."""
        X_WP = {s.name: s.X_WB.GetAsMatrix4() for s in self.problem.statics} | {WORLD: np.eye(4)}
        for name, rows in self.q.items():
            X_WP[name] = RigidTransform([*rows[-1], HEIGHT]).GetAsMatrix4()
        X_WO = object_poses(self.mode, X_WP)
        self._end()
        actions = []
        for name in names:
            subgoal = self.problem.subgoal(name)
            before = after = None
            if subgoal.attach is not None:
                item, parent = subgoal.attach.object, subgoal.attach.parent
                X_WF = X_WO[parent] if parent in X_WO else X_WP[parent]
                support = None if parent in subgoal.targets else f"at {name}"
                before = self.mode.of[item]
                after = Attachment(item, parent, np.linalg.inv(X_WF) @ X_WO[item], support)
            actions.append(Action("reach", tuple(sorted(subgoal.targets)), before, after, name))
        self.transitions.append(Transition(tuple(actions)))
        self.mode = self.mode.after(self.transitions[-1])
        return self

    def plan(self) -> Plan:
        """The finished plan."""
        self._end()
        return Plan(
            self.problem, self.segments, self.transitions, plan_cost(self.segments, self.transitions, self.problem.cost)
        )


def errand(problem: Problem) -> Plan:
    """The hand-made plan: visit and take at once, then drop, then a goes home."""
    e = Errands(problem).move(a=(-0.5, -0.9), b=(0.9, -0.5)).reach("visit", "take")
    e.move(b=(0.9, 0.5)).move(a=(-0.5, -0.5), b=(0.55, 0.5)).reach("drop")
    return e.move(b=(0.6, 0.9)).plan()


def target_of(problem: Problem, subgoal: str) -> Target:
    """The target of a subgoal of one robot."""
    [target] = problem.subgoal(subgoal).targets.values()
    return target
