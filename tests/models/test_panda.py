"""Our Panda against the real one: it encloses the official meshes tightly, moves like the official model and is cheap.

The official model (Drake's model package) is read where it is available: beside this checkout or where DRAKE_MODELS_DIR
points. Tests that need it are skipped elsewhere.
"""

import json
import os
import subprocess
import sys
import time
from functools import cache
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml
from pydrake.geometry import (
    Box,
    Capsule,
    CollisionFilterDeclaration,
    GeometrySet,
    QueryObject,
    Role,
    SceneGraph,
    Shape,
    Sphere,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from scipy.spatial import cKDTree

ROOT = Path(__file__).resolve().parents[2]
DRAKE_MODELS = Path(os.environ.get("DRAKE_MODELS_DIR", ROOT.parent / "shared" / "drake_models"))
OURS = ROOT / "models" / "robots" / "panda.yaml"
OFFICIAL = ROOT / "tests" / "data" / "robots" / "panda_official.yaml"
needs_official = pytest.mark.skipif(
    not (DRAKE_MODELS / "package.xml").exists(), reason="the official Panda is not there; set DRAKE_MODELS_DIR"
)
LINKS = [*(f"link{i}" for i in range(8)), "hand", "leftfinger", "rightfinger"]
TOLERANCE = 0.001
PROUDEST = 0.04


# ---- the models -----------------------------------------------------------------------------------------------------


class Scene:
    """Robots (all described by the same file) welded at poses, on a table or in the air, with free cubes."""

    def __init__(self, description: Path, poses: list[RigidTransform], table: bool = False, cubes: int = 0) -> None:
        self.robot = yaml.safe_load(description.read_text())
        builder = DiagramBuilder()
        self.plant: MultibodyPlant
        self.scene_graph: SceneGraph
        self.plant, self.scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
        parser = Parser(self.plant)
        parser.SetAutoRenaming(True)
        if (DRAKE_MODELS / "package.xml").exists():
            parser.package_map().Remove("drake_models")
            parser.package_map().AddPackageXml(str(DRAKE_MODELS / "package.xml"))
        model = self.robot["model"]
        self.arms = []
        for X_WB in poses:
            (arm,) = parser.AddModelsFromUrl(model) if "://" in model else parser.AddModels(description.parent / model)
            self.plant.WeldFrames(self.plant.world_frame(), self.plant.GetFrameByName(self.robot["base"], arm), X_WB)
            self.arms.append(arm)
        friction = CoulombFriction(1.0, 1.0)
        if table:
            box = Box(2.0, 2.0, 0.1)
            self.plant.RegisterCollisionGeometry(
                self.plant.world_body(), RigidTransform([0, 0, -0.05]), box, "table", friction
            )
        self.cubes = []
        for k in range(cubes):
            inertia = SpatialInertia.SolidCubeWithDensity(1000.0, 0.05)
            body = self.plant.AddRigidBody(f"cube{k}", self.plant.AddModelInstance(f"cube{k}"), inertia)
            self.plant.RegisterCollisionGeometry(body, RigidTransform(), Box(0.05, 0.05, 0.05), "cube", friction)
            self.cubes.append(body)
        self.plant.Finalize()
        self._filter()
        self.diagram: Diagram = builder.Build()
        self._root: Context = self.diagram.CreateDefaultContext()
        self.context = self.plant.GetMyContextFromRoot(self._root)
        self._scene_context = self.scene_graph.GetMyContextFromRoot(self._root)

    def _filter(self) -> None:
        manager = self.scene_graph.collision_filter_manager()
        bodies = [
            [self.plant.GetBodyByName(name, arm) for name in pair]
            for arm in self.arms
            for pair in self.robot["collision_exceptions"]
        ]
        bodies += [[cube, self.plant.world_body()] for cube in self.cubes]
        for pair in bodies:
            a, b = (GeometrySet(self.plant.GetCollisionGeometriesForBody(body)) for body in pair)
            manager.Apply(CollisionFilterDeclaration().ExcludeBetween(a, b))

    def query(self) -> QueryObject:
        return self.scene_graph.get_query_output_port().Eval(self._scene_context)

    def set_arm(self, q: np.ndarray, opening: float = 0.08, arm: int = 0) -> None:
        robot = self.robot
        for name, value in zip(robot["arm_joints"], q, strict=True):
            self.plant.GetJointByName(name, self.arms[arm]).set_angle(self.context, value)
        for name, factor in robot["gripper"]["joints"].items():
            self.plant.GetJointByName(name, self.arms[arm]).set_translation(self.context, factor * opening)

    def shapes(self, body: str) -> list[tuple[Shape, RigidTransform]]:
        """Collision shapes of a body with their poses in the body."""
        inspector = self.scene_graph.model_inspector()
        frame = self.plant.GetBodyFrameIdOrThrow(self.plant.GetBodyByName(body).index())
        ids = inspector.GetGeometries(frame, Role.kProximity)
        return [(inspector.GetShape(i), inspector.GetPoseInFrame(i)) for i in ids]


@cache
def alone(description: Path) -> Scene:
    return Scene(description, [RigidTransform()])


def random_configurations(n: int, seed: int) -> np.ndarray:
    """Uniform within the limits: (n, 9), arm then fingers."""
    plant = alone(OURS).plant
    return np.random.default_rng(seed).uniform(
        plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits(), (n, plant.num_positions())
    )


# ---- the meshes -----------------------------------------------------------------------------------------------------


@cache
def mesh(link: str) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) in the link's frame and triangles (m, 3) of the official visual mesh of a link."""
    finger = link.endswith("finger")
    folder = DRAKE_MODELS / "franka_description" / "meshes" / "visual"
    vertices, triangles = read_gltf(folder / ("finger.gltf" if finger else f"{link}.gltf"))
    if finger:  # The finger's mesh is turned by 90 degrees about x; the right finger also by 180 degrees about z.
        turn = RotationMatrix.MakeXRotation(np.pi / 2)
        if link == "rightfinger":
            turn = RotationMatrix.MakeZRotation(np.pi) @ turn
        vertices = vertices @ turn.matrix().T
    return vertices, triangles


