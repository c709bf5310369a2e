"""Model files: where they are, how Drake parses them, and the facts about them that a problem file is checked against.

A model reference is a path (relative to the file that mentions it) or a `package://NAME/...` URL.  Packages are found
in the folders of the problem's `packages:` and of the environment variable MRTAMP_PACKAGE_PATH; nothing is downloaded.
"""

from __future__ import annotations

import functools
import os
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.multibody.parsing import PackageMap, Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import DiagramBuilder

from mrtamp.problem import ProblemError

PACKAGE_PATH_VARIABLE = "MRTAMP_PACKAGE_PATH"
_SUFFIXES = (".urdf", ".sdf", ".xml", ".dmd.yaml")


def models_dir() -> Path:
    """The folder of shipped models: inside the installed package, or at the top of the source tree."""
    installed = Path(__file__).resolve().parent / "models"
    return installed if installed.is_dir() else Path(__file__).resolve().parents[2] / "models"


def all_package_paths(package_paths: tuple[Path, ...] = ()) -> tuple[Path, ...]:
    """`package_paths` followed by the folders of MRTAMP_PACKAGE_PATH."""
    variable = os.environ.get(PACKAGE_PATH_VARIABLE, "")
    return tuple(package_paths) + tuple(Path(entry) for entry in variable.split(os.pathsep) if entry)


def package_map(package_paths: tuple[Path, ...] = ()) -> PackageMap:
    """Drake's packages with those of `package_paths` and MRTAMP_PACKAGE_PATH; nothing in it needs a download."""
    packages = PackageMap()
    # Drake's own entry for drake_models is a remote archive; it would shadow a local copy and reach for the network.
    if packages.Contains("drake_models"):
        packages.Remove("drake_models")
    for folder in all_package_paths(package_paths):
        file = folder / "package.xml"
        if not file.is_file():
            raise ProblemError(f"{PACKAGE_PATH_VARIABLE}: found {str(folder)!r}, expected folders with a package.xml")
        packages.AddPackageXml(file)
    return packages


def make_parser(
    plant: MultibodyPlant, scene_graph: SceneGraph | None = None, package_paths: tuple[Path, ...] = ()
) -> Parser:
    """Make a Drake parser for `plant` that knows the packages of `package_map` and never downloads."""
    parser = Parser(plant=plant, scene_graph=scene_graph) if scene_graph is not None else Parser(plant)
    packages = parser.package_map()
    if packages.Contains("drake_models"):
        packages.Remove("drake_models")
    packages.AddMap(package_map(package_paths))
    return parser


def add_models(plant: MultibodyPlant, parser: Parser, file: str, owner: str) -> tuple[ModelInstanceIndex, ...]:
    """Add every model of `file` (a path or a `package://` URL) to `plant`, and return their model instances.

    A file may hold several models: Drake model directives, or an SDF file that includes others.  Each instance is
    renamed to `owner::NAME`, so that the same file can be added for the next owner.

    Raises
    ------
    ProblemError
        Drake cannot parse the file.
    """
    # Drake's own renaming (`Parser.SetAutoRenaming`) forgets that `<include merge="true">` refers to the old name.
    before = plant.num_model_instances()
    try:
        if file.startswith("package://"):
            parser.AddModelsFromUrl(file)
        else:
            parser.AddModels(file)
    except Exception as error:  # Drake raises RuntimeError, but its parsers promise nothing
        raise ProblemError(f"Drake cannot parse the model {file}: {_one_line(error)}") from None
    # What the parser returns leaves out models inside models.
    added = tuple(ModelInstanceIndex(i) for i in range(before, plant.num_model_instances()))
    for instance in added:
        plant.RenameModelInstance(instance, f"{owner}::{plant.GetModelInstanceName(instance)}")
    return added


def resolve_model(reference: str, directory: Path, package_paths: tuple[Path, ...] = ()) -> str:
    """The model `reference` as an absolute path, or unchanged if it is a `package://` URL of a known package.

    Raises
    ------
    ProblemError
        The file does not exist, is of an unknown kind, or its package is unknown.
    """
    file = _model_path(reference, directory, package_paths)
    if not file.name.endswith(_SUFFIXES):
        raise ProblemError(f"found {reference!r}, expected a model file ending in {', '.join(_SUFFIXES)}")
    if not file.is_file():
        raise ProblemError(f"found {reference!r}, expected an existing model file (there is no {file})")
    return reference if reference.startswith("package://") else str(file)


def _model_path(reference: str, directory: Path, package_paths: tuple[Path, ...]) -> Path:
    if "://" not in reference:
        return (directory / Path(reference).expanduser()).resolve()
    scheme, rest = reference.split("://", 1)
    if scheme == "file":
        return Path(rest)
    if scheme != "package":
        raise ProblemError(f"found {reference!r}, expected a path or package://NAME/PATH")
    name, _, path = rest.partition("/")
    packages = package_map(package_paths)
    if not packages.Contains(name):
        known = ", ".join(sorted(packages.GetPackageNames()))
        raise ProblemError(
            f"found the unknown package {name!r} in {reference!r}, expected one of: {known}; to add one, list a folder "
            f"that contains its package.xml under 'packages:' in the problem file or in {PACKAGE_PATH_VARIABLE}"
        )
    return Path(packages.GetPath(name)) / path


