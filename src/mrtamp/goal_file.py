"""The `goal:` of a problem file -> conditions, and the supports that exact poses and goals on objects synthesise.

Each object and each robot may end in one place; a robot without a goal may end anywhere.
"""

from __future__ import annotations

from pydrake.math import RigidTransform

from mrtamp.model_files import model_facts
from mrtamp.placement_file import BodyFrames, check_admits, check_rest, exact_support
from mrtamp.problem import AtPose, Condition, HeldBy, InRegion, MovableObject, Robot, RobotAt, Subgoal, Support
from mrtamp.reading import Value, choices
from mrtamp.robot_file import read_configuration


def read_goal(
    value: Value,
    robots: tuple[Robot, ...],
    subgoals: tuple[Subgoal, ...],
    supports: list[Support],
    frames: BodyFrames,
) -> tuple[tuple[Condition, ...], list[Support]]:
    """The conditions of `goal:` and the supports they synthesise."""
    attached = {(s.attach.object, s.attach.parent) for s in subgoals if s.attach is not None}
    regions = {s.name: s for s in supports if " " not in s.name}
    reader = _GoalReader({r.name: r for r in robots}, frames, regions, attached)
    items = value.items()
    if not items:
        raise value.wrong("at least one condition, such as {object: NAME, in: REGION}")
    conditions = [reader.condition(item) for item in items]
    reader.check_acyclic()
    return tuple(conditions), reader.supports


class _GoalReader:
    """Reads conditions one by one, remembering what is already decided: each object and robot may end in one place."""

    def __init__(
        self,
        robots: dict[str, Robot],
        frames: BodyFrames,
        regions: dict[str, Support],
        attached: set[tuple[str, str]],
    ) -> None:
        self.robots = robots
        self.frames = frames
        self.regions = regions
        self.attached = attached  # what subgoals move needs no grasps, and where they attach it no gripper
        self.supports: list[Support] = []
        self._ends: dict[str, tuple[Value, str]] = {}  # object -> (its condition, the body it ends on)
        self._taken: dict[str, Value] = {}

    def condition(self, value: Value) -> Condition:
        if not isinstance(value.data, dict) or ("object" in value.data) == ("robot" in value.data):
            raise value.wrong("{object: NAME, in/at/on/held_by: ...} or {robot: NAME, at: ...}")
        return self._robot(value) if "robot" in value.data else self._object(value)

    def _robot(self, value: Value) -> RobotAt:
        entries = value.mapping(("robot", "at"))
        robot = self.robots[entries["robot"].choice(self.robots, "robots")]
        self._take(entries["robot"], f"a goal for the robot {robot.name!r}")
        if isinstance(entries["at"].data, str):
            if entries["at"].data != "home":
                raise entries["at"].wrong("'home' or a list of joint positions")
            return RobotAt(robot.name, robot.home)
        facts = model_facts(robot.model.model, self.frames.package_paths)
        return RobotAt(robot.name, read_configuration(entries["at"], robot.model.arm_joints, facts))

    def _object(self, value: Value) -> Condition:
        entries = value.mapping(("object",), ("in", "at", "on", "X_BO", "held_by"))
        thing = self.frames.objects[entries["object"].choice(self.frames.objects, "objects")]
        self._take(entries["object"], f"a goal for the object {thing.name!r}")
        if not thing.grasps and all(name != thing.name for name, _ in self.attached):
            raise entries["object"].error(
                f"found {thing.name!r}, which has no grasps, expected 'grasps:' on an object with a goal"
            )
        if "in" in entries:
            entries = value.mapping(("object", "in"))
            region = self.regions[entries["in"].choice(self.regions, "supports")]
            check_admits(entries["in"], region, thing)
            self._end(entries["in"], thing, region.body)
            return InRegion(thing.name, region.name)
        if "held_by" in entries:
            entries = value.mapping(("object", "held_by"))
            return self._held(entries["held_by"], thing)
        if "on" not in entries:
            raise value.wrong("one of the keys in, on, held_by, or 'at' with 'on'")
        body = entries["on"].choice(self.frames.names, "bodies")
        self._end(entries["on"], thing, body)
        if "at" in entries:
            entries = value.mapping(("object", "at", "on"))
            if body in self.frames.objects:
                raise entries["at"].error(
                    f"found a world pose on the object {body!r}, expected 'X_BO', its pose relative to {body!r}"
                )
            X_BO = self.frames.X_WB(body).inverse() @ entries["at"].pose()
            return self._exact(entries["at"], thing, body, X_BO)
        if "X_BO" in entries:
            return self._exact(entries["X_BO"], thing, body, entries["X_BO"].pose())
        if body not in self.frames.objects:
            raise value.error(f"found no pose on {body!r}, expected 'at' with the pose, or 'in' with a region on it")
        return self._on_top(entries["on"], thing, body)

    def _exact(self, value: Value, thing: MovableObject, body: str, X_BO: RigidTransform) -> AtPose:
        check_rest(value, thing, body, X_BO, self.frames.top(body), frames=self.frames)
        self.supports.append(exact_support(f"goal of {thing.name}", body, X_BO, thing, self.frames))
        return AtPose(thing.name, body, X_BO)

    def _on_top(self, value: Value, thing: MovableObject, body: str) -> AtPose:
        top = self.frames.top(body)
        if top is None:
            raise value.error(f"found {body!r}, which has no flat top, expected an object with one")
        self._take(value, f"a goal on top of {body!r}")
        self.supports.append(Support(f"top of {body}", body, top[0], (0.0, 0.0)))
        return AtPose(thing.name, body, None)

    def _held(self, value: Value, thing: MovableObject) -> HeldBy:
        robot = value.choice(self.robots, "robots")
        if self.robots[robot].model.gripper is None and (thing.name, robot) not in self.attached:
            able = [name for name, r in self.robots.items() if r.model.gripper]
            raise value.error(f"found {robot!r}, which has no gripper, {choices(able, None, 'robots with a gripper')}")
        self._take(value, f"an object held by {robot!r}")
        return HeldBy(thing.name, robot)

    def _take(self, value: Value, what: str) -> None:
        if what in self._taken:
            raise value.error(f"found {what} again, expected one; the first is at {self._taken[what].path}")
        self._taken[what] = value

    def _end(self, value: Value, thing: MovableObject, body: str) -> None:
        if body == thing.name:
            raise value.error(f"found a goal of {body!r} on itself, expected another body")
        self._ends[thing.name] = (value, body)

    def check_acyclic(self) -> None:
        for name, (value, _) in self._ends.items():
            chain = [name]
            while chain[-1] in self._ends:
                chain.append(self._ends[chain[-1]][1])
                if chain[-1] == name:
                    raise value.error(
                        f"found goals that go round: {' on '.join(chain)}, expected a chain that ends on the world"
                    )
                if len(chain) > len(self._ends) + 1:
                    break  # a round further down, reported at one of its own members
