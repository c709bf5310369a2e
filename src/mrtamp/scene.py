"""Problem -> Drake plants: which bodies exist, where they are welded, and how a configuration is written into q.

One function builds every plant the project uses: small ones for the planner (one robot, or two), the full one for the
judge, and the full one with visuals for Meshcat.  Section III of the paper; DESIGN section 4.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from pydrake.geometry import (
    Box,
    Capsule,
    CollisionFilterDeclaration,
    Cylinder,
    GeometryId,
    GeometrySet,
    SceneGraph,
    Sphere,
)
from pydrake.geometry import Shape as DrakeShape
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import Joint, ModelInstanceIndex, RigidBody, SpatialInertia, UnitInertia
from pydrake.systems.framework import Context, Diagram, DiagramBuilder

from mrtamp.kinematics import Chain, Tool, quaternions
from mrtamp.model_files import add_models, make_parser
from mrtamp.problem import MovableObject, MrtampError, Problem, Robot, RobotModel, Shape, StaticBody

Instances = tuple[ModelInstanceIndex, ...]


def drake_shape(shape: Shape) -> DrakeShape:
    """The Drake geometry of a problem's primitive shape."""
    makers = {"box": Box, "cylinder": Cylinder, "capsule": Capsule, "sphere": Sphere}
    return makers[shape.kind](*shape.size)


@dataclass
class RobotInScene:
    """Where one robot lives in a plant: its model instances and the columns of q that are its arm and its fingers.

    An arm and its gripper may be two instances; their bodies have different names.
    """

    robot: Robot
    instances: Instances
    arm: np.ndarray
    fingers: np.ndarray
    finger_factors: np.ndarray

    def finger_positions(self, width: float | None) -> np.ndarray:
        """Finger joint positions for an opening width (m); None means fully open."""
        gripper = self.robot.model.gripper
        if gripper is None:
            return np.zeros(0)
        return self.finger_factors * (gripper.max_width if width is None else width)


@dataclass
class Scene:
    """A finalised plant with its scene graph, and the maps from names to its parts.

    `floating` maps the name of each free body to the first of its seven columns in q (qw, qx, qy, qz, x, y, z),
    `stands_for` to the object it stands for; `grown` says by how much (m) collision geometries are padded.
    """

    diagram: Diagram
    plant: MultibodyPlant
    scene_graph: SceneGraph
    robots: dict[str, RobotInScene]
    statics: dict[str, list[RigidBody]]
    floating: dict[str, int] = field(default_factory=dict)
    free_bodies: dict[str, list[RigidBody]] = field(default_factory=dict)
    stands_for: dict[str, str] = field(default_factory=dict)
    grown: dict[GeometryId, float] = field(default_factory=dict)

    def context(self) -> tuple[Context, Context]:
        """A fresh root context and the plant's context inside it."""
        root = self.diagram.CreateDefaultContext()
        return root, self.plant.GetMyMutableContextFromRoot(root)

    def padding(self, a: GeometryId, b: GeometryId) -> float:
        """By how much (m) two collision geometries are padded together."""
        return self.grown.get(a, 0.0) + self.grown.get(b, 0.0)

    def write_pose(self, q: np.ndarray, body: str, X_WF: np.ndarray) -> None:
        """Write the 4x4 world pose of a free body into the position vector q in place."""
        k = self.floating[body]
        q[k : k + 4] = quaternions(X_WF[None, :3, :3])[0]
        q[k + 4 : k + 7] = X_WF[:3, 3]


def _add_primitive(plant: MultibodyPlant, body: RigidBody, shape: Shape, color: Sequence[float], visuals: bool) -> None:
    geometry = drake_shape(shape)
    plant.RegisterCollisionGeometry(body, RigidTransform(), geometry, "collision", CoulombFriction(0.9, 0.8))
    if visuals:
        plant.RegisterVisualGeometry(body, RigidTransform(), geometry, "visual", np.asarray(color))


