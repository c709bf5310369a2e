"""The set on which a plan is shown: the plant with its visuals in Meshcat, regions, goal ghosts, traces and the camera.

`Stage` draws; it knows no time.  `mrtamp.view` moves it, live or as a recording.
"""

from __future__ import annotations

import ctypes

import numpy as np
from pydrake.geometry import (
    Box,
    Cylinder,
    Meshcat,
    MeshcatVisualizer,
    MeshcatVisualizerParams,
    Rgba,
    Role,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.systems.framework import DiagramBuilder

from mrtamp.modes import start_mode, static_poses
from mrtamp.playback import Playback, standstill
from mrtamp.problem import AtConfiguration, AtPose, HandAt, HandIn, InRegion, Problem, Support
from mrtamp.scene import build_scene, chain_of, robot_joint

PALETTE: tuple[tuple[float, float, float], ...] = (
    (0.00, 0.45, 0.70),
    (0.90, 0.49, 0.00),
    (0.00, 0.62, 0.45),
    (0.80, 0.36, 0.64),
    (0.34, 0.71, 0.91),
    (0.84, 0.27, 0.12),
    (0.72, 0.65, 0.10),
    (0.36, 0.34, 0.62),
)
"""One colour per robot, distinguishable also without red-green vision; repeated after eight."""

ROOT = "/drake/mrtamp"
SCENE, REGIONS, GHOSTS, TRACES = (f"{ROOT}/{part}" for part in ("scene", "regions", "goals", "traces"))
_MARKS = f"{ROOT}/marks"
_TRACE_RADIUS = 0.0025
_REGION_THICKNESS = 0.0012
_TARGET_RADIUS = 0.03
_FIELD_OF_VIEW = 35.0


def robot_color(problem: Problem, robot: str) -> tuple[float, float, float]:
    """The colour (r, g, b) that marks `robot` in pictures."""
    return PALETTE[[r.name for r in problem.robots].index(robot) % len(PALETTE)]


class Stage:
    """A problem in a Meshcat scene.

    Parameters
    ----------
    problem : what to draw.
    meshcat : the window; whatever mrtamp drew there before is replaced.  It lives as long as the process.
    """

    def __init__(self, problem: Problem, meshcat: Meshcat) -> None:
        self.problem = problem
        self.meshcat = meshcat
        # Drake ends the process when a Meshcat is destroyed by another thread than its own, and the garbage collector,
        # which breaks the reference cycles of a diagram, may run in any thread.  So a window is never destroyed.
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(meshcat))
        meshcat.Delete(ROOT)
        builder = DiagramBuilder()
        self.scene = build_scene(problem, visuals=True, builder=builder)
        params = MeshcatVisualizerParams()
        params.prefix = SCENE
        params.role = Role.kIllustration
        params.enable_alpha_slider = False
        MeshcatVisualizer.AddToBuilder(builder, self.scene.scene_graph, meshcat, params)
        self._diagram = builder.Build()
        self._root = self._diagram.CreateDefaultContext()
        self._context = self.scene.plant.GetMyMutableContextFromRoot(self._root)
        self.show(Playback(standstill(problem)).positions(self.scene, np.zeros(1))[0])
        self._draw_regions()
        self._draw_ghosts()
        self._draw_targets()
        self._draw_robot_marks()
        self._set_lights()
        self.look()

    def show(self, q: np.ndarray) -> None:
        """Move everything to the plant's position vector q (nq,)."""
        self.scene.plant.SetPositions(self._context, q)
        self._diagram.ForcedPublish(self._root)

    def body_poses(self, qs: np.ndarray) -> dict[str, np.ndarray]:
        """World poses (N, 4, 4) at positions (N, nq) of every body that can move, by its path in Meshcat."""
        plant, inspector = self.scene.plant, self.scene.scene_graph.model_inspector()
        bodies = {}
        for frame in inspector.GetAllFrameIds():
            body = plant.GetBodyFromFrameId(frame)
            if body is not None and inspector.NumGeometriesForFrameWithRole(frame, Role.kIllustration):
                bodies[f"{SCENE}/{inspector.GetName(frame).replace('::', '/')}"] = body
        out = {path: np.empty((len(qs), 4, 4)) for path in bodies}
        for k, q in enumerate(qs):
            plant.SetPositions(self._context, q)
            for path, body in bodies.items():
                out[path][k] = plant.EvalBodyPoseInWorld(self._context, body).GetAsMatrix4()
        return {path: X for path, X in out.items() if np.ptp(X, axis=0).max() > 1e-9}

    def draw_trace(self, robot: str, points: np.ndarray) -> None:
        """Draw the polyline through `points` (N, 3) in the robot's colour, as a thin tube."""
        vertices, faces = _tube(points, _TRACE_RADIUS)
        if len(faces):
            color = Rgba(*robot_color(self.problem, robot), 0.9)
            self.meshcat.SetTriangleMesh(f"{TRACES}/{robot}", vertices.T, faces.T, color)

    def set_visible(self, part: str, visible: bool) -> None:
        """Show or hide REGIONS, GHOSTS or TRACES."""
        self.meshcat.SetProperty(part, "visible", visible)

    def look(self) -> None:
        """Point the camera at the robots, from a side where no robot stands in front of the others."""
        bases = self._stands()
        centre = (bases.min(axis=0) + bases.max(axis=0)) / 2
        targets = [X[:3, 3] for _, robot, X in self._targets() if self._slides(robot)]
        spread = np.linalg.norm(np.array([*bases, *targets]) - centre, axis=1).max()
        azimuth = _open_side(bases - centre)
        elevation = 0.5 if len(bases) < 3 else 0.7
        direction = np.array([np.cos(azimuth), np.sin(azimuth), elevation])
        distance = 0.8 * (spread + 0.75) / np.tan(np.deg2rad(_FIELD_OF_VIEW / 2))
        # Look a little to the left, so that the scene stands clear of the timeline there.
        left = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
        target = centre + [0, 0, 0.25] + 0.05 * distance * left
        self.meshcat.SetCamera(Meshcat.PerspectiveCamera(fov=_FIELD_OF_VIEW, near=0.05, far=60.0))
        self.meshcat.SetCameraPose(target + distance * direction / np.linalg.norm(direction), target)

    def _draw_regions(self) -> None:
        """The regions of the problem on the static world, as thin plates lying on their surfaces."""
        X_WB = static_poses(self.problem)
        goals = {c.region for c in self.problem.goal if isinstance(c, InRegion)}
        for support in self.problem.supports:
            worth_seeing = support.color is not None or support.name in goals
            if support.body in X_WB and support.X_BO is None and worth_seeing:
                self._draw_region(support, RigidTransform(X_WB[support.body]) @ support.X_BS)

    def _draw_region(self, support: Support, X_WS: RigidTransform) -> None:
        color = support.color or (0.25, 0.55, 0.35, 0.6)
        path = f"{REGIONS}/{support.name}"
        self.meshcat.SetObject(path, Box(*support.size, _REGION_THICKNESS), Rgba(*color))
        self.meshcat.SetTransform(path, X_WS @ RigidTransform([0, 0, _REGION_THICKNESS / 2]))

    def _draw_ghosts(self) -> None:
        """A translucent copy of every object at its exact goal pose; goals on objects follow the goal below them."""
        goals = {c.object: c for c in self.problem.goal if isinstance(c, AtPose)}
        X_WB = static_poses(self.problem)
        starts = start_mode(self.problem).of
        inspector = self.scene.scene_graph.model_inspector()

        def goal_pose(name: str) -> np.ndarray | None:
            goal = goals.get(name)
            on, X_BO = (goal.on, goal.X_BO) if goal else (starts[name].parent, RigidTransform(starts[name].X_PO))
            below = X_WB[on] if on in X_WB else goal_pose(on)
            if X_BO is None:
                X_BO = self._on_top(name, on)
            return None if below is None or X_BO is None else below @ X_BO.GetAsMatrix4()

        for name in goals:
            X_WO = goal_pose(name)
            if X_WO is None:
                continue
            color = (*self.problem.object(name).color[:3], 0.38)
            for body in self.scene.free_bodies[name]:
                for k, geometry in enumerate(self.scene.plant.GetVisualGeometriesForBody(body)):
                    path = f"{GHOSTS}/{name}/{body.name()}/{k}"
                    X_OG = inspector.GetPoseInFrame(geometry)
                    self.meshcat.SetObject(path, inspector.GetShape(geometry), Rgba(*color))
                    # A little larger than the object, so that the two do not flicker when it arrives.
                    larger = np.diag([1.01, 1.01, 1.01, 1.0])
                    self.meshcat.SetTransform(path, X_WO @ X_OG.GetAsMatrix4() @ larger)

    def _on_top(self, upper: str, lower: str) -> RigidTransform | None:
        """A pose that stands for "anywhere on that object": in the middle, where both shapes are primitives."""
        shapes = [self.problem.object(name).shape for name in (lower, upper)]
        if any(shape is None for shape in shapes):
            return None
        return RigidTransform([0, 0, sum(shape.half_height for shape in shapes if shape is not None)])

    def _slides(self, robot: str) -> bool:
        """Whether a robot moves from place to place: its first joint is prismatic."""
        model = self.problem.robot(robot).model
        first = robot_joint(self.scene.plant, self.scene.robots[robot], model.arm_joints[0])
        return bool(first.type_name() == "prismatic")

    def _stands(self) -> np.ndarray:
        """Where the robots stand (R, 3): their bases, and of one that slides where its grasp frame starts."""
        out = np.array([r.X_WB.translation() for r in self.problem.robots])
        for k, robot in enumerate(self.problem.robots):
            if self._slides(robot.name):
                out[k, :2] = self._X_WG(robot.name, robot.start)[:2, 3]
        return out

    def _X_WG(self, robot: str, q: np.ndarray) -> np.ndarray:
        X_WG: np.ndarray = chain_of(self.scene, robot)[1].matrix(np.asarray(q, dtype=float)[None])[0]
        return X_WG

    def _targets(self) -> list[tuple[str, str, np.ndarray]]:
        """Subgoal, robot, and where (4, 4) its grasp frame is at the target: of a box, the middle."""
        out = []
        for subgoal in self.problem.subgoals:
            for robot, target in subgoal.targets.items():
                if isinstance(target, AtConfiguration):
                    X = self._X_WG(robot, target.q)
                else:
                    X = (target.X_WG if isinstance(target, HandAt) else target.X_WC).GetAsMatrix4()
                out.append((subgoal.name, robot, X))
        return out

    def _draw_targets(self) -> None:
        """A translucent ball, or the box, wherever a subgoal wants a robot's hand, in the robot's colour."""
        for subgoal, robot, X_WT in self._targets():
            target = self.problem.subgoal(subgoal).targets[robot]
            flat = 2 * _TRACE_RADIUS
            box = Box(*np.maximum(target.size, flat)) if isinstance(target, HandIn) else None
            path = f"{GHOSTS}/{subgoal}/{robot}"
            color = Rgba(*robot_color(self.problem, robot), 0.45)
            self.meshcat.SetObject(path, box or Sphere(_TARGET_RADIUS), color)
            self.meshcat.SetTransform(path, X_WT)

    def _draw_robot_marks(self) -> None:
        """A coloured disc under every robot, the colour of its trace and of its name in the timeline."""
        for robot, stand in zip(self.problem.robots, self._stands(), strict=True):
            path = f"{_MARKS}/{robot.name}"
            self.meshcat.SetObject(path, Cylinder(0.13, 0.004), Rgba(*robot_color(self.problem, robot.name)))
            R_WB = robot.X_WB.rotation()
            self.meshcat.SetTransform(path, RigidTransform(R_WB, stand) @ RigidTransform([0, 0, 0.002]))

    def _set_lights(self) -> None:
        """Soft light all around and one lamp above that casts the shadows."""
        bases = self._stands()
        centre = bases.mean(axis=0)
        height = 3.0 + np.linalg.norm(bases - centre, axis=1).max()
        put = self.meshcat.SetProperty
        put("/Background/<object>", "top_color", [0.95, 0.965, 0.985])
        put("/Background/<object>", "bottom_color", [0.78, 0.81, 0.86])
        put("/Axes", "visible", False)
        put("/Grid", "visible", False)
        put("/Lights/AmbientLight/<object>", "intensity", 1.15)
        put("/Lights/FillLight/<object>", "intensity", 0.7)
        for side in ("Negative", "Positive"):
            put(f"/Lights/PointLight{side}X/<object>", "intensity", 4.0)
        lamp = "/Lights/SpotLight"
        put(lamp, "visible", True)
        put(f"{lamp}/<object>", "position", [centre[0] - 0.25 * height, centre[1] - 0.3 * height, height])
        put(f"{lamp}/<object>", "intensity", 1.7 * height**2)
        put(f"{lamp}/<object>", "castShadow", True)


