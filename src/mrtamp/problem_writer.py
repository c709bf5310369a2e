"""`Problem` -> plain data in the problem file's own format, standing alone: the inverse of `mrtamp.problem_file`."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydrake.math import RigidTransform

from mrtamp.problem import (
    AntipodalGrasps,
    AtConfiguration,
    AtPose,
    Condition,
    ExplicitGrasp,
    HandAt,
    HeldBy,
    InRegion,
    MovableObject,
    Problem,
    ProblemError,
    RobotAt,
    Shape,
    StaticBody,
    Subgoal,
    Support,
    Target,
)
from mrtamp.reading import pose_to_dict
from mrtamp.robot_file import robot_reference


def problem_to_dict(problem: Problem) -> dict[str, Any]:
    """`problem` as JSON-able data that `problem_from_dict` reads back to an equal problem.

    The data stands alone: defaults are spelled out, model files are absolute paths or `package://` URLs, and shipped
    robots are named.  It is written from the dataclasses, so it is true also of a problem built or changed in Python.
    """
    data: dict[str, Any] = {"mrtamp": 1, "name": problem.name}
    if problem.description:
        data["description"] = problem.description
    if problem.package_paths:
        data["packages"] = [str(path) for path in problem.package_paths]
    data["robots"] = [
        {
            "name": robot.name,
            "model": robot_reference(robot.model),
            "X_WB": pose_to_dict(robot.X_WB),
            "home": np.asarray(robot.home).tolist(),
            "start": np.asarray(robot.start).tolist(),
        }
        for robot in problem.robots
    ]
    data["world"] = [
        {"name": body.name, **_solid(body), "X_WB": pose_to_dict(body.X_WB), "color": list(body.color)}
        for body in problem.statics
    ]
    synthesised = _synthesised(problem)
    data["supports"] = [_support(support) for support in problem.supports if support.name not in synthesised]
    data["objects"] = [_object(thing) for thing in problem.objects]
    if problem.subgoals:
        data["subgoals"] = [_subgoal(subgoal) for subgoal in problem.subgoals]
    rules = problem.collision
    if rules.ignore or rules.tolerance:
        data["collision"] = {"ignore": [list(pair) for pair in rules.ignore], "tolerance": rules.tolerance}
    data["goal"] = [_condition(condition, problem) for condition in problem.goal]
    cost = problem.cost
    data["cost"] = {
        "makespan": cost.makespan,
        "path_length": cost.path_length,
        "transitions": dict(cost.transitions),
    }
    return data


def _synthesised(problem: Problem) -> set[str]:
    """The names of the supports that reading the file makes again from starts and goals."""
    names = {f"start of {thing.name}" for thing in problem.objects}
    for condition in problem.goal:
        if isinstance(condition, AtPose):
            names.add(f"goal of {condition.object}" if condition.X_BO is not None else f"top of {condition.on}")
    return names


def _solid(body: StaticBody | MovableObject) -> dict[str, Any]:
    if body.shape is not None:
        return {"shape": _shape(body.shape)}
    return {"model": body.model}


def _shape(shape: Shape) -> dict[str, list[float]]:
    return {shape.kind: list(shape.size)}


def _support(support: Support) -> dict[str, Any]:
    data: dict[str, Any] = {
        "name": support.name,
        "on": support.body,
        "X_BS": pose_to_dict(support.X_BS),
        "size": list(support.size),
    }
    if support.margin:
        data["margin"] = support.margin
    if support.yaw != (-np.pi, np.pi):
        data["yaw_deg"] = np.degrees(support.yaw).tolist()
    if support.X_BO is not None:
        data["X_BO"] = pose_to_dict(support.X_BO)
    if support.objects is not None:
        data["objects"] = list(support.objects)
    if support.color is not None:
        data["color"] = list(support.color)
    return data


def _object(thing: MovableObject) -> dict[str, Any]:
    start: dict[str, Any] = {"on": thing.start_on}
    if thing.start_support is not None and thing.start_support != f"start of {thing.name}":
        start = {"in": thing.start_support}
    start["X_BO"] = pose_to_dict(thing.start_X_BO)
    return {
        "name": thing.name,
        **_solid(thing),
        "mass": thing.mass,
        "color": list(thing.color),
        "start": start,
        "resting_faces": list(thing.resting_faces),
        "grasps": [_grasp(grasp) for grasp in thing.grasps],
    }


def _grasp(grasp: AntipodalGrasps | ExplicitGrasp) -> dict[str, Any]:
    data: dict[str, Any]
    if isinstance(grasp, AntipodalGrasps):
        family = {"approach": list(grasp.approaches), "offset": grasp.offset, "depth": list(grasp.depth)}
        data = {"antipodal": family}
    else:
        data = {"X_OG": pose_to_dict(grasp.X_OG), "width": grasp.width}
    if grasp.robots is not None:
        data["robots"] = list(grasp.robots)
    return data


def _subgoal(subgoal: Subgoal) -> dict[str, Any]:
    targets = {robot: _target(target) for robot, target in subgoal.targets.items()}
    data: dict[str, Any] = {"name": subgoal.name, "robots": targets}
    if subgoal.after:
        data["after"] = list(subgoal.after)
    if subgoal.attach is not None:
        data["attach"] = {"object": subgoal.attach.object, "to": subgoal.attach.parent}
    return data


def _target(target: Target) -> dict[str, Any]:
    if isinstance(target, AtConfiguration):
        return {"q": np.asarray(target.q).tolist()}
    if isinstance(target, HandAt):
        return {"hand": pose_to_dict(target.X_WG)}
    return {"in": {"X_WC": pose_to_dict(target.X_WC), "size": list(target.size)}}


def _condition(condition: Condition, problem: Problem) -> dict[str, Any]:
    if isinstance(condition, InRegion):
        return {"object": condition.object, "in": condition.region}
    if isinstance(condition, HeldBy):
        return {"object": condition.object, "held_by": condition.robot}
    if isinstance(condition, AtPose):
        data: dict[str, Any] = {"object": condition.object, "on": condition.on}
        if condition.X_BO is not None:
            data["X_BO"] = pose_to_dict(_pose(condition))
        return data
    if isinstance(condition, RobotAt):
        if np.array_equal(condition.q, problem.robot(condition.robot).home):
            return {"robot": condition.robot, "at": "home"}
        return {"robot": condition.robot, "at": np.asarray(condition.q).tolist()}
    raise ProblemError(f"found the condition {condition!r}, which no problem file can state")


def _pose(condition: AtPose) -> RigidTransform:
    assert condition.X_BO is not None
    return condition.X_BO