def _inertia(shape: Shape, mass: float) -> SpatialInertia:
    x = shape.size
    unit = {
        "box": lambda: UnitInertia.SolidBox(*x),
        "cylinder": lambda: UnitInertia.SolidCylinder(x[0], x[1], np.array([0.0, 0.0, 1.0])),
        "capsule": lambda: UnitInertia.SolidCapsule(x[0], x[1], np.array([0.0, 0.0, 1.0])),
        "sphere": lambda: UnitInertia.SolidSphere(x[0]),
    }[shape.kind]()
    return SpatialInertia(mass, np.zeros(3), unit)


def _add_static(plant: MultibodyPlant, parser: Parser, static: StaticBody, visuals: bool) -> list[RigidBody]:
    if static.shape is not None:
        instance = plant.AddModelInstance(f"static:{static.name}")
        body = plant.AddRigidBody(static.name, instance, _inertia(static.shape, 1.0))
        _add_primitive(plant, body, static.shape, static.color, visuals)
        plant.WeldFrames(plant.world_frame(), body.body_frame(), static.X_WB)
        return [body]
    return _add_model(plant, parser, static.model or "", f"static:{static.name}", static.X_WB)


def _add_model(
    plant: MultibodyPlant, parser: Parser, model: str, owner: str, X_WB: RigidTransform | None
) -> list[RigidBody]:
    """A model file of fixed bodies; welded at X_WB, or left free (an object) when X_WB is None."""
    instances = add_models(plant, parser, model, owner)
    bodies, joints = _bodies(plant, instances), _joints(plant, instances)
    if X_WB is not None and not joints:
        plant.WeldFrames(plant.world_frame(), bodies[0].body_frame(), X_WB)
    elif X_WB is not None:
        children = {joint.child_body().name() for joint in joints}
        roots = [b for b in bodies if b.name() not in children]
        if roots:
            plant.WeldFrames(plant.world_frame(), roots[0].body_frame(), X_WB)
    return bodies


def build_scene(
    problem: Problem,
    *,
    robots: Sequence[str] | None = None,
    free_bodies: Mapping[str, MovableObject] | None = None,
    statics: bool = True,
    visuals: bool = False,
    padding: Mapping[str, float] | None = None,
    builder: DiagramBuilder | None = None,
) -> Scene:
    """Build and finalise a plant; pairs that the problem's collision rules ignore never collide in it.

    Parameters
    ----------
    robots : names of the robots to include (default: all).
    free_bodies : free body name -> the object whose shape it has, and whose collision rules apply to it (default: every
        object under its own name).
    visuals : keep illustration geometry (planning plants do not need it).
    padding : robot name -> metres by which its primitive collision shapes grow, fingers and hand excepted.
    builder : a diagram builder to add the plant to; the caller then builds the diagram (`Scene.diagram` is None).

    Raises
    ------
    MrtampError : a model file cannot be read or has an unsupported joint.
    """
    own_builder = builder is None
    builder = builder or DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
    parser = make_parser(plant, scene_graph, problem.package_paths)

    included = {name: problem.robot(name) for name in (robots or [r.name for r in problem.robots])}
    instances: dict[str, Instances] = {}
    for name, robot in included.items():
        instances[name] = add_models(plant, parser, _model_file(robot.model), name)
        base = _body(plant, instances[name], robot.model.base)
        plant.WeldFrames(plant.world_frame(), base.body_frame(), robot.X_WB)
    static_bodies = {s.name: _add_static(plant, parser, s, visuals) for s in problem.statics} if statics else {}
    free = {o.name: o for o in problem.objects} if free_bodies is None else dict(free_bodies)
    bodies: dict[str, list[RigidBody]] = {}
    for name, item in free.items():
        if item.shape is not None:
            instance = plant.AddModelInstance(f"object:{name}")
            body = plant.AddRigidBody(name, instance, _inertia(item.shape, item.mass))
            _add_primitive(plant, body, item.shape, item.color, visuals)
            bodies[name] = [body]
        else:
            bodies[name] = _add_model(plant, parser, item.model or "", f"object:{name}", None)
    plant.Finalize()
    in_scene = {name: _robot_in_scene(plant, robot, instances[name]) for name, robot in included.items()}
    _filter_exceptions(plant, scene_graph, in_scene)
    grown = {
        g: extra for name, extra in (padding or {}).items() for g in _pad(plant, scene_graph, in_scene[name], extra)
    }

    scene = Scene(
        diagram=builder.Build() if own_builder else None,
        plant=plant,
        scene_graph=scene_graph,
        robots=in_scene,
        statics=static_bodies,
        floating={name: b[0].floating_positions_start() for name, b in bodies.items()},
        free_bodies=bodies,
        stands_for={name: item.name for name, item in free.items()},
        grown=grown,
    )
    # Last: growing a shape drops the filters it is in.
    _filter_ignored(scene, problem)
    return scene


