"""The judge's own picture of a problem: one full Drake plant, distances in it, and bounds on how fast its points move.

Everything is read from the plant that `build_scene` makes of the problem; nothing is shared with the planner.  The
bounds make conservative advancement possible: a point of a robot moves by at most sum_j reach_j |dq_j|, where reach_j
is the greatest distance it can have from the axis of joint j (1 for a prismatic joint).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from pydrake.geometry import Capsule, Cylinder, GeometryId, HalfSpace, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.tree import RigidBody

from mrtamp.check_bounds import CORNERS, Envelopes, Screws, capsule_around
from mrtamp.check_report import Side
from mrtamp.kinematics import quaternions
from mrtamp.problem import WORLD, MrtampError, Problem
from mrtamp.scene import Scene, build_scene, robot_bodies, robot_body, robot_joint, touching_bodies

UNBOUNDED_SLIDE = 10.0
"""A prismatic joint without limits is judged within this many metres of zero."""

_UNKNOWN = np.full(3, np.nan)


@dataclass(frozen=True, eq=False)
class Solid:
    """One collision geometry: its body, its bounding box in the body frame, and spheres whose hull encloses it.

    `joint` is the index of the joint (in `JudgeScene.columns`) that carries it, -1 for what no robot moves by itself.
    """

    id: GeometryId
    side: Side
    body: RigidBody
    joint: int
    X_BC: np.ndarray
    half: np.ndarray
    centres: np.ndarray
    radii: np.ndarray
    bound: float
    """Radius (m) of a sphere about the centre of the box that encloses the geometry."""
    round: bool
    """Whether it is a sphere or a capsule: the hull of its spheres itself."""
    disc: bool
    """Whether it is a cylinder."""


class JudgeScene:
    """The full plant of a problem with all robots and objects.

    Composite configurations z (N,) hold, robot after robot, its arm joints and then its finger joints; `columns` are
    their places among the plant's positions.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.scene: Scene = build_scene(problem)
        self.plant = self.scene.plant
        objects = [b for bodies in self.scene.free_bodies.values() for b in bodies]
        statics = [b for bodies in self.scene.statics.values() for b in bodies] + [self.plant.world_body()]
        self._root, self.context = self.scene.context()
        self._graph_context = self.scene.scene_graph.GetMyContextFromRoot(self._root)
        self._query_port = self.scene.scene_graph.get_query_output_port()
        _, self._kinematics = self.scene.context()
        self.base = np.array(self.plant.GetPositions(self.context))
        self._joints()
        self._solids(objects, statics)
        self._envelopes()

    # -- robots -----------------------------------------------------------------------------------------------------

    def _joints(self) -> None:
        """Joint tree of all robots: where each axis is at the default configuration, and which joint carries which."""
        plant = self.plant
        self.arm: dict[str, slice] = {}
        self.fingers: dict[str, slice] = {}
        joints: list = []
        for name, robot in self.scene.robots.items():
            model = robot.robot.model
            arm = [robot_joint(plant, robot, j) for j in model.arm_joints]
            fingers = [robot_joint(plant, robot, j) for j in (model.gripper.joints if model.gripper else ())]
            self.arm[name] = slice(len(joints), len(joints) + len(arm))
            self.fingers[name] = slice(len(joints) + len(arm), len(joints) + len(arm) + len(fingers))
            joints += arm + fingers
        self.columns = np.array([j.position_start() for j in joints], dtype=int)
        self.lower = np.array([j.position_lower_limit() for j in joints])
        self.upper = np.array([j.position_upper_limit() for j in joints])
        number = {j.index(): i for i, j in enumerate(joints)}
        above = {}
        for index in plant.GetJointIndices():
            joint = plant.get_joint(index)
            above[joint.child_body().index()] = joint

        def carrier(body: RigidBody) -> int:
            while body.index() in above:
                joint = above[body.index()]
                if joint.index() in number:
                    return number[joint.index()]
                body = joint.parent_body()
            return -1

        self._carrier = carrier
        self._parent = [carrier(j.parent_body()) for j in joints]
        self._prismatic = np.array([j.type_name() == "prismatic" for j in joints])
        frames = [j.frame_on_parent().CalcPoseInWorld(self._kinematics) for j in joints]
        axes = [j.translation_axis() if j.type_name() == "prismatic" else j.revolute_axis() for j in joints]
        self._origin = np.array([X.translation() for X in frames]).reshape(-1, 3)
        self._axis = np.array([X.rotation().matrix() @ a for X, a in zip(frames, axes, strict=True)]).reshape(-1, 3)
        low = np.where(np.isfinite(self.lower), self.lower, -UNBOUNDED_SLIDE)
        high = np.where(np.isfinite(self.upper), self.upper, UNBOUNDED_SLIDE)
        at = self.base[self.columns]
        self._slide = np.where(self._prismatic, np.maximum(np.abs(low - at), np.abs(high - at)), 0.0)
        self.screws = Screws(self._axis, self._origin, self._prismatic, self._parent, at)
        self.grasp_body = {
            name: robot_body(plant, r, r.robot.model.grasp_body) for name, r in self.scene.robots.items()
        }
        self._X_BG = {name: r.robot.model.X_BG for name, r in self.scene.robots.items()}
        self.X_WG = {
            name: (body.EvalPoseInWorld(self._kinematics) @ self._X_BG[name]).GetAsMatrix4()
            for name, body in self.grasp_body.items()
        }
        """World poses (4, 4) of the grasp frames at the default configuration."""

    def reach(self, centres: np.ndarray, radii: np.ndarray, joint: int) -> np.ndarray:
        """Greatest distance (N,) from every joint axis of points in the hull of spheres carried by `joint`.

        `centres` (m, 3) are in the world at the default configuration; entries of joints that do not move them are 0.
        """
        out = np.zeros(len(self.columns))
        span, below = 0.0, -1
        while joint >= 0:
            if below < 0:
                arm = centres - self._origin[joint]
                radial = arm - np.outer(arm @ self._axis[joint], self._axis[joint])
                reach = float(np.max(np.linalg.norm(radial, axis=1) + radii))
                span = float(np.max(np.linalg.norm(arm, axis=1) + radii))
            else:
                link = self._origin[below] - self._origin[joint]
                reach = span + float(np.linalg.norm(link - (link @ self._axis[joint]) * self._axis[joint]))
                span += float(np.linalg.norm(link))
            out[joint] = 1.0 if self._prismatic[joint] else reach
            span += float(self._slide[joint])
            below, joint = joint, self._parent[joint]
        return out

    def upstream(self, joint: int) -> np.ndarray:
        """Which joints (N,) move what `joint` carries."""
        out = np.zeros(len(self.columns), dtype=bool)
        while joint >= 0:
            out[joint] = True
            joint = self._parent[joint]
        return out

    def joint_of_grasp(self, robot: str) -> int:
        """The joint that carries the grasp frame of `robot`."""
        return self._carrier(self.grasp_body[robot])

    def carried_reach(self, solid: Solid, robot: str, X_GO: np.ndarray) -> np.ndarray:
        """`reach` of a solid of an object that `robot` carries at X_GO."""
        X_WO = self.X_WG[robot] @ X_GO
        return self.reach(solid.centres @ X_WO[:3, :3].T + X_WO[:3, 3], solid.radii, self.joint_of_grasp(robot))

    def grasp_frames(self, z: np.ndarray, robots: Iterable[str]) -> dict[str, np.ndarray]:
        """World poses X_WG (S, 4, 4) of the grasp frames of `robots` at the composite configurations z (S, N)."""
        names = list(robots)
        out = {name: np.empty((len(z), 4, 4)) for name in names}
        if not names:
            return out
        q = self.base.copy()
        for i, row in enumerate(z):
            q[self.columns] = row
            self.plant.SetPositions(self._kinematics, q)
            for name in names:
                out[name][i] = self.grasp_body[name].EvalPoseInWorld(self._kinematics).GetAsMatrix4()
        return {name: X @ self._X_BG[name].GetAsMatrix4() for name, X in out.items()}

    # -- geometry ---------------------------------------------------------------------------------------------------

    def _solids(self, objects: list[RigidBody], statics: list[RigidBody]) -> None:
        self.solids: list[Solid] = []
        self.of: dict[str, list[int]] = {}
        """Solids of an object or a static body, by name."""
        for name, robot in self.scene.robots.items():
            for body in robot_bodies(self.plant, robot):
                self._add(body, Side("robot", name, body.name()))
        for kind, groups in (("object", self.scene.free_bodies), ("static", self.scene.statics)):
            for name, bodies in groups.items():
                for body in bodies:
                    self._add(body, Side(kind, name, body.name()))
        self._add(self.plant.world_body(), Side("static", WORLD, WORLD))
        for i, solid in enumerate(self.solids):
            if solid.side.kind != "robot":
                self.of.setdefault(solid.side.owner, []).append(i)
        self.index = {solid.id: i for i, solid in enumerate(self.solids)}
        self.gripper: dict[str, list[int]] = {}
        """Solids of a robot that may touch what it holds."""
        for name, robot in self.scene.robots.items():
            hand = touching_bodies(robot.robot.model)
            mine = ((i, s.side) for i, s in enumerate(self.solids) if s.side.kind == "robot" and s.side.owner == name)
            self.gripper[name] = [i for i, side in mine if side.body in hand]
        n = len(self.columns)
        self.static_reach = np.zeros((len(self.solids), n))
        self.static_upstream = np.zeros((len(self.solids), n), dtype=bool)
        self.X_WB = [solid.body.EvalPoseInWorld(self._kinematics).GetAsMatrix4() for solid in self.solids]
        """Body poses (4, 4) of the solids at the default configuration; those of static bodies hold always."""
        for i, (solid, X_WB) in enumerate(zip(self.solids, self.X_WB, strict=True)):
            if solid.joint >= 0:
                self.static_reach[i] = self.reach(
                    solid.centres @ X_WB[:3, :3].T + X_WB[:3, 3], solid.radii, solid.joint
                )
                self.static_upstream[i] = self.upstream(solid.joint)

    def _add(self, body: RigidBody, side: Side) -> None:
        inspector = self.scene.scene_graph.model_inspector()
        # An object's bodies move together; its pose is that of the first, so that is the frame of all its solids.
        frame = self.scene.free_bodies[side.owner][0] if side.kind == "object" else body
        X_FB = frame.EvalPoseInWorld(self._kinematics).inverse() @ body.EvalPoseInWorld(self._kinematics)
        for g in self.plant.GetCollisionGeometriesForBody(body):
            shape = inspector.GetShape(g)
            if isinstance(shape, HalfSpace):
                raise MrtampError(f"{side} has a half space as collision geometry; use a box: distances need a solid")
            X_FG: RigidTransform = X_FB @ inspector.GetPoseInFrame(g)
            if isinstance(shape, Sphere):
                points, radii = np.zeros((1, 3)), np.array([shape.radius()])
            elif isinstance(shape, Capsule):
                points = np.array([[0, 0, -shape.length() / 2], [0, 0, shape.length() / 2]])
                radii = np.full(2, shape.radius())
            else:
                box = inspector.GetObbInGeometryFrame(g)
                points = (box.pose().multiply((CORNERS * box.half_width()).T)).T
                radii = np.zeros(8)
            obb = inspector.GetObbInGeometryFrame(g)
            if obb is not None:
                X_FC, half = X_FG @ obb.pose(), np.asarray(obb.half_width())
            else:  # Drake gives no box for a sphere or a capsule of some versions
                X_FC, half = X_FG, np.abs(points).max(axis=0) + radii.max()
            X_FG4 = X_FG.GetAsMatrix4()
            centres = points @ X_FG4[:3, :3].T + X_FG4[:3, 3]
            bound = float(np.max(np.linalg.norm(centres - X_FC.translation(), axis=1) + radii))
            round_, disc = isinstance(shape, Sphere | Capsule), isinstance(shape, Cylinder)
            joint = self._carrier(body) if side.kind == "robot" else -1
            X = X_FC.GetAsMatrix4()
            self.solids.append(Solid(g, side, frame, joint, X, half, centres, radii, bound, round_, disc))

    def _envelopes(self) -> None:
        """Enclosing shapes of all solids, objects still in their own frames, and the pairs that may not touch."""
        frames = [X if s.side.kind != "object" else np.eye(4) for X, s in zip(self.X_WB, self.solids, strict=True)]
        X_WC = [X @ s.X_BC for X, s in zip(frames, self.solids, strict=True)]
        capsules = [
            (s.centres[[0, -1]], float(s.radii[0])) if s.round else capsule_around(s.X_BC, s.half) for s in self.solids
        ]
        self.envelopes = Envelopes(
            centre=np.array([X[:3, 3] for X in X_WC]),
            bound=np.array([s.bound for s in self.solids]),
            ends=np.array([ends @ X[:3, :3].T + X[:3, 3] for (ends, _), X in zip(capsules, frames, strict=True)]),
            radius=np.array([radius for _, radius in capsules]),
            axes=np.array([X[:3, :3] for X in X_WC]),
            half=np.array([s.half for s in self.solids]),
            round=np.array([s.round for s in self.solids]),
            disc=np.array([s.disc for s in self.solids]),
            joint=np.array([s.joint for s in self.solids]),
        )
        inspector = self.scene.scene_graph.model_inspector()
        n = len(self.solids)
        self.unfiltered = np.zeros((n, n), dtype=bool)
        for i, a in enumerate(self.solids):
            for j, b in enumerate(self.solids[:i]):
                own = a.side.kind == "object" and a.side.owner == b.side.owner
                self.unfiltered[j, i] = not own and not inspector.CollisionFiltered(a.id, b.id)

    def may_collide(self, i: int, j: int) -> bool:
        """Whether two solids can collide at all: not of one rigid thing, and not a pair the problem ignores."""
        return bool(self.unfiltered[min(i, j), max(i, j)])

    # -- distances --------------------------------------------------------------------------------------------------

    def positions(self, z: np.ndarray, X_WO: Mapping[str, np.ndarray], base: np.ndarray | None = None) -> np.ndarray:
        """Plant positions (S, nq) for composite configurations z (S, N) and object poses, (4, 4) or (S, 4, 4).

        What neither of them says is taken from `base` (nq,), by default the plant's default configuration.
        """
        q = np.repeat((self.base if base is None else base)[None], len(z), axis=0)
        q[:, self.columns] = z
        for name, X in X_WO.items():
            k = self.scene.floating[name]
            q[:, k : k + 7] = pose_coordinates(X.reshape(-1, 4, 4))
        return q

    def query(self, q: np.ndarray):
        """Drake's query object with the plant at positions q (nq,)."""
        self.plant.SetPositions(self.context, q)
        return self._query_port.Eval(self._graph_context)

    def penetrations(self, query) -> dict[tuple[int, int], float]:
        """Depth (m) of every two solids i < j that penetrate each other and may collide."""
        pairs = (sorted((self.index[p.id_A], self.index[p.id_B])) for p in query.ComputePointPairPenetration())
        return {(i, j): max(-self.distance(query, i, j), 0.0) for i, j in pairs if self.may_collide(i, j)}

    def distance(self, query, i: int, j: int) -> float:
        """Signed distance (m) of two solids; collision filters do not apply."""
        return self.nearest(query, i, j)[0]

    def nearest(self, query, i: int, j: int) -> tuple[float, np.ndarray]:
        """Signed distance (m) of two solids, and the direction (3,) along which they are that far apart, if known.

        Where Drake's search does not converge, which it may not for faces that touch, it is no more than that.
        """
        a, b = self.solids[i].id, self.solids[j].id
        try:
            found = query.ComputeSignedDistancePairClosestPoints(a, b)
            return found.distance, found.nhat_BA_W
        except RuntimeError:
            depths = [p.depth for p in query.ComputePointPairPenetration() if {p.id_A, p.id_B} == {a, b}]
            return -max(depths, default=0.0), _UNKNOWN


def pose_coordinates(X: np.ndarray) -> np.ndarray:
    """Poses (S, 4, 4) as a free body's positions (S, 7): qw, qx, qy, qz, x, y, z."""
    return np.hstack([quaternions(X[:, :3, :3]), X[:, :3, 3]])


def box_gap(p: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Distance (...) of points p (..., 3) from a box of half sizes `half` centred on their frame; 0 inside."""
    return np.linalg.norm(np.maximum(np.abs(p) - half, 0.0), axis=-1)
