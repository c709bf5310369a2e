"""Collision queries, factored: one robot with what it holds against the world, and pairs of robots.

Every query is answered by Drake's `QueryObject.HasCollisions` on a small plant of its own (DESIGN section 4).  What a
robot holds is a *slot*: a free body of the object's shape that may touch the gripper's bodies, so that changing a
mode never changes a collision filter.  Between two robots the arms' shapes are padded, because edges are checked at
samples only.  Where a problem tolerates some penetration, depths are asked for once something collides at all.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from pydrake.geometry import CollisionFilterDeclaration, GeometrySet, PenetrationAsPointPair, QueryObject

from mrtamp.bounding import Balls, body_radius, robot_bounds
from mrtamp.kinematics import Tool, quaternions
from mrtamp.modes import Attachment
from mrtamp.problem import MovableObject, Problem
from mrtamp.scene import Scene, build_scene, chain_of, geometry_ids, gripper_bodies, robot_bodies

RESOLUTION = 0.01
"""Largest distance (m) that any tracked point of a robot moves between two checked samples."""
PADDING = 0.003
"""Growth (m) of the arms' collision shapes in queries between two robots."""
CONTACT_DEPTH = 1e-3
"""Penetration (m) up to which an object counts as touching what it is lifted from or put on."""
_SURE = 1e-3
"""Distance (m) beyond their padding at which beads prove shapes apart, in single precision."""
_FEW = 3
"""Rows up to which it takes longer to place beads than to ask Drake."""
_FAR = 50.0


@dataclass
class Counts:
    """What the planner did, for reports that do not depend on the machine."""

    collision_checks: int = 0
    ik_attempts: int = 0
    ik_successes: int = 0
    edges_validated: int = 0
    nodes: int = 0

    def as_dict(self) -> dict[str, int]:
        """The counts by name."""
        return dict(vars(self))

    def work(self) -> dict[str, int]:
        """The counts by name as every planner reports them: `ik_calls` are seeds from which IK was solved."""
        return {**self.as_dict(), "ik_calls": self.ik_attempts}


def slot_keys(problem: Problem) -> dict[str, str]:
    """Objects with the same key share one slot: their collision geometry and their collision rules are the same."""
    out = {}
    for item in problem.objects:
        shape = f"{item.shape.kind}{item.shape.size}" if item.shape else f"model {item.model}"
        passes = {b if a == item.name else a for a, b in problem.collision.ignore if item.name in (a, b)}
        out[item.name] = shape + "".join(f" through {thing}" for thing in sorted(passes))
    return out


@lru_cache(maxsize=1024)
def bisection_order(n: int) -> np.ndarray:
    """The indices 0..n-1, ends first, then midpoints of the widest gaps: an invalid edge is found out early."""
    order, gaps = list(range(min(n, 1))) + list(range(max(n - 1, 1), n)), [(0, n - 1)]
    for low, high in gaps:
        middle = (low + high) // 2
        if middle not in (low, high):
            order.append(middle)
            gaps += [(low, middle), (middle, high)]
    out = np.array(order, dtype=int)
    out.flags.writeable = False
    return out


def _slots(problem: Problem, prefix: str) -> tuple[dict[str, MovableObject], dict[str, str]]:
    """Slot name -> an object of its shape, and object name -> the slot that shows it."""
    slots: dict[str, MovableObject] = {}
    slot_of = {name: f"{prefix}:{key}" for name, key in slot_keys(problem).items()}
    for item in problem.objects:
        slots.setdefault(slot_of[item.name], item)
    return slots, slot_of


class Posed(NamedTuple):
    """A robot at N configurations: N stacks of its beads and a ball around what it holds, and the poses (N, 7) of that.

    Where it stands still one stack will do.  `loads` is None where it holds nothing, see `load_poses`.
    """

    balls: Balls
    loads: np.ndarray | None