def _model_file(model: RobotModel) -> str:
    """The URDF, SDF or directives of a robot: a URL, or a path that starts at the robot's own file."""
    if model.model.startswith("package://") or model.file is None:
        return model.model
    return str((model.file.parent / model.model).resolve())


def _robot_in_scene(plant: MultibodyPlant, robot: Robot, instances: Instances) -> RobotInScene:
    def columns(names: Iterable[str]) -> np.ndarray:
        return np.array([_joint(plant, instances, j).position_start() for j in names], dtype=int)

    gripper = robot.model.gripper
    fingers = gripper.joints if gripper else {}
    return RobotInScene(
        robot=robot,
        instances=instances,
        arm=columns(robot.model.arm_joints),
        fingers=columns(fingers),
        finger_factors=np.array(list(fingers.values()), dtype=float),
    )


def geometry_ids(plant: MultibodyPlant, bodies: Iterable[RigidBody]) -> list:
    """Collision geometry ids of `bodies`."""
    return [g for body in bodies for g in plant.GetCollisionGeometriesForBody(body)]


def robot_bodies(plant: MultibodyPlant, in_scene: RobotInScene) -> list[RigidBody]:
    """All bodies of a robot."""
    return _bodies(plant, in_scene.instances)


def robot_joints(plant: MultibodyPlant, in_scene: RobotInScene) -> list[Joint]:
    """All joints of a robot, welds included."""
    return _joints(plant, in_scene.instances)


def robot_body(plant: MultibodyPlant, in_scene: RobotInScene, name: str) -> RigidBody:
    """The body of a robot called `name`."""
    return _body(plant, in_scene.instances, name)


def robot_joint(plant: MultibodyPlant, in_scene: RobotInScene, name: str) -> Joint:
    """The joint of a robot called `name`."""
    return _joint(plant, in_scene.instances, name)


def _bodies(plant: MultibodyPlant, instances: Instances) -> list[RigidBody]:
    return [plant.get_body(i) for instance in instances for i in plant.GetBodyIndices(instance)]


def _joints(plant: MultibodyPlant, instances: Instances) -> list[Joint]:
    return [plant.get_joint(i) for instance in instances for i in plant.GetJointIndices(instance)]


def _body(plant: MultibodyPlant, instances: Instances, name: str) -> RigidBody:
    instance = next(i for i in instances if plant.HasBodyNamed(name, i))
    return plant.GetBodyByName(name, instance)


def _joint(plant: MultibodyPlant, instances: Instances, name: str) -> Joint:
    found = (plant.GetJointByName(name, i) for i in instances if plant.HasJointNamed(name, i))
    return next(joint for joint in found if joint.num_positions())


def gripper_bodies(plant: MultibodyPlant, in_scene: RobotInScene) -> list[RigidBody]:
    """The bodies of a robot that may touch what it holds; without a gripper the one that carries its grasp frame."""
    return [robot_body(plant, in_scene, b) for b in touching_bodies(in_scene.robot.model)]


def touching_bodies(model: RobotModel) -> tuple[str, ...]:
    """Names of the bodies of a robot that may touch what it holds."""
    return model.gripper.bodies if model.gripper else (model.grasp_body,)