@dataclass(frozen=True, eq=False)
class ModelFacts:
    """What a parsed model file consists of.

    `models` names the models in it that have bodies; `joints` maps each joint with one degree of freedom to its lower
    and upper limits; `prismatic` are those that slide.  A `rigid` model is a single free body, or several welded to
    each other.  `repeated` are the names that several bodies or several moving joints have, `roots` the bodies that
    nothing carries, `anchored` those that the file itself fixes to the world.
    """

    reference: str
    models: tuple[str, ...]
    bodies: tuple[str, ...]
    joints: dict[str, tuple[np.ndarray, np.ndarray]]
    rigid: bool
    lower: np.ndarray | None
    upper: np.ndarray | None
    prismatic: frozenset[str] = frozenset()
    repeated: tuple[str, ...] = ()
    roots: tuple[str, ...] = ()
    anchored: tuple[str, ...] = ()

    def bounding_box(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners (3,), (3,) of the box around all collision geometry, in the frame of the model's base body."""
        if self.lower is None or self.upper is None:
            raise ProblemError(f"{self.reference} has no collision geometry, expected at least one collision shape")
        return self.lower, self.upper


def model_facts(reference: str, package_paths: tuple[Path, ...] = ()) -> ModelFacts:
    """Parse the model `reference` (as returned by `resolve_model`) with Drake; repeated calls are cached.

    Raises
    ------
    ProblemError
        Drake cannot parse the model, or a collision mesh is an .stl file.
    """
    file = _model_path(reference, Path.cwd(), package_paths)
    stamp = file.stat().st_mtime_ns if file.is_file() else 0
    return _parse(reference, str(file), all_package_paths(package_paths), stamp)


@functools.lru_cache(maxsize=64)
def _parse(reference: str, file: str, package_paths: tuple[Path, ...], stamp: int) -> ModelFacts:
    _reject_stl_collision(reference, Path(file))
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
    parser = make_parser(plant, scene_graph, package_paths)
    instances = add_models(plant, parser, file, "model")
    bodies = [plant.get_body(index) for instance in instances for index in plant.GetBodyIndices(instance)]
    if not bodies:
        raise ProblemError(f"{reference} holds no bodies, expected a model with at least one")
    joints_in_file = [plant.get_joint(i) for instance in instances for i in plant.GetJointIndices(instance)]
    anchored = [j.child_body().name() for j in joints_in_file if j.parent_body().index() == plant.world_body().index()]
    plant.Finalize()
    moving = [
        joint
        for instance in instances
        for joint in map(plant.get_joint, plant.GetJointIndices(instance))
        if joint.num_positions() > 0
    ]
    joints = {
        joint.name(): (joint.position_lower_limits(), joint.position_upper_limits())
        for joint in moving
        if joint.num_positions() == 1
    }
    # Drake gives every free body a floating joint when the plant is finalised.
    roots = [plant.get_body(index).name() for index in plant.GetFloatingBaseBodies()]
    rigid = len(moving) == 1 and len(roots) == 1
    diagram = builder.Build()
    context = plant.GetMyContextFromRoot(diagram.CreateDefaultContext())
    inspector = scene_graph.model_inspector()
    corners = []
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1)
    X_BW = bodies[0].EvalPoseInWorld(context).inverse()
    for body in bodies:
        for geometry in plant.GetCollisionGeometriesForBody(body):
            X_BG = X_BW @ body.EvalPoseInWorld(context) @ inspector.GetPoseInFrame(geometry)
            obb = inspector.GetObbInGeometryFrame(geometry)
            if obb is None or not inspector.GetProximityProperties(geometry):
                continue
            corners.append((X_BG @ obb.pose()).multiply(signs * obb.half_width()[:, None]))
    points = np.hstack(corners) if corners else None
    names = [body.name() for body in bodies]
    moving_names = [joint.name() for joint in moving if joint.num_positions() == 1]
    return ModelFacts(
        reference,
        tuple(plant.GetModelInstanceName(i).partition("::")[2] for i in instances if plant.GetBodyIndices(i)),
        tuple(names),
        joints,
        rigid,
        None if points is None else points.min(axis=1),
        None if points is None else points.max(axis=1),
        frozenset(joint.name() for joint in moving if joint.type_name() == "prismatic"),
        tuple(dict.fromkeys(n for known in (names, moving_names) for n in known if known.count(n) > 1)),
        tuple(roots),
        tuple(anchored),
    )


def _reject_stl_collision(reference: str, file: Path) -> None:
    """Drake cannot collide with .stl meshes and says so only later, or not at all; say it here."""
    if file.suffix not in (".urdf", ".sdf", ".xml"):
        return
    try:
        root = ElementTree.parse(file).getroot()
    except (ElementTree.ParseError, OSError):
        return  # Drake's own message is better
    for collision in root.iter("collision"):
        for element in collision.iter():
            mesh = element.get("filename") or (element.text if element.tag == "uri" else None)
            if mesh and mesh.strip().lower().endswith(".stl"):
                raise ProblemError(
                    f"{reference} has the collision mesh {mesh.strip()}, expected .obj, .vtk or .gltf: Drake cannot "
                    "collide with .stl files; convert it, or use boxes, spheres and capsules"
                )


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
