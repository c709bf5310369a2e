"""A toy for tests: gantries (x, y, z slides, a turn about z, two fingers) whose kinematics fit in one's head.

The joints (x, y, z, yaw) of a gantry are the world position of its grasp point and its turn; the hand looks down, the
fingers open along the (turned) y axis.  `valid_plan` is a plan written by hand: pick a cube, set it down in a region,
then hand a bar from the left gantry to the right one, which sets it down too.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from mrtamp.modes import Attachment, Mode, start_mode
from mrtamp.plan import Action, Plan, Segment, Transition, plan_cost
from mrtamp.problem import (
    AntipodalGrasps,
    Gripper,
    InRegion,
    MovableObject,
    Problem,
    Robot,
    RobotAt,
    RobotModel,
    Shape,
    StaticBody,
    Support,
)

_LINK = """
  <link name="{name}">
  <inertial><mass value="1"/><inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial>
  {collisions}</link>"""
_JOINT = """
  <joint name="{name}" type="{type}"><parent link="{parent}"/><child link="{child}"/><axis xyz="{axis}"/>
    <limit lower="{low}" upper="{high}" effort="10" velocity="1"/></joint>"""
_BOX = '<collision><origin xyz="{xyz}"/><geometry><box size="{size}"/></geometry></collision>'


def _box(xyz: str, size: str) -> str:
    return _BOX.format(xyz=xyz, size=size)


def gantry_urdf() -> str:
    """The robot: fingers 10 mm thick that reach 10 mm below the grasp point, a palm 40 mm above it, and a rod."""
    links = {
        "base": "",
        "x_slide": "",
        "y_slide": "",
        "z_slide": "",
        "tool": _box("0 0 0.06", "0.04 0.12 0.04") + _box("0 0 0.33", "0.03 0.03 0.5"),
        "finger_left": _box("0 0.005 0.015", "0.02 0.01 0.05"),
        "finger_right": _box("0 -0.005 0.015", "0.02 0.01 0.05"),
    }
    joints = [
        ("x", "prismatic", "base", "x_slide", "1 0 0", -1, 1),
        ("y", "prismatic", "x_slide", "y_slide", "0 1 0", -1, 1),
        ("z", "prismatic", "y_slide", "z_slide", "0 0 1", -0.2, 1),
        ("yaw", "revolute", "z_slide", "tool", "0 0 1", -3.2, 3.2),
        ("open_left", "prismatic", "tool", "finger_left", "0 1 0", 0, 0.04),
        ("open_right", "prismatic", "tool", "finger_right", "0 -1 0", 0, 0.04),
    ]
    text = "".join(_LINK.format(name=name, collisions=shapes) for name, shapes in links.items())
    keys = ("name", "type", "parent", "child", "axis", "low", "high")
    text += "".join(_JOINT.format(**dict(zip(keys, joint, strict=True))) for joint in joints)
    return f'<robot name="gantry">{text}\n</robot>\n'


_ROBOT_FILE = """
mrtamp_robot: 1
name: gantry
model: gantry.urdf
base: base
arm_joints: [x, y, z, yaw]
home: [0, 0, 0.4, 0]
gripper: {bodies: [tool, finger_left, finger_right], joints: {open_left: 0.5, open_right: 0.5}, max_width: 0.08}
grasp_frame: {body: tool, X_BG: {rotation: !Rpy {deg: [180, 0, 0]}}}
"""


def gantry_model(folder: Path) -> RobotModel:
    """The robot model, its URDF and its robot file written into `folder`."""
    (folder / "gantry.urdf").write_text(gantry_urdf())
    (folder / "gantry.yaml").write_text(_ROBOT_FILE)
    return RobotModel(
        name="gantry",
        model="gantry.urdf",
        base="base",
        arm_joints=("x", "y", "z", "yaw"),
        home=(0.0, 0.0, 0.4, 0.0),
        gripper=Gripper(("tool", "finger_left", "finger_right"), {"open_left": 0.5, "open_right": 0.5}, 0.08),
        grasp_body="tool",
        X_BG=RigidTransform(RollPitchYaw(np.pi, 0, 0), [0, 0, 0]),
        file=folder / "gantry.yaml",
    )


CUBE = (0.04, 0.04, 0.06)
BAR = (0.2, 0.04, 0.05)


def gantry_problem(folder: Path) -> Problem:
    """Two gantries over a table: a cube, a second cube it can stand on, a bar, a thin wall, a target region."""
    model = gantry_model(folder)
    homes = {"left": np.array([-0.5, 0.0, 0.3, 0.0]), "right": np.array([0.5, 0.0, 0.3, 0.0])}
    table = StaticBody("table", RigidTransform([0, 0, -0.02]), Shape("box", (2.0, 2.0, 0.04)))
    wall = StaticBody("wall", RigidTransform([0, 0.6, 0.15]), Shape("box", (0.6, 0.002, 0.3)))
    top = RigidTransform([0, 0, 0.02])
    floor = Support("floor", "table", top, (2.0, 2.0))
    target = Support("target", "table", top, (0.1, 0.1), yaw=(-0.5, 0.5))
    on_block = Support("on_block", "block", RigidTransform([0, 0, 0.03]), (0.02, 0.02))
    grasps = (AntipodalGrasps(("-z",), 0.01, (0.01, 0.03)),)

    def thing(name: str, x: float, y: float, size: tuple[float, ...], **keys) -> MovableObject:
        X_BO = RigidTransform([x, y, 0.02 + size[2] / 2])
        return MovableObject(name, "table", X_BO, "floor", Shape("box", size), **{"grasps": grasps, **keys})

    return Problem(
        name="gantries",
        robots=tuple(Robot(name, model, RigidTransform(), home, home) for name, home in homes.items()),
        statics=(table, wall),
        supports=(floor, target, on_block),
        objects=(
            thing("cube", -0.4, 0.0, CUBE),
            thing("block", -0.4, 0.3, CUBE),
            thing("bar", -0.4, -0.3, BAR, grasps=(AntipodalGrasps(("-z",), 0.08, (0.01, 0.03)),)),
        ),
        goal=(InRegion("cube", "target"), RobotAt("left", homes["left"]), RobotAt("right", homes["right"])),
    )


def grasp(thing: str, robot: str, offset: float = 0.0, z: float = 0.01, yaw: float = 0.0) -> Attachment:
    """Held from above: the grasp point is `offset` along the object's x axis and `z` above its centre."""
    X_OG = RigidTransform(RollPitchYaw(np.pi, 0, yaw), [offset, 0, z])
    return Attachment(thing, robot, X_OG.inverse().GetAsMatrix4(), None, 0.04)