def bodies_of(scene: Scene, thing: str) -> list[RigidBody]:
    """The bodies in a plant that a collision rule means by `thing`: a robot, robot/body, a static body or an object.

    Of an object these are all free bodies that stand for it; of what is not in the plant, none.
    """
    robot, _, body = thing.partition("/")
    if robot in scene.robots:
        bodies = robot_bodies(scene.plant, scene.robots[robot])
        if body and body not in [b.name() for b in bodies]:
            names = ", ".join(b.name() for b in bodies)
            raise MrtampError(f"collision rules: found {thing!r}, expected one of the bodies of {robot}: {names}")
        return [b for b in bodies if not body or b.name() == body]
    if thing in scene.statics:
        return scene.statics[thing]
    return [b for name, bodies in scene.free_bodies.items() if scene.stands_for[name] == thing for b in bodies]


def _filter_exceptions(plant: MultibodyPlant, scene_graph: SceneGraph, robots: Mapping[str, RobotInScene]) -> None:
    """Apply the collision exceptions of every robot description; its base may stand on the static world."""
    manager = scene_graph.collision_filter_manager()
    for in_scene in robots.values():
        for pair in in_scene.robot.model.collision_exceptions:
            sets = [GeometrySet(geometry_ids(plant, [robot_body(plant, in_scene, x)])) for x in pair]
            manager.Apply(CollisionFilterDeclaration().ExcludeBetween(*sets))


def _filter_ignored(scene: Scene, problem: Problem) -> None:
    """Apply the problem's collision rules as far as the plant holds both things of a pair."""
    manager = scene.scene_graph.collision_filter_manager()
    known = [r.name for r in problem.robots] + [s.name for s in problem.statics] + [o.name for o in problem.objects]
    for pair in problem.collision.ignore:
        for thing in pair:
            if thing.partition("/")[0] not in known:
                raise MrtampError(f"collision rules: found {thing!r}, expected one of {', '.join(known)}")
        sets = [GeometrySet(geometry_ids(scene.plant, bodies_of(scene, thing))) for thing in pair]
        manager.Apply(CollisionFilterDeclaration().ExcludeBetween(*sets))


def _pad(plant: MultibodyPlant, scene_graph: SceneGraph, in_scene: RobotInScene, extra: float) -> list[GeometryId]:
    """Grow a robot's primitive collision shapes, so that motion between checked samples is covered too; returns them.

    Changing a shape drops the filters Drake had set for it (same body, adjacent bodies): the caller excludes the
    robot's own pairs again.
    """
    source = plant.get_source_id()
    inspector = scene_graph.model_inspector()
    model = in_scene.robot.model
    gripper = set(model.gripper.bodies) if model.gripper else set()
    out = []
    for body in robot_bodies(plant, in_scene):
        if body.name() in gripper or body.name() == model.base:
            continue
        for g in plant.GetCollisionGeometriesForBody(body):
            shape = inspector.GetShape(g)
            grown: DrakeShape | None = None
            if isinstance(shape, Sphere):
                grown = Sphere(shape.radius() + extra)
            elif isinstance(shape, Capsule):
                grown = Capsule(shape.radius() + extra, shape.length())
            elif isinstance(shape, Cylinder):
                grown = Cylinder(shape.radius() + extra, shape.length() + 2 * extra)
            elif isinstance(shape, Box):
                grown = Box(*(shape.size() + 2 * extra))
            if grown is not None:
                scene_graph.ChangeShape(source, g, grown)
                out.append(g)
    return out


def chain_of(scene: Scene, name: str, width: float | None = None) -> tuple[Chain, Tool]:
    """Batched kinematics of robot `name` with its hand `width` (m) open (None: fully), and its grasp frame."""
    in_scene = scene.robots[name]
    model = in_scene.robot.model
    gripper = model.gripper
    opening = gripper.max_width if gripper and width is None else width
    fixed = {j: f * opening for j, f in gripper.joints.items()} if gripper and opening is not None else {}
    chain = Chain(robot_joints(scene.plant, in_scene), model.base, in_scene.robot.X_WB, model.arm_joints, fixed)
    return chain, Tool(chain, model.grasp_body, model.X_BG)