def read_gltf(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a glTF file whose nodes have no children, turned from y-up to z-up as Drake does."""
    gltf = json.loads(path.read_text())
    buffers = [(path.parent / buffer["uri"]).read_bytes() for buffer in gltf["buffers"]]

    def read(accessor: int) -> np.ndarray:
        a = gltf["accessors"][accessor]
        view = gltf["bufferViews"][a["bufferView"]]
        kind = np.dtype({5121: np.uint8, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}[a["componentType"]])
        width = {"SCALAR": 1, "VEC3": 3}[a["type"]]
        stride = view.get("byteStride", kind.itemsize * width)
        start = view.get("byteOffset", 0) + a.get("byteOffset", 0)
        return np.ndarray((a["count"], width), kind, buffers[view["buffer"]], start, (stride, kind.itemsize))

    vertices: list[np.ndarray] = []
    triangles: list[np.ndarray] = []
    for node in gltf["nodes"]:
        assert "children" not in node and "matrix" not in node
        x, y, z, w = node.get("rotation", (0, 0, 0, 1))
        R = np.eye(3) + 2 * np.array(
            [
                [-y * y - z * z, x * y - z * w, x * z + y * w],
                [x * y + z * w, -x * x - z * z, y * z - x * w],
                [x * z - y * w, y * z + x * w, -x * x - y * y],
            ]
        )
        for primitive in gltf["meshes"][node["mesh"]]["primitives"]:
            first = sum(map(len, vertices))
            p = read(primitive["attributes"]["POSITION"]).astype(float) * node.get("scale", (1, 1, 1))
            vertices.append(p @ R.T + node.get("translation", (0, 0, 0)))
            triangles.append(read(primitive["indices"]).astype(int).reshape(-1, 3) + first)
    stacked = np.vstack(vertices)
    return np.c_[stacked[:, 0], -stacked[:, 2], stacked[:, 1]], np.vstack(triangles)


@cache
def mesh_points(link: str, spacing: float) -> np.ndarray:
    """Vertices and random surface points of a link's mesh, thinned to about one per cube of side `spacing`."""
    vertices, triangles = mesh(link)
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    rng = np.random.default_rng(0)
    of = np.repeat(np.arange(len(area)), rng.poisson(2 * area / spacing**2))
    s, t = rng.random((2, len(of), 1))
    s, t = np.where(s + t > 1, 1 - s, s), np.where(s + t > 1, 1 - t, t)
    points = np.vstack([vertices, a[of] + s * (b - a)[of] + t * (c - a)[of]])
    return points[np.unique(np.floor(points / spacing).astype(int), axis=0, return_index=True)[1]]


# ---- the shapes -----------------------------------------------------------------------------------------------------


def signed_distance(shape: Shape, X_LS: RigidTransform, p_L: np.ndarray) -> np.ndarray:
    """Distance of points (n, 3) from a shape's surface, negative inside."""
    p = X_LS.inverse().multiply(p_L.T).T
    if isinstance(shape, Sphere):
        return np.linalg.norm(p, axis=1) - shape.radius()
    if isinstance(shape, Capsule):
        half = shape.length() / 2
        p[:, 2] -= np.clip(p[:, 2], -half, half)
        return np.linalg.norm(p, axis=1) - shape.radius()
    assert isinstance(shape, Box)
    excess = np.abs(p) - shape.size() / 2
    return np.linalg.norm(np.maximum(excess, 0), axis=1) + np.minimum(excess.max(axis=1), 0)


def surface(shape: Shape, X_LS: RigidTransform, spacing: float) -> np.ndarray:
    """Points on a shape's surface at about the given spacing."""
    if isinstance(shape, Box):
        size = shape.size()
        axes = [np.linspace(-0.5, 0.5, int(s / spacing) + 2) for s in size]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        p = grid[np.abs(grid).max(axis=1) == 0.5] * size
    else:
        assert isinstance(shape, (Sphere, Capsule))
        radius = shape.radius()
        length = shape.length() if isinstance(shape, Capsule) else 0.0
        # A Fibonacci sphere cut at its equator, and rings between the halves.
        n = int(4 * np.pi * radius**2 / spacing**2)
        z = 1 - (2 * np.arange(n) + 1) / n
        angle = np.pi * (1 + 5**0.5) * np.arange(n)
        caps = radius * np.c_[np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z]
        caps[:, 2] += np.copysign(length / 2, z)
        height, turn = np.meshgrid(
            np.linspace(-length / 2, length / 2, int(length / spacing) + 2), np.arange(0, 2 * np.pi, spacing / radius)
        )
        rings = np.c_[radius * np.cos(turn.ravel()), radius * np.sin(turn.ravel()), height.ravel()]
        p = np.vstack([caps, rings])
    return X_LS.multiply(p.T).T


# ---- tests ----------------------------------------------------------------------------------------------------------


@needs_official
@pytest.mark.parametrize("link", LINKS)
def test_collision_shapes_enclose_every_vertex_of_the_real_link(link: str) -> None:
    vertices, _ = mesh(link)
    distance = np.min([signed_distance(*shape, vertices) for shape in alone(OURS).shapes(f"panda_{link}")], axis=0)
    assert distance.max() <= TOLERANCE


@needs_official
@pytest.mark.parametrize("link", LINKS)
def test_collision_shapes_are_nowhere_far_from_the_real_link(link: str) -> None:
    tree = cKDTree(mesh_points(link, 0.002))
    shapes = alone(OURS).shapes(f"panda_{link}")
    for k, shape in enumerate(shapes):
        points = surface(*shape, spacing=0.003)
        others = [signed_distance(*other, points) for j, other in enumerate(shapes) if j != k]
        exposed = points[np.min(others, axis=0) >= 0] if others else points
        assert tree.query(exposed)[0].max(initial=0.0) <= PROUDEST


def test_arm_is_made_of_few_shapes() -> None:
    scene = alone(OURS)
    assert sum(len(scene.shapes(f"panda_{link}")) for link in LINKS[1:]) <= 17  # link 0 is welded, hence cheap
    assert len(scene.shapes("panda_link0")) <= 8


@pytest.mark.parametrize(("opening", "touches"), [(0.08, False), (0.056, False), (0.049, True), (0.0, True)], ids=str)
def test_open_hand_goes_around_a_cube_and_a_closed_one_does_not(opening: float, touches: bool) -> None:
    scene = Scene(OURS, [RigidTransform()], cubes=1)
    grasp = scene.robot["grasp_frame"]
    scene.set_arm(scene.robot["home"], opening)
    hand = scene.plant.GetBodyByName(grasp["body"])
    X_WG = hand.EvalPoseInWorld(scene.context) @ RigidTransform(grasp["X_BG"]["translation"])
    scene.plant.SetFreeBodyPose(scene.context, scene.cubes[0], X_WG)
    assert scene.query().HasCollisions() == touches
    if not touches:
        distances = scene.query().ComputeSignedDistancePairwiseClosestPoints(0.05)
        cube = set(scene.plant.GetCollisionGeometriesForBody(scene.cubes[0]))
        clearance = min(d.distance for d in distances if {d.id_A, d.id_B} & cube)
        assert clearance > 0.002, "hand or fingers grown by 2 mm would touch the cube"


@needs_official
def test_every_link_moves_as_in_the_official_model() -> None:
    ours, official = alone(OURS), alone(OFFICIAL)
    for q in random_configurations(100, seed=0):
        for scene in (ours, official):
            scene.plant.SetPositions(scene.context, q)
        for name in [f"panda_{link}" for link in [*LINKS, "link8"]]:
            X, Y = (s.plant.GetBodyByName(name).EvalPoseInWorld(s.context) for s in (ours, official))
            np.testing.assert_allclose(X.GetAsMatrix4(), Y.GetAsMatrix4(), rtol=0, atol=1e-9)


def test_model_needs_no_file_from_elsewhere() -> None:
    urdf = OURS.parent / alone(OURS).robot["model"]
    meshes = [element.attrib["filename"] for element in ElementTree.parse(urdf).iter("mesh")]
    assert meshes and all((urdf.parent / mesh).is_file() and not Path(mesh).is_absolute() for mesh in meshes)
    assert sum(path.stat().st_size for path in (urdf.parent / "panda_meshes").glob("*.*")) < 1_000_000


def test_limits_are_the_published_ones() -> None:
    plant = alone(OURS).plant
    lower = [-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973, 0, 0]
    upper = [2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973, 0.04, 0.04]
    np.testing.assert_array_equal(plant.GetPositionLowerLimits(), lower)
    np.testing.assert_array_equal(plant.GetPositionUpperLimits(), upper)
    np.testing.assert_array_equal(plant.GetVelocityUpperLimits(), [2.175] * 4 + [2.61] * 3 + [0.2] * 2)
    np.testing.assert_array_equal(plant.GetEffortUpperLimits(), [87] * 4 + [12] * 3 + [20] * 2)


@needs_official
def test_mass_properties_are_those_of_the_official_model() -> None:
    ours, official = alone(OURS), alone(OFFICIAL)
    for link in LINKS[:-1]:  # The official right finger carries the left one's centre of mass, on its outside.
        M, N = (s.plant.GetBodyByName(f"panda_{link}").default_spatial_inertia() for s in (ours, official))
        np.testing.assert_allclose(M.CopyToFullMatrix6(), N.CopyToFullMatrix6(), atol=1e-6)


def test_home_is_free() -> None:
    scene = alone(OURS)
    scene.set_arm(scene.robot["home"])
    assert not scene.query().HasCollisions()


def free_share(scene: Scene, configurations: np.ndarray) -> float:
    free = 0
    for q in configurations:
        scene.plant.SetPositions(scene.context, q)
        free += not scene.query().HasCollisions()
    return free / len(configurations)


def test_most_configurations_are_free_of_self_collision() -> None:
    assert free_share(alone(OURS), random_configurations(4000, seed=1)) >= 0.8


@needs_official
def test_self_collision_is_about_as_rare_as_in_the_official_model() -> None:
    q = random_configurations(4000, seed=2)
    assert free_share(alone(OFFICIAL), q) - 0.06 <= free_share(alone(OURS), q)


@needs_official
def test_excepted_links_never_meet_on_the_real_arm() -> None:
    scene = alone(OURS)
    plant = scene.plant
    uniform = random_configurations(60, seed=3)
    # Links come closest at the ends of the joint ranges, so half of the joint positions sit there.
    ends = np.where(uniform[::-1] > uniform, plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits())
    mixed = np.where(np.random.default_rng(4).random(uniform.shape) < 0.5, ends, uniform)
    for first, second in scene.robot["collision_exceptions"]:
        if {first, second} == {"panda_leftfinger", "panda_rightfinger"}:
            continue
        names = [name.removeprefix("panda_") for name in (first, second)]
        # The dangling cables of the base are no reason to stop there: they lie below the mounting face.
        a, b = (p[p[:, 2] >= 0] if name == "link0" else p for name in names for p in [mesh_points(name, 0.004)])
        tree = cKDTree(a)
        for q in np.vstack([uniform, mixed]):
            plant.SetPositions(scene.context, q)
            X_AB = plant.CalcRelativeTransform(scene.context, plant.GetFrameByName(first), plant.GetFrameByName(second))
            nearest, _ = tree.query(X_AB.multiply(b.T).T, distance_upper_bound=0.006)
            assert np.isinf(nearest).all(), (first, second, q)


@needs_official
def test_one_check_takes_at_most_two_thirds_of_the_official_models_time() -> None:
    # In a process of its own: what earlier tests have left in memory slows down what both models have in common.
    done = subprocess.run([sys.executable, __file__], capture_output=True, text=True, check=True)
    ours, official = map(float, done.stdout.split())
    assert ours <= 2 / 3 * official


def times_of_one_check() -> tuple[float, float]:
    """Seconds that a check of two arms takes, with our model and with the official one."""
    poses = [RigidTransform([-0.5, 0, 0]), RigidTransform(RotationMatrix.MakeZRotation(np.pi), [0.5, 0, 0])]
    scenes = [Scene(description, poses, table=True, cubes=6) for description in (OURS, OFFICIAL)]
    for scene in scenes:
        for k, cube in enumerate(scene.cubes):
            scene.plant.SetFreeBodyPose(scene.context, cube, RigidTransform([0, 0.2 * k - 0.5, 0.025]))

    def seconds(scene: Scene, q: np.ndarray) -> float:
        # Setting the positions again makes Drake forget the poses, so each of the three is a whole check.
        best = np.inf
        for _ in range(3):
            for arm in range(2):
                scene.set_arm(q[arm], arm=arm)
            query = scene.query()
            start = time.perf_counter()
            query.HasCollisions()
            best = min(best, time.perf_counter() - start)
        return best

    rng = np.random.default_rng(5)
    configurations = np.array(scenes[0].robot["home"]) + rng.uniform(-0.8, 0.8, (400, 2, 7))
    # What else the machine is doing only ever adds: of every configuration the best time counts.
    best = np.full((len(configurations), 2), np.inf)
    for _ in range(5):
        best = np.minimum(best, [[seconds(scene, q) for scene in scenes] for q in configurations])
    ours, official = np.median(best, axis=0)
    return float(ours), float(official)


if __name__ == "__main__":
    print(*times_of_one_check())