def put(
    thing: str, x: float, y: float, height: float, support: str = "floor", *, yaw: float = 0.0, on: str = "table"
) -> Attachment:
    """At rest on the table (its frame is 20 mm below its top) or, with `on`, at (x, y) on an object."""
    above = 0.02 if on == "table" else 0.03
    X_BO = RigidTransform(RollPitchYaw(0, 0, yaw), [x, y, above + height / 2])
    return Attachment(thing, on, X_BO.GetAsMatrix4(), support)


class Script:
    """Writes a plan down move by move; waypoints are given for the robot that moves, the other stands still."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.q = {r.name: [r.start] for r in problem.robots}
        self.mode: Mode = start_mode(problem)
        self.segments: list[Segment] = []
        self.transitions: list[Transition] = []

    def move(self, **targets) -> Script:
        """One synchronous step: robot name = (x, y, z) or (x, y, z, yaw)."""
        for name, rows in self.q.items():
            target = targets.get(name)
            rows.append(rows[-1] if target is None else np.array([*target, *rows[-1][len(target) :]], dtype=float))
        return self

    def _end(self) -> None:
        self.segments.append(Segment(self.mode, {n: np.array(rows) for n, rows in self.q.items()}))
        self.q = {n: [rows[-1]] for n, rows in self.q.items()}

    def change(self, kind: str, *news: Attachment) -> Script:
        """A transition of one kind that gives each object its new attachment."""
        self._end()
        actions = []
        for new in news:
            old = self.mode.of[new.object]
            robots = tuple(a.parent for a in (old, new) if a.held)
            actions.append(Action(kind, robots, old, new))
        self.transitions.append(Transition(tuple(actions)))
        self.mode = self.mode.replace(*news)
        return self

    def reach(self, subgoal: str, new: Attachment) -> Script:
        """A transition that reaches a subgoal and gives an object its new attachment."""
        self._end()
        action = Action("reach", tuple(self.problem.subgoal(subgoal).targets), self.mode.of[new.object], new, subgoal)
        self.transitions.append(Transition((action,)))
        self.mode = self.mode.after(self.transitions[-1])
        return self

    def plan(self) -> Plan:
        """The finished plan."""
        self._end()
        cost = plan_cost(self.segments, self.transitions, self.problem.cost)
        history = [{"time_s": 0.1, "cost": cost + 1.0}, {"time_s": 0.2, "cost": cost}]
        return Plan(self.problem, self.segments, self.transitions, cost, history, {"nodes": 7}, 3, {"mrtamp": "test"})


def valid_plan(problem: Problem) -> Plan:
    """The hand-made plan: cube to the target, bar over to the right gantry and down, both robots home."""
    s = Script(problem)
    s.move(left=(-0.4, 0, 0.2), right=(0.5, 0.1, 0.3)).move(left=(-0.4, 0, 0.04)).change("pick", grasp("cube", "left"))
    s.move(left=(-0.4, 0, 0.2)).move(left=(0, 0, 0.2, 0.3)).move(left=(0, 0, 0.04))
    s.change("place", put("cube", 0, 0, CUBE[2], "target", yaw=0.3))
    s.move(left=(0, 0, 0.2, 0)).move(left=(-0.47, -0.3, 0.2)).move(left=(-0.47, -0.3, 0.035))
    s.change("pick", grasp("bar", "left", offset=-0.07))
    s.move(left=(-0.47, -0.3, 0.3), right=(0.2, -0.3, 0.5)).move(left=(-0.07, -0.3, 0.3), right=(0.07, -0.3, 0.45))
    s.move(right=(0.07, -0.3, 0.3)).change("handover", grasp("bar", "right", offset=0.07))
    s.move(left=(-0.07, -0.3, 0.4)).move(left=(-0.5, 0, 0.3), right=(0.37, -0.3, 0.2)).move(right=(0.37, -0.3, 0.035))
    s.change("place", put("bar", 0.3, -0.3, BAR[2]))
    return s.move(right=(0.37, -0.3, 0.2)).move(right=(0.5, 0, 0.3)).plan()
