"""Problem files (YAML) -> `Problem`, checked so that a wrong file gets one error that says what to change.

The format is described in `models/schema/problem.schema.json` and by the shipped tasks in `models/problems`.  Every
place where an object may rest becomes a `Support`: the regions of the file, and those synthesised from exact poses
("start of red", "goal of red") and from goals on objects ("top of blue").
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pydrake.math import RigidTransform

from mrtamp.goal_file import read_goal
from mrtamp.grasp_file import read_grasps
from mrtamp.model_files import model_facts, models_dir, resolve_model
from mrtamp.placement_file import BodyFrames, read_start, read_support
from mrtamp.problem import (
    WORLD,
    CollisionRules,
    Condition,
    CostWeights,
    MovableObject,
    Problem,
    ProblemError,
    Robot,
    RobotModel,
    Shape,
    StaticBody,
    Subgoal,
    Support,
)
from mrtamp.problem_writer import problem_to_dict
from mrtamp.reading import Document, Value, choices, data_document, read_document
from mrtamp.resting import FACES
from mrtamp.robot_file import load_robot_model, package_folders, read_configuration
from mrtamp.subgoal_file import read_collision, read_subgoals

__all__ = ["list_problems", "load_problem", "load_robot_model", "problem_from_dict", "problem_to_dict"]

PROBLEM_VERSION = 1
SHAPES = {
    "box": (3, "[x, y, z] full sizes"),
    "cylinder": (2, "[radius, length]"),
    "capsule": (2, "[radius, length of the cylindrical part]"),
    "sphere": (1, "[radius]"),
}
TRANSITIONS = ("pick", "place", "handover", "reach")


def load_problem(source: str | Path | dict[str, Any], **params: int) -> Problem:
    """Load a problem.

    Parameters
    ----------
    source
        The path of a problem file, the name of a shipped task (see `list_problems`), or the file's content as a dict.
    params
        Parameters of a generated task, as of `mrtamp.tasks.pick_place`: `robots`, `objects`, `layout_seed`.

    Raises
    ------
    ProblemError
        The problem is unknown or wrong; the message names the file, the line and the key, what was found, and what is
        valid.
    """
    if isinstance(source, dict):
        _refuse(params, "a dict")
        return problem_from_dict(source)
    generators = _generators()
    name = str(source)
    if name in generators:
        known = list(inspect.signature(generators[name]).parameters)
        for parameter in params:
            if parameter not in known:
                raise ProblemError(f"{name}: found the unknown parameter {parameter!r}, {choices(known, parameter)}")
        return generators[name](**params)
    shipped = _shipped_problems()
    file = shipped.get(name, Path(source).expanduser())
    if name not in shipped and not file.is_file():
        if file.is_dir():
            raise ProblemError(f"found {name!r}, expected a problem file ({file.resolve()} is a directory)")
        if "/" in name or name.endswith((".yaml", ".yml")):
            raise ProblemError(f"found {name!r}, expected an existing problem file (there is no {file.resolve()})")
        valid = choices([*shipped, *generators], name, "shipped problems")
        raise ProblemError(f"found the unknown problem {name!r}, {valid}, or the path of a problem file")
    _refuse(params, name)
    return _Reader(read_document(file)).problem()


def problem_from_dict(data: dict[str, Any], file: Path | str | None = None) -> Problem:
    """The problem that `data`, the content of a problem file, describes.

    `file` names the source in errors and is where relative paths start (the working directory without it).
    """
    return _Reader(data_document(data, Path(file) if file is not None else None)).problem()


def list_problems() -> dict[str, str]:
    """The shipped tasks: one line of description by name."""
    described = {}
    for name, file in _shipped_problems().items():
        data = read_document(file).data
        described[name] = str(data.get("description", "")) if isinstance(data, dict) else ""
    for name, generator in _generators().items():
        described[name] = (generator.__doc__ or "").strip().splitlines()[0]
    return described


def _shipped_problems() -> dict[str, Path]:
    return {file.stem: file for file in sorted((models_dir() / "problems").glob("*.yaml"))}


def _generators() -> dict[str, Callable[..., Problem]]:
    from mrtamp import instances, tasks  # here, because the generators build their problems with this module

    made = (
        tasks.pick_place,
        instances.clutter,
        instances.box_layout,
        instances.handover_layout,
        instances.stacking_layout,
    )
    return {generator.__name__: generator for generator in made}


def _refuse(params: dict[str, int], name: str) -> None:
    if params:
        raise ProblemError(
            f"found the parameters {', '.join(params)} for {name}, expected none: only "
            f"{', '.join(_generators())} have any"
        )


class _Reader:
    """Reads one document from top to bottom; names are all known before the first reference is resolved."""

    def __init__(self, document: Document) -> None:
        self.root = document.root
        # Subgoals are a goal, too.
        visits = isinstance(self.root.data, dict) and bool(self.root.data.get("subgoals"))
        goal = ("goal",)
        self.entries = self.root.mapping(
            ("mrtamp", "name", "robots", *(() if visits else goal)),
            (
                *(goal if visits else ()),
                "description",
                "packages",
                "world",
                "supports",
                "objects",
                "subgoals",
                "order",
                "collision",
                "cost",
            ),
        )
        self.entries["mrtamp"].version(PROBLEM_VERSION, "problem")
        self.packages = package_folders(self.entries.get("packages"))
        self.names: dict[str, str] = {WORLD: "the world frame"}
        self.models: dict[str, RobotModel] = {}  # by reference: a task of eight equal arms reads its arm once

    def problem(self) -> Problem:
        """The whole problem."""
        robots = tuple(self._robot(value) for value in self._named("robots"))
        if not robots:
            raise self.entries["robots"].wrong("at least one robot")
        statics = tuple(self._static(value) for value in self._named("world"))
        object_values = self._named("objects")
        support_values = self._named("supports")
        subgoal_values = self._named("subgoals")
        openings = {r.name: r.model.gripper.max_width if r.model.gripper else 0.0 for r in robots}
        objects = [self._object(value, openings) for value in object_values]
        frames = BodyFrames(statics, {o.name: o for o in objects}, self.packages)
        regions = [read_support(value, frames) for value in support_values]
        objects, starts = self._starts(object_values, objects, regions, frames)
        subgoals = read_subgoals(subgoal_values, self.entries.get("order"), robots, frames)
        goal, goals = self._goal(robots, subgoals, [*regions, *starts], frames)
        description = self.entries["description"].text() if "description" in self.entries else ""
        return Problem(
            name=self.entries["name"].name(),
            robots=robots,
            statics=statics,
            supports=(*regions, *starts, *goals),
            objects=tuple(objects),
            goal=goal,
            cost=self._cost(),
            description=description.strip(),
            subgoals=subgoals,
            collision=self._collision(robots, frames),
            package_paths=self.packages,
            source=self.root.data,
        )

    def _named(self, section: str) -> list[Value]:
        """The entries of a section, their names registered; a name may be used once in the whole file."""
        values = self.entries[section].items() if section in self.entries else []
        for value in values:
            if not isinstance(value.data, dict) or "name" not in value.data:
                raise value.wrong("a mapping with a 'name'")
            entry = Value(value.document, value.data["name"], f"{value.path}.name")
            name = entry.name()
            if name in self.names:
                raise entry.error(
                    f"found the name {name!r} again, expected a new one: it is taken by {self.names[name]}"
                )
            self.names[name] = value.path
        return values

    def _robot(self, value: Value) -> Robot:
        entries = value.mapping(("name", "model"), ("X_WB", "home", "start"))
        model = self._robot_model(entries["model"])
        facts = model_facts(model.model, self.packages)
        home = read_configuration(
            entries.get("home", Value(value.document, list(model.home), f"{value.path}.home")), model.arm_joints, facts
        )
        start = read_configuration(entries["start"], model.arm_joints, facts) if "start" in entries else home
        return Robot(entries["name"].name(), model, _pose(entries, "X_WB"), home, start)

    def _robot_model(self, value: Value) -> RobotModel:
        reference = value.text()
        if reference not in self.models:
            try:
                self.models[reference] = load_robot_model(reference, self.packages, value.document.directory)
            except ProblemError as error:
                raise value.error(str(error)) from None
        return self.models[reference]

    def _static(self, value: Value) -> StaticBody:
        entries = value.mapping(("name",), ("shape", "model", "X_WB", "color"))
        shape, model = self._solid(value, entries)
        body = StaticBody(entries["name"].name(), _pose(entries, "X_WB"), shape, model)
        return dataclasses.replace(body, color=entries["color"].color()) if "color" in entries else body

    def _solid(self, value: Value, entries: dict[str, Value]) -> tuple[Shape | None, str | None]:
        """Exactly one of a primitive shape and a model file."""
        if ("shape" in entries) == ("model" in entries):
            found = "both 'shape' and 'model'" if "shape" in entries else "neither 'shape' nor 'model'"
            raise value.error(f"found {found}, expected exactly one of them")
        if "shape" in entries:
            return _shape(entries["shape"]), None
        try:
            model = resolve_model(entries["model"].text(), value.document.directory, self.packages)
            facts = model_facts(model, self.packages)
        except ProblemError as error:
            raise entries["model"].error(str(error)) from None
        if len(facts.models) > 1:
            raise entries["model"].error(f"{model} holds the models {', '.join(facts.models)}, expected one")
        return None, model

    def _object(self, value: Value, openings: dict[str, float]) -> MovableObject:
        """The object, its start still at the world's origin: starts may refer to objects further down the file."""
        entries = value.mapping(("name", "start"), ("shape", "model", "mass", "color", "resting_faces", "grasps"))
        shape, model = self._solid(value, entries)
        if model is not None and not model_facts(model, self.packages).rigid:
            raise entries["model"].error(f"found {model}, which has moving joints, expected one rigid body")
        faces: tuple[str, ...] = ("-z",)
        if "resting_faces" in entries:
            faces = tuple(item.choice(FACES, "faces") for item in entries["resting_faces"].items())
            if not faces or len(set(faces)) != len(faces):
                raise entries["resting_faces"].wrong(f"at least one of {', '.join(FACES)}, each once")
        optional: dict[str, Any] = {}
        if "mass" in entries:
            optional["mass"] = entries["mass"].number(above=0.0)
        if "color" in entries:
            optional["color"] = entries["color"].color()
        return MovableObject(
            name=entries["name"].name(),
            start_on=WORLD,
            start_X_BO=RigidTransform(),
            shape=shape,
            model=model,
            resting_faces=faces,
            grasps=read_grasps(entries.get("grasps"), value, shape, openings),
            **optional,
        )

    def _starts(
        self, values: list[Value], objects: list[MovableObject], regions: list[Support], frames: BodyFrames
    ) -> tuple[list[MovableObject], list[Support]]:
        """Objects with their starts, in file order; an object that stands on another is placed after it."""
        pending = {
            o.name: Value(v.document, v.data["start"], f"{v.path}.start") for o, v in zip(objects, values, strict=True)
        }
        supports: list[Support] = []
        while pending:
            waiting = len(pending)
            for name, value in list(pending.items()):
                placed = read_start(value, frames.objects[name], regions, frames, set(pending))
                if placed is not None:
                    frames.place(placed.object)
                    supports.extend(placed.supports)
                    del pending[name]
            if len(pending) == waiting:
                value = next(iter(pending.values()))
                ring = ", ".join(pending)
                raise value.error(
                    f"found objects that start on each other ({ring}), expected one of them on a body of the world"
                )
        order = [o.name for o in objects]
        supports.sort(key=lambda s: order.index(s.objects[0]) if s.objects else -1)
        return [frames.objects[name] for name in order], supports

    def _goal(
        self, robots: tuple[Robot, ...], subgoals: tuple[Subgoal, ...], supports: list[Support], frames: BodyFrames
    ) -> tuple[tuple[Condition, ...], list[Support]]:
        """The conditions of the goal; there may be none where there are subgoals."""
        if subgoals and not ("goal" in self.entries and self.entries["goal"].items()):
            return (), []
        return read_goal(self.entries["goal"], robots, subgoals, supports, frames)

    def _collision(self, robots: tuple[Robot, ...], frames: BodyFrames) -> CollisionRules:
        return (
            read_collision(self.entries["collision"], robots, frames)
            if "collision" in self.entries
            else CollisionRules()
        )

    def _cost(self) -> CostWeights:
        if "cost" not in self.entries:
            return CostWeights()
        entries = self.entries["cost"].mapping(optional=("makespan", "path_length", "transitions"))
        weights = {key: entries[key].number(low=0.0) for key in ("makespan", "path_length") if key in entries}
        transitions: dict[str, float] = {}
        if "transitions" in entries:
            kinds = entries["transitions"].mapping(optional=TRANSITIONS)
            transitions = {kind: weight.number(low=0.0) for kind, weight in kinds.items()}
        cost = CostWeights(**weights, transitions=transitions)
        if cost.makespan == 0 and cost.path_length == 0:
            raise self.entries["cost"].wrong("a positive weight for 'makespan' or 'path_length'")
        return cost


def _pose(entries: dict[str, Value], key: str) -> RigidTransform:
    return entries[key].pose() if key in entries else RigidTransform()


def _shape(value: Value) -> Shape:
    entries = value.mapping(optional=tuple(SHAPES))
    if len(entries) != 1:
        raise value.wrong(f"exactly one of {', '.join(SHAPES)}")
    (kind, size) = next(iter(entries.items()))
    count, meaning = SHAPES[kind]
    if count == 1 and not isinstance(size.data, list):
        return Shape(kind, (size.number(above=0.0),))
    return Shape(kind, size.numbers(count, meaning, above=0.0))
