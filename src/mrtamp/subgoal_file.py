"""The `subgoals:`, `order:` and `collision:` of a problem file.

subgoals:
  - name: at_shelf
    robots: {left: {q: [0.5, 1.0]}}    # or {hand: pose X_WG}, or {in: {X_WC: pose, size: [x, y, z]}}
    after: [other]                     # left out: any time
    attach: {object: red, to: left}    # left out: nothing is attached
order: sequence                        # every subgoal after the one before it in the list; default: any
collision: {ignore: [[left, table], [left/hand, red]], tolerance: 0.0}
"""

from __future__ import annotations

from collections.abc import Mapping

from pydrake.math import RigidTransform

from mrtamp.model_files import model_facts
from mrtamp.placement_file import BodyFrames
from mrtamp.problem import AtConfiguration, Attach, CollisionRules, HandAt, HandIn, Robot, Subgoal, Target
from mrtamp.reading import Value, choices
from mrtamp.robot_file import read_configuration

ORDERS = ("any", "sequence")


def read_subgoals(
    values: list[Value], order: Value | None, robots: tuple[Robot, ...], frames: BodyFrames
) -> tuple[Subgoal, ...]:
    """The subgoals of a file, whose names are checked; with `order: sequence` each comes after the one before it."""
    names = [str(value.data["name"]) for value in values]
    sequence = order is not None and order.choice(ORDERS, "orders") == "sequence"
    reader = _SubgoalReader({r.name: r for r in robots}, frames, names)
    subgoals = tuple(
        reader.subgoal(value, before=names[i - 1] if sequence and i > 0 else None) for i, value in enumerate(values)
    )
    _check_acyclic(values, {s.name: s.after for s in subgoals})
    return subgoals


class _SubgoalReader:
    """Reads subgoals one by one; the names of all of them are known."""

    def __init__(self, robots: dict[str, Robot], frames: BodyFrames, names: list[str]) -> None:
        self.robots = robots
        self.frames = frames
        self.names = names

    def subgoal(self, value: Value, before: str | None) -> Subgoal:
        entries = value.mapping(("name", "robots"), ("after", "attach"))
        name = entries["name"].name()
        who = entries["robots"]
        if not isinstance(who.data, dict) or not who.data:
            raise who.wrong("a mapping from at least one robot to its target, such as {NAME: {q: [...]}}")
        for robot in who.data:
            if robot not in self.robots:
                raise who.error(f"found {robot!r}, {choices(self.robots, robot, 'robots')}")
        targets = {
            robot: self._target(target, self.robots[robot])
            for robot, target in who.mapping((), tuple(who.data)).items()
        }
        after = self._after(entries["after"], name) if "after" in entries else ()
        if before is not None and before not in after:
            after = (before, *after)
        attach = self._attach(entries["attach"], targets) if "attach" in entries else None
        return Subgoal(name, targets, after, attach)

    def _target(self, value: Value, robot: Robot) -> Target:
        forms = ("q", "hand", "in")
        entries = value.mapping(optional=forms)
        if len(entries) != 1:
            raise value.wrong("exactly one of {q: configuration}, {hand: pose}, {in: {X_WC: pose, size: [x, y, z]}}")
        if "q" in entries:
            if entries["q"].data == "home":
                return AtConfiguration(robot.home)
            facts = model_facts(robot.model.model, self.frames.package_paths)
            return AtConfiguration(read_configuration(entries["q"], robot.model.arm_joints, facts))
        self._check_hand(value, robot)
        if "hand" in entries:
            return HandAt(entries["hand"].pose())
        box = entries["in"].mapping(("size",), ("X_WC",))
        x, y, z = box["size"].numbers(3, "[x, y, z] full sizes in metres", low=0.0)
        return HandIn(box["X_WC"].pose() if "X_WC" in box else RigidTransform(), (x, y, z))

    def _check_hand(self, value: Value, robot: Robot) -> None:
        """The grasp frame of a robot without `grasp_frame` is its base, which goes nowhere."""
        if robot.model.grasp_body == robot.model.base:
            able = [name for name, r in self.robots.items() if r.model.grasp_body != r.model.base]
            raise value.error(
                f"found the hand of {robot.name!r}, whose robot file has no 'grasp_frame', "
                f"{choices(able, None, 'robots with one')}"
            )

    def _after(self, value: Value, name: str) -> tuple[str, ...]:
        others = [other for other in self.names if other != name]
        after = tuple(item.choice(others, "other subgoals") for item in value.items())
        if len(set(after)) != len(after):
            raise value.wrong("each subgoal once")
        return after

    def _attach(self, value: Value, targets: Mapping[str, Target]) -> Attach:
        entries = value.mapping(("object", "to"))
        thing = entries["object"].choice(self.frames.objects, "objects")
        to = entries["to"]
        if isinstance(to.data, str) and to.data in self.robots and to.data not in targets:
            raise to.error(
                f"found {to.data!r}, which is not at this subgoal, {choices(targets, None, 'robots of the subgoal')}"
            )
        parent = to.choice([*targets, *(name for name in self.frames.names if name != thing)], "parents")
        if parent in targets:
            self._check_hand(to, self.robots[parent])
        return Attach(thing, parent)


def _check_acyclic(values: list[Value], after: Mapping[str, tuple[str, ...]]) -> None:
    settled: set[str] = set()
    for value, name in zip(values, after, strict=True):
        ring = _round(name, after, [], settled)
        if ring:
            raise value.error(
                f"found subgoals that wait for each other: {' after '.join(ring)}, expected an order without a ring"
            )


def _round(name: str, after: Mapping[str, tuple[str, ...]], path: list[str], settled: set[str]) -> list[str] | None:
    """A ring of subgoals that is reached from `name`, which was reached along `path`."""
    if name in settled:
        return None
    if name in path:
        return [*path[path.index(name) :], name]
    for earlier in after[name]:
        ring = _round(earlier, after, [*path, name], settled)
        if ring:
            return ring
    settled.add(name)
    return None


def read_collision(value: Value, robots: tuple[Robot, ...], frames: BodyFrames) -> CollisionRules:
    """The `collision:` of a file: pairs that may overlap, and how much penetration is tolerated."""
    entries = value.mapping(optional=("ignore", "tolerance"))
    known = {r.name: r for r in robots}
    pairs = []
    for item in entries["ignore"].items() if "ignore" in entries else []:
        ends = item.items() if isinstance(item.data, list) else []
        if len(ends) != 2:
            raise item.wrong("a pair such as [left, table] or [left/hand, red]")
        one, two = (_thing(end, known, [*frames.statics, *frames.objects], frames) for end in ends)
        if one == two and one not in known:
            raise item.error(f"found {one!r} with itself, expected two different things (or a robot twice)")
        pairs.append((one, two))
    tolerance = entries["tolerance"].number(low=0.0) if "tolerance" in entries else 0.0
    return CollisionRules(tuple(pairs), tolerance)


def _thing(value: Value, robots: Mapping[str, Robot], others: list[str], frames: BodyFrames) -> str:
    """A robot, robot/body, static body or object."""
    text = value.text()
    robot, slash, body = text.partition("/")
    if not slash or robot not in robots:
        return value.choice([*robots, *others], "robots (alone or ROBOT/BODY), bodies and objects")
    facts = model_facts(robots[robot].model.model, frames.package_paths)
    if body not in facts.bodies:
        raise value.error(f"found {body!r}, {choices(facts.bodies, body, f'bodies of {robot}')}")
    return text