class RobotWorld:
    """One robot, open-handed or holding something, against itself, the static world and resting objects."""

    def __init__(self, problem: Problem, name: str, counts: Counts) -> None:
        self.name = name
        self.counts = counts
        self.tolerance = problem.collision.tolerance
        resting = {o.name: o for o in problem.objects}
        slots, self.slot_of = _slots(problem, "held")
        scene = build_scene(problem, robots=[name], free_bodies={**resting, **slots})
        self.scene = scene
        self.in_scene = scene.robots[name]
        self.chain, self.tool = chain_of(scene, name)
        self.home = problem.robot(name).home
        plant, manager = scene.plant, scene.scene_graph.collision_filter_manager()

        def geometries(bodies: Mapping) -> list:
            return [g for b in bodies.values() for g in geometry_ids(plant, b)]

        objects = geometries({k: scene.free_bodies[k] for k in resting})
        held = geometries({k: scene.free_bodies[k] for k in slots})
        static = geometries(scene.statics)
        hand = geometry_ids(plant, gripper_bodies(plant, self.in_scene))
        declare = CollisionFilterDeclaration()
        declare.ExcludeWithin(GeometrySet(objects)).ExcludeBetween(GeometrySet(objects), GeometrySet(static))
        declare.ExcludeWithin(GeometrySet(held)).ExcludeBetween(GeometrySet(held), GeometrySet(hand))
        manager.Apply(declare)
        self.root, self.context = scene.context()
        self._port = plant.get_geometry_query_input_port()
        self._plant = plant
        self._owner = _owners(scene)
        template = plant.GetPositions(self.context)
        for i, body in enumerate(scene.floating):
            X = np.eye(4)
            X[:3, 3] = [_FAR + 5.0 * i, _FAR, _FAR]
            scene.write_pose(template, body, X)
        template[self.in_scene.fingers] = self.in_scene.finger_positions(None)
        template[self.in_scene.arm] = self.home
        self._template = template
        self.bounds, self.beads = robot_bounds(scene, name, self.chain)
        self.object_radius = {o: body_radius(scene, o) for o in resting}
        self._pose7: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def rows(self, q: np.ndarray, held: Attachment | None, objects: Mapping[str, np.ndarray]) -> np.ndarray:
        """Position vectors (N, nq) of the plant for configurations q (N, n) and resting poses X_WO (4, 4)."""
        rows = np.repeat(self._template[None], len(q), axis=0)
        rows[:, self.in_scene.arm] = q
        for name, X in objects.items():
            k = self.scene.floating[name]
            rows[:, k : k + 7] = self._seven(X)
        if held is not None:
            rows[:, self.in_scene.fingers] = self.in_scene.finger_positions(held.width)
            write_held(self.scene, rows, self.slot_of[held.object], self.tool, q, held)
        return rows

    def spheres_and_grasp(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Centres (N, B, 3) of the bodies' spheres, and R_WG (N, 3, 3), p_WG (N, 3), at configurations q (N, n)."""
        Rs, ps, _ = self.chain.sweep(q)
        return self.bounds.placed(Rs, ps), *self.tool.carried(Rs, ps)

    def posed(self, q: np.ndarray, held: Attachment | None) -> Posed:
        """The robot, with what it holds, at configurations q (N, n)."""
        Rs, ps, _ = self.chain.sweep(q)
        # Many are kept: single precision will do.
        centres, radii = self.beads.placed(Rs, ps).astype(np.float32), self.beads.radii
        if held is None:
            return Posed(Balls(centres, radii), None)
        loads = _carried(*self.tool.carried(Rs, ps), held)
        centres = np.concatenate([centres, loads[:, None, 4:].astype(np.float32)], axis=1)
        return Posed(Balls(centres, np.append(radii, self.object_radius[held.object])), loads)

    def _seven(self, X: np.ndarray) -> np.ndarray:
        known = self._pose7.get(id(X))
        if known is None or known[0] is not X:
            known = (X, np.concatenate([quaternions(X[None, :3, :3])[0], X[:3, 3]]))
            self._pose7[id(X)] = known
        return known[1]

    def first_hit(self, rows: np.ndarray, contact: str | None = None, slot: str | None = None) -> int:
        """Index of the first row in collision, or -1.  `contact`: a body that the slot may touch."""
        plant, context, port = self._plant, self.context, self._port
        lenient = contact is not None or self.tolerance > 0
        for i, row in enumerate(rows):
            plant.SetPositions(context, row)
            self.counts.collision_checks += 1
            query = port.Eval(context)
            if query.HasCollisions() and not (lenient and self._tolerated(query, contact, slot)):
                return i
        return -1

    def hits(self, rows: np.ndarray) -> np.ndarray:
        """Which rows are in collision (N,)."""
        return np.array([self.first_hit(row[None]) == 0 for row in rows], dtype=bool)

    def _tolerated(self, query: QueryObject, contact: str | None, slot: str | None) -> bool:
        found = self._penetrations(query, contact, slot)
        if self.tolerance == 0.0:
            return next(found, None) is None
        return within(self.tolerance, (depth_of(query, p) for p in found))

    def _penetrations(
        self, query: QueryObject, contact: str | None, slot: str | None
    ) -> Iterator[PenetrationAsPointPair]:
        """Collisions that are no touch of the slot and its contact, those likely to be the deepest first."""
        for p in sorted(query.ComputePointPairPenetration(), key=lambda p: -p.depth):
            touching = {self._owner[p.id_A], self._owner[p.id_B]} == {contact, slot}
            if not touching or (p.depth > CONTACT_DEPTH and depth_of(query, p) > CONTACT_DEPTH):
                yield p

    def culprits(self, row: np.ndarray, contact: str | None = None, slot: str | None = None) -> list[tuple[str, str]]:
        """Names of the two owners (robot, static body, object or slot) of every collision at one row."""
        self._plant.SetPositions(self.context, row)
        found = self._penetrations(self._port.Eval(self.context), contact, slot)
        return [(self._owner[p.id_A], self._owner[p.id_B]) for p in found]


class RobotPair:
    """Two robots with what they hold, against each other only."""

    def __init__(self, problem: Problem, a: RobotWorld, b: RobotWorld, counts: Counts) -> None:
        self.counts = counts
        self.worlds = (a, b)
        self.tolerance = problem.collision.tolerance
        slots, self.slot_of = zip(*(_slots(problem, world.name) for world in self.worlds), strict=True)
        scene = build_scene(
            problem,
            robots=[a.name, b.name],
            free_bodies={**slots[0], **slots[1]},
            statics=False,
            padding={a.name: PADDING, b.name: PADDING},
        )
        self.scene = scene
        plant, manager = scene.plant, scene.scene_graph.collision_filter_manager()
        for world, own in zip(self.worlds, slots, strict=True):
            bodies = robot_bodies(plant, scene.robots[world.name]) + [b for s in own for b in scene.free_bodies[s]]
            # A robot's own collisions are judged in its own plant.
            manager.Apply(CollisionFilterDeclaration().ExcludeWithin(GeometrySet(geometry_ids(plant, bodies))))
        self.root, self.context = scene.context()
        self._plant, self._port = plant, plant.get_geometry_query_input_port()
        template = plant.GetPositions(self.context)
        for i, body in enumerate(scene.floating):
            X = np.eye(4)
            X[:3, 3] = [_FAR + 5.0 * i, _FAR, _FAR]
            scene.write_pose(template, body, X)
        self._template = template

    def rows(
        self,
        qa: np.ndarray,
        held_a: Attachment | None,
        qb: np.ndarray,
        held_b: Attachment | None,
        widths: tuple[float | None, float | None] = (None, None),
        loads: Sequence[np.ndarray | None] = (None, None),
    ) -> np.ndarray:
        """Position vectors (N, nq) of the plant; see `first_hit`; `loads` as in `Posed`."""
        rows = np.repeat(self._template[None], len(qa), axis=0)
        for i, (q, held) in enumerate(((qa, held_a), (qb, held_b))):
            in_scene = self.scene.robots[self.worlds[i].name]
            rows[:, in_scene.arm] = q
            rows[:, in_scene.fingers] = in_scene.finger_positions(held.width if held else widths[i])
            if held is not None:
                known = loads[i]
                poses = load_poses(self.worlds[i].tool, q, held) if known is None else known
                k = self.scene.floating[self.slot_of[i][held.object]]
                rows[:, k : k + 7] = poses
        return rows

    def first_hit(
        self,
        qa: np.ndarray,
        held_a: Attachment | None,
        qb: np.ndarray,
        held_b: Attachment | None,
        widths: tuple[float | None, float | None] = (None, None),
        exact: np.ndarray | None = None,
        posed: tuple[Posed | None, Posed | None] = (None, None),
    ) -> int:
        """Index of the first pair of rows of qa (N, na), qb (N, nb) in collision, or -1.

        `widths` are the openings (m) of hands that hold nothing; None: fully open.  `exact` (N,) says at which rows the
        robots may stand: there the shapes count as they are, without padding, which is for motion between samples.
        `posed` are the robots at those rows, see `RobotWorld.posed`, where that is known already.
        """
        one, two = posed
        index = np.arange(len(qa))
        loads: tuple[np.ndarray | None, ...] = (None, None)
        if len(qa) > _FEW or (one is not None and two is not None):
            # What beads prove apart Drake is not asked about.
            one = self.worlds[0].posed(qa, held_a) if one is None else one
            two = self.worlds[1].posed(qb, held_b) if two is None else two
            index = np.flatnonzero(one.balls.near(two.balls, 2 * PADDING + _SURE))
            if not len(index):
                return -1
            loads = tuple(None if x.loads is None else x.loads[index] for x in (one, two))
        rows = self.rows(qa[index], held_a, qb[index], held_b, widths, loads)
        plant, context, port = self._plant, self.context, self._port
        lenient = self.tolerance > 0
        for i, row in zip(index.tolist(), rows, strict=True):
            plant.SetPositions(context, row)
            self.counts.collision_checks += 1
            query = port.Eval(context)
            if query.HasCollisions() and not ((lenient or (exact is not None and exact[i])) and self._tolerated(query)):
                return i
        return -1

    def _tolerated(self, query: QueryObject) -> bool:
        """Whether the shapes as they are penetrate no more than is tolerated."""
        found = sorted(query.ComputePointPairPenetration(), key=lambda p: -p.depth)
        padding = [self.scene.padding(p.id_A, p.id_B) for p in found]
        if sum(max(p.depth - extra, 0.0) for p, extra in zip(found, padding, strict=True)) <= self.tolerance:
            return True
        return within(self.tolerance, (depth_of(query, p) - extra for p, extra in zip(found, padding, strict=True)))


def within(tolerance: float, depths: Iterable[float]) -> bool:
    """Whether penetrations (m) add up to no more than is tolerated; asks for no more of them than it takes to know."""
    total = 0.0
    for depth in depths:
        total += max(depth, 0.0)
        if total > tolerance:
            return False
    return True


def depth_of(query: QueryObject, p: PenetrationAsPointPair) -> float:
    """How deep (m) two geometries penetrate each other: along the shortest way out, the negative signed distance.

    The depth that comes with `p` is an upper bound only, several times too large where a capsule lies in a box.  It has
    to do where Drake's search for the distance does not converge, which happens, if rarely, for boxes face to face.
    """
    try:
        return -float(query.ComputeSignedDistancePairClosestPoints(p.id_A, p.id_B).distance)
    except RuntimeError:
        return float(p.depth)


def write_held(scene: Scene, rows: np.ndarray, slot: str, tool: Tool, q: np.ndarray, held: Attachment) -> None:
    """Write the pose of a held object for configurations q (N, n) into position vectors (N, nq) in place."""
    k = scene.floating[slot]
    rows[:, k : k + 7] = load_poses(tool, q, held)


def load_poses(tool: Tool, q: np.ndarray, held: Attachment) -> np.ndarray:
    """World poses (N, 7) of what is held at configurations q (N, n): quaternion (w, x, y, z), then position."""
    return _carried(*tool.pose(q), held)


def _carried(R_WG: np.ndarray, p_WG: np.ndarray, held: Attachment) -> np.ndarray:
    """World poses (N, 7) of what is held by hands at R_WG (N, 3, 3), p_WG (N, 3)."""
    return np.concatenate([quaternions(R_WG @ held.X_PO[:3, :3]), p_WG + R_WG @ held.X_PO[:3, 3]], axis=1)


def _owners(scene: Scene) -> dict:
    """Geometry id -> name of the robot, static body, object or slot it belongs to."""
    out = {}
    for name, in_scene in scene.robots.items():
        out.update(dict.fromkeys(geometry_ids(scene.plant, robot_bodies(scene.plant, in_scene)), name))
    for name, bodies in [*scene.statics.items(), *scene.free_bodies.items()]:
        out.update(dict.fromkeys(geometry_ids(scene.plant, bodies), name))
    return out


@dataclass
class Collision:
    """All collision plants of a problem: one per robot at once, one per pair of robots when first needed."""

    problem: Problem
    counts: Counts = field(default_factory=Counts)
    worlds: dict[str, RobotWorld] = field(default_factory=dict)
    _pairs: dict[tuple[str, str], RobotPair] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for robot in self.problem.robots:
            self.worlds[robot.name] = RobotWorld(self.problem, robot.name, self.counts)

    def pair(self, a: str, b: str) -> tuple[RobotPair, bool]:
        """The plant of robots a and b, and whether it knows them in the other order."""
        if (b, a) in self._pairs:
            return self._pairs[b, a], True
        if (a, b) not in self._pairs:
            self._pairs[a, b] = RobotPair(self.problem, self.worlds[a], self.worlds[b], self.counts)
        return self._pairs[a, b], False

    def first_hit(
        self,
        a: str,
        qa: np.ndarray,
        held_a: Attachment | None,
        b: str,
        qb: np.ndarray,
        held_b: Attachment | None,
        widths: tuple[float | None, float | None] = (None, None),
        exact: np.ndarray | None = None,
        posed: tuple[Posed | None, Posed | None] = (None, None),
    ) -> int:
        """`RobotPair.first_hit` for two robots, whichever comes first in their plant."""
        pair, swapped = self.pair(a, b)
        if swapped:
            return pair.first_hit(qb, held_b, qa, held_a, widths[::-1], exact, posed[::-1])
        return pair.first_hit(qa, held_a, qb, held_b, widths, exact, posed)
