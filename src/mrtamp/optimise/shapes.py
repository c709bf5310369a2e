"""The collision geometries of one of the planner's plants as rounded boxes, for distances of many samples at once.

Shapes, poses in their bodies and filters are read out of Drake's SceneGraph: there is no second description.  Padding
is left out.  What is no rounded box (meshes, cylinders, ...) is bounded by spheres here and left to Drake where those
come near.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from pydrake.geometry import Box, Capsule, Cylinder, GeometryId, HalfSpace, SceneGraphInspector, Sphere

from mrtamp.bounding import geometry_bound
from mrtamp.optimise.rounded import Solids, beyond, signed_distances
from mrtamp.scene import Scene, geometry_ids, robot_bodies

Poses = tuple[np.ndarray, np.ndarray]
"""Rotations (S, ..., 3, 3) and translations (S, ..., 3) of bodies in W."""


@dataclass(frozen=True, eq=False)
class Found:
    """Pairs of geometries near each other: `sample` (P,), their indices `a`, `b` (P,), `distance` (P,), `normal` (P, 3)
    from b to a, and `witness` (P, 3) on a, in W."""

    sample: np.ndarray
    a: np.ndarray
    b: np.ndarray
    distance: np.ndarray
    normal: np.ndarray
    witness: np.ndarray


@dataclass(frozen=True, eq=False)
class _Group:
    """Geometries (g,) that move with the bodies of one thing: with which `body` (g,), and their poses R, p in it."""

    index: np.ndarray
    body: np.ndarray
    R: np.ndarray
    p: np.ndarray

    @cached_property
    def centred(self) -> bool:
        """Whether the geometries are where the frames of their bodies are."""
        return np.array_equal(self.R, np.tile(np.eye(3), (len(self.R), 1, 1))) and not self.p.any()


class Shapes:
    """Geometries of a plant of one robot or two, with the objects they may hold or meet.

    Parameters
    ----------
    scene : the plant.
    bodies : robot -> names of its bodies, in the order in which their poses will be given.

    Attributes
    ----------
    ids : the geometries, in the order of all indices.
    """

    def __init__(self, scene: Scene, bodies: Mapping[str, list[str]]) -> None:
        plant = scene.plant
        inspector = scene.scene_graph.model_inspector()
        self.ids: list[GeometryId] = []
        R: list[np.ndarray] = []
        p: list[np.ndarray] = []
        sizes: list[tuple[np.ndarray, float, float, bool]] = []

        def add(found: list[tuple[GeometryId, int]]) -> _Group:
            first = len(self.ids)
            for g, _ in found:
                X, size = _rounded(scene, inspector, g)
                self.ids.append(g)
                R.append(X[:3, :3])
                p.append(X[:3, 3])
                sizes.append(size)
            index = np.arange(first, len(self.ids))
            body = np.array([b for _, b in found], dtype=int)
            return _Group(index, body, np.array(R[first:]).reshape(-1, 3, 3), np.array(p[first:]).reshape(-1, 3))

        self._robots: dict[str, _Group] = {}
        for name, in_scene in scene.robots.items():
            number = {b: i for i, b in enumerate(bodies[name])}
            own = [b for b in robot_bodies(plant, in_scene) if b.name() in number]
            self._robots[name] = add([(g, number[b.name()]) for b in own for g in geometry_ids(plant, [b])])
        self._free: dict[str, _Group] = {}
        for name, parts in scene.free_bodies.items():
            self._free[name] = add([(g, 0) for g in geometry_ids(plant, parts)])
        self._static = add([(g, 0) for parts in scene.statics.values() for g in geometry_ids(plant, parts)])
        _, context = scene.context()
        poses = [
            plant.EvalBodyPoseInWorld(context, b).GetAsMatrix4()
            for parts in scene.statics.values()
            for b in parts
            for _ in geometry_ids(plant, [b])
        ]
        X = np.array(poses).reshape(-1, 4, 4)
        self._fixed = _carried(self._static, (X[None, :, :3, :3], X[None, :, :3, 3]), np.arange(len(X)))
        self._half = np.array([half for half, _, _, _ in sizes]).reshape(-1, 3)
        self._radius = np.array([radius for _, radius, _, _ in sizes])
        self._bound = np.array([bound for _, _, bound, _ in sizes])
        index = {g: i for i, g in enumerate(self.ids)}
        pairs = [(index[a], index[b]) for a, b in inspector.GetCollisionCandidates() if a in index and b in index]
        both = np.array(sorted((min(x), max(x)) for x in pairs), dtype=int).reshape(-1, 2)
        known = np.array([exact for _, _, _, exact in sizes], dtype=bool)
        mine = known[both].all(axis=1)
        self._pairs, self._others = both[mine], both[~mine]
        self.foreign = {g for g, k in zip(self.ids, known.tolist(), strict=True) if not k}
        """Geometries that are no rounded boxes."""

    def placed(self, n: int, robots: Mapping[str, Poses], free: Mapping[str, Poses]) -> Poses:
        """Poses of all geometries (n, G) at n samples, from those of the robots' bodies (n, B) and of free bodies (n,).

        Free bodies that are not given are nowhere.
        """
        R = np.zeros((n, len(self.ids), 3, 3))
        p = np.full((n, len(self.ids), 3), np.nan)
        R[:, self._static.index], p[:, self._static.index] = self._fixed
        for name, poses in robots.items():
            group = self._robots[name]
            R[:, group.index], p[:, group.index] = _carried(group, poses, group.body)
        for name, (R_WO, p_WO) in free.items():
            group = self._free[name]
            R[:, group.index], p[:, group.index] = _carried(group, (R_WO[:, None], p_WO[:, None]), group.body)
        return R, p

    def near(self, poses: Poses, reach: float) -> Found:
        """All pairs of rounded boxes within `reach` (m) of each other, at poses (S, G)."""
        R, p = poses
        s, c = self._within(p, self._pairs, reach)
        i, j = self._pairs[c].T
        a, b = (Solids(self._half[k], self._radius[k], R[s, k], p[s, k]) for k in (i, j))
        maybe = np.flatnonzero(beyond(a, b) <= reach)
        maybe = maybe[beyond(b[maybe], a[maybe]) <= reach]
        d, n, x = signed_distances(a[maybe], b[maybe])
        close = np.flatnonzero(d < reach)
        kept = maybe[close]
        return Found(s[kept], i[kept], j[kept], d[close], n[close], x[close])

    def unsettled(self, poses: Poses, reach: float) -> np.ndarray:
        """Samples at which something that is no rounded box may be within `reach` (m) of something else."""
        R, p = poses
        s, c = self._within(p, self._others, reach)
        i, j = self._others[c].T
        a, b = (Solids(self._half[k], self._radius[k], R[s, k], p[s, k]) for k in (i, j))
        endless = ~np.isfinite(self._bound[i] + self._bound[j])
        apart = (beyond(a, b) > reach) | (beyond(b, a) > reach)
        return np.unique(s[endless | ~apart])

    def _within(self, p: np.ndarray, pairs: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
        """Samples and numbers of the pairs whose bounding spheres come within `reach` (m)."""
        if not len(pairs):
            return np.zeros(0, dtype=int), np.zeros(0, dtype=int)
        i, j = pairs.T
        limit = self._bound[i] + self._bound[j] + reach
        # Coordinate by coordinate, with the samples last: every pass goes over long rows.
        square = np.zeros((len(pairs), len(p)))
        for x in np.ascontiguousarray(p.T):
            apart = x[i]
            apart -= x[j]
            apart *= apart
            square += apart
        c, s = np.divmod(np.flatnonzero(square < (limit * limit)[:, None]), len(p))
        return s, c


def _carried(group: _Group, poses: Poses, body: np.ndarray) -> Poses:
    R, p = poses[0][:, body], poses[1][:, body]
    if group.centred:
        return R, p
    return R @ group.R, p + (R @ group.p[..., None])[..., 0]


def _rounded(
    scene: Scene, inspector: SceneGraphInspector, g: GeometryId
) -> tuple[np.ndarray, tuple[np.ndarray, float, float, bool]]:
    """Pose (4, 4) of a geometry in its body; half size (3,) and radius of a rounded box, radius around its centre, and
    whether the geometry, without padding, is that box.  Otherwise it is somewhere in it, unless it has no end.
    """
    X = inspector.GetPoseInFrame(g).GetAsMatrix4()
    shape = inspector.GetShape(g)
    padding = scene.grown.get(g, 0.0)
    if isinstance(shape, Sphere):
        half, radius = np.zeros(3), shape.radius() - padding
    elif isinstance(shape, Capsule):
        half, radius = np.array([0.0, 0.0, shape.length() / 2]), shape.radius() - padding
    elif isinstance(shape, Box):
        half, radius = np.asarray(shape.size()) / 2 - padding, 0.0
    elif isinstance(shape, HalfSpace):
        return X, (np.zeros(3), 0.0, np.inf, False)
    elif isinstance(shape, Cylinder):
        half = np.array([shape.radius(), shape.radius(), shape.length() / 2])
        return X, (half, 0.0, float(np.hypot(shape.radius(), shape.length() / 2)), False)
    else:
        centre, bound = geometry_bound(scene, [g])
        X = np.eye(4)
        X[:3, 3] = centre
        return X, (np.zeros(3), bound, bound, False)
    return X, (half, radius, float(np.linalg.norm(half)) + radius, True)
