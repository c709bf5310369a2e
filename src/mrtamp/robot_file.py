"""Robot description files (models/robots/*.yaml) -> `RobotModel`: any URDF or SDF arm, without code.

    mrtamp_robot: 1
    name: panda
    model: panda.urdf                 # path relative to this file, or package://...
    base: panda_link0                 # the body that is welded in place
    arm_joints: [panda_joint1, ...]
    home: [0.0, ...]                  # one value per arm joint (rad)
    gripper: {bodies: [...], joints: {finger1: 0.5, finger2: 0.5}, max_width: 0.08}    # left out: the arm only moves
    grasp_frame: {body: panda_hand, X_BG: {translation: [0, 0, 0.1034]}}
    collision_exceptions: [[panda_link5, panda_link7]]

The model is parsed by Drake here, so every body and joint that the file names is known to exist.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform

from mrtamp.model_files import ModelFacts, model_facts, models_dir, resolve_model
from mrtamp.problem import Gripper, ProblemError, RobotModel
from mrtamp.reading import Document, Value, choices, read_document

ROBOT_VERSION = 1


def shipped_robots() -> dict[str, Path]:
    """The robot descriptions that come with mrtamp, by name."""
    return {file.stem: file for file in sorted((models_dir() / "robots").glob("*.yaml"))}


def load_robot_model(
    name_or_path: str | Path, package_paths: tuple[Path, ...] = (), directory: Path | None = None
) -> RobotModel:
    """Read a robot description.

    Parameters
    ----------
    name_or_path
        The name of a shipped robot ("panda"), or the path of a description file.
    package_paths
        Folders that contain a package.xml, for `package://` references.
    directory
        Where a relative path starts; the working directory by default.

    Raises
    ------
    ProblemError
        The description is unknown or wrong.
    """
    reference = str(name_or_path)
    shipped = shipped_robots()
    if reference in shipped:
        return read_robot(read_document(shipped[reference]), package_paths, shipped[reference])
    file = ((directory or Path.cwd()) / Path(reference).expanduser()).resolve()
    if not file.is_file():
        if "/" in reference or reference.endswith((".yaml", ".yml")):
            raise ProblemError(f"found {reference!r}, expected an existing robot file (there is no {file})")
        known = choices(shipped, reference, "shipped robots")
        raise ProblemError(f"found the unknown robot model {reference!r}, {known}, or the path of a robot file")
    return read_robot(read_document(file), package_paths, file)


def read_robot(document: Document, package_paths: tuple[Path, ...] = (), file: Path | None = None) -> RobotModel:
    """The `RobotModel` described by `document`, checked against its parsed model."""
    entries = document.root.mapping(
        ("mrtamp_robot", "name", "model", "base", "arm_joints", "home"),
        ("description", "gripper", "grasp_frame", "collision_exceptions"),
    )
    entries["mrtamp_robot"].version(ROBOT_VERSION, "robot")
    try:
        model = resolve_model(entries["model"].text(), document.directory, package_paths)
        facts = model_facts(model, package_paths)
    except ProblemError as error:
        raise entries["model"].error(str(error)) from None
    _check_whole(entries["model"], facts)
    arm_joints = tuple(
        item.choice(facts.joints, "moving joints of the model") for item in entries["arm_joints"].items()
    )
    if not arm_joints or len(set(arm_joints)) != len(arm_joints):
        raise entries["arm_joints"].wrong("a list of at least one joint, each once")
    home = read_configuration(entries["home"], arm_joints, facts)
    gripper = _gripper(entries["gripper"], arm_joints, facts) if "gripper" in entries else None
    base = entries["base"].choice(facts.bodies, "bodies of the model")
    grasp_body, X_BG = base, RigidTransform()
    if "grasp_frame" in entries:
        frame = entries["grasp_frame"].mapping(("body",), ("X_BG",))
        grasp_body = frame["body"].choice(facts.bodies, "bodies of the model")
        X_BG = frame["X_BG"].pose() if "X_BG" in frame else X_BG
    elif gripper is not None:
        raise document.root.error("found a gripper but no key 'grasp_frame', expected {body: ..., X_BG: ...}")
    return RobotModel(
        name=entries["name"].name(),
        model=model,
        base=base,
        arm_joints=arm_joints,
        home=tuple(float(q) for q in home),
        gripper=gripper,
        grasp_body=grasp_body,
        X_BG=X_BG,
        collision_exceptions=_exceptions(entries.get("collision_exceptions"), facts),
        file=file,
    )


def _check_whole(value: Value, facts: ModelFacts) -> None:
    """The models of the file are one robot that stands free, and no two of its parts have the same name."""
    if facts.repeated:
        raise value.error(
            f"found several bodies or joints named {', '.join(facts.repeated)} (in the models "
            f"{', '.join(facts.models)}), expected different names within one robot"
        )
    if facts.anchored:
        raise value.error(
            f"found {facts.anchored[0]!r} fixed to the world, expected a model that stands free: X_WB in the problem "
            "fixes its base"
        )
    if len(facts.roots) > 1:
        raise value.error(
            f"found parts that nothing connects ({', '.join(facts.roots)}), expected joints or welds between them"
        )


def _gripper(value: Value, arm_joints: tuple[str, ...], facts: ModelFacts) -> Gripper:
    entries = value.mapping(("bodies", "joints", "max_width"))
    bodies = tuple(item.choice(facts.bodies, "bodies of the model") for item in entries["bodies"].items())
    free = [joint for joint in facts.joints if joint not in arm_joints]
    joints_value = entries["joints"]
    if not isinstance(joints_value.data, dict):
        raise joints_value.wrong("a mapping from each finger joint to its position per metre of opening width")
    joints = {}
    for joint, factor in joints_value.mapping(optional=tuple(joints_value.data)).items():
        if joint not in free:
            raise factor.error(f"found {joint!r}, {choices(free, joint, 'joints beside the arm joints')}")
        joints[joint] = factor.number()
    width = entries["max_width"].number(above=0.0)
    for joint, factor_number in joints.items():
        lower, upper = facts.joints[joint]
        if not lower[0] - 1e-6 <= factor_number * width <= upper[0] + 1e-6:
            raise entries["max_width"].error(
                f"found {width:g}, which puts {joint} at {factor_number * width:g}, expected within its limits "
                f"{lower[0]:g} to {upper[0]:g}"
            )
    return Gripper(bodies, joints, width)


def _exceptions(value: Value | None, facts: ModelFacts) -> tuple[tuple[str, str], ...]:
    pairs = []
    for item in value.items() if value else []:
        names = [body.choice(facts.bodies, "bodies of the model") for body in item.items()]
        if len(names) != 2:
            raise item.wrong("a pair of bodies")
        pairs.append((names[0], names[1]))
    return tuple(pairs)


def read_configuration(value: Value, arm_joints: tuple[str, ...], facts: ModelFacts) -> np.ndarray:
    """The configuration (n,) at `value`: one number per arm joint, each within the joint's limits."""
    q = value.numbers(len(arm_joints), f"one per arm joint ({', '.join(arm_joints)})")
    for item, position, joint in zip(value.items(), q, arm_joints, strict=True):
        lower, upper = (float(limit[0]) for limit in facts.joints[joint])
        if not lower <= position <= upper:
            raise item.error(f"found {position:g} for {joint}, expected within its limits {lower:g} to {upper:g}")
    return np.array(q)


def robot_reference(model: RobotModel) -> str:
    """How a problem file refers to `model`: the name of a shipped robot, or an absolute path."""
    if model.file is None:
        raise ProblemError(
            f"the robot model {model.name!r} was not read from a file, so no problem file can refer to it"
        )
    return model.file.stem if shipped_robots().get(model.file.stem) == model.file else str(model.file)


def package_folders(value: Value | None) -> tuple[Path, ...]:
    """Read the folders listed under `packages:`, made absolute; each must contain a package.xml."""
    folders: list[Path] = []
    for item in value.items() if value else []:
        folder = (item.document.directory / Path(item.text()).expanduser()).resolve()
        if not (folder / "package.xml").is_file():
            raise item.wrong(f"a folder that contains a package.xml (there is no {folder / 'package.xml'})")
        folders.append(folder)
    return tuple(folders)