def _open_side(offsets: np.ndarray) -> float:
    """The azimuth (rad) of a view between the robots, which stand at `offsets` (R, 3) from the middle."""
    far = offsets[np.linalg.norm(offsets[:, :2], axis=1) > 1e-6]
    candidates = np.deg2rad(np.arange(-180.0, 180.0))
    preferred = np.deg2rad(-80.0)
    if not len(far):
        return float(preferred)
    between = candidates[:, None] - np.arctan2(far[:, 1], far[:, 0])
    clear = np.minimum(np.abs(np.angle(np.exp(1j * between))).min(axis=1), np.deg2rad(60.0))
    detour = np.abs(np.angle(np.exp(1j * (candidates - preferred))))
    return float(candidates[np.argmax(clear - 0.1 * detour)])


def _tube(points: np.ndarray, radius: float, sides: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and triangles (F, 3) of a tube around a polyline; repeated points are dropped."""
    points = np.asarray(points, dtype=float)
    keep = np.concatenate([[True], np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-4])
    points = points[keep]
    if len(points) < 2:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32)
    tangent = np.gradient(points, axis=0)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)
    # Carry the first normal along the line, so that the tube does not twist.
    normal = np.empty_like(tangent)
    previous = np.cross(tangent[0], [0.3, 0.5, 0.81])
    for k, t in enumerate(tangent):
        previous = previous - t * (previous @ t)
        previous = previous / max(float(np.linalg.norm(previous)), 1e-12)
        normal[k] = previous
    binormal = np.cross(tangent, normal)
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = np.cos(angle)[None, :, None] * normal[:, None] + np.sin(angle)[None, :, None] * binormal[:, None]
    vertices = (points[:, None] + radius * ring).reshape(-1, 3)
    along, around = np.meshgrid(np.arange(len(points) - 1), np.arange(sides), indexing="ij")
    a, b = along * sides + around, along * sides + (around + 1) % sides
    faces = np.concatenate(
        [np.stack([a, b, b + sides], -1).reshape(-1, 3), np.stack([a, b + sides, a + sides], -1).reshape(-1, 3)]
    )
    return vertices, faces.astype(np.int32)
