"""The collision geometries of one of the planner's plants as rounded boxes, for distances of many samples at once.

Shapes, poses in their bodies and filters are read out of Drake's SceneGraph: there is no second description.  Padding
is left out.  What is no rounded box (meshes, cylinders, ...) is bounded by spheres here and left to Drake where those
come near.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

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
class Placed:
    """Geometries at samples: rotations (S, B, 3, 3) of the bodies that they move with, and centres (S, G, 3), in W."""

    R: np.ndarray
    p: np.ndarray


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

        def add(found: Iterable[GeometryId]) -> np.ndarray:
            first = len(self.ids)
            for g in found:
                X, size = _rounded(scene, inspector, g)
                self.ids.append(g)
                R.append(X[:3, :3])
                p.append(X[:3, 3])
                sizes.append(size)
            return np.arange(first, len(self.ids))

        self._robots: dict[str, list[np.ndarray]] = {}
        for name, in_scene in scene.robots.items():
            own = {b.name(): geometry_ids(plant, [b]) for b in robot_bodies(plant, in_scene)}
            self._robots[name] = [add(own.get(b, [])) for b in bodies[name]]
        self._free = {name: add(geometry_ids(plant, parts)) for name, parts in scene.free_bodies.items()}
        self._static = add(g for parts in scene.statics.values() for g in geometry_ids(plant, parts))
        _, context = scene.context()
        poses = [
            plant.EvalBodyPoseInWorld(context, b).GetAsMatrix4()
            for parts in scene.statics.values()
            for b in parts
            for _ in geometry_ids(plant, [b])
        ]
        X = np.array(poses).reshape(-1, 4, 4)
        self._R, self._p = np.array(R).reshape(-1, 3, 3), np.array(p).reshape(-1, 3)
        # What is static moves with the world.
        self._p[self._static] = (X[:, :3, :3] @ self._p[self._static, :, None])[..., 0] + X[:, :3, 3]
        self._R[self._static] = X[:, :3, :3] @ self._R[self._static]
        self._turned = np.any(np.eye(3) != self._R, axis=(1, 2))
        self._body = np.zeros(len(self.ids), dtype=int)
        moving = [part for parts in self._robots.values() for part in parts] + list(self._free.values())
        for b, part in enumerate(moving, start=1):
            self._body[part] = b
        self._half = np.array([half for half, _, _, _ in sizes]).reshape(-1, 3)
        self._radius = np.array([radius for _, radius, _, _ in sizes])
        self._bound = np.array([bound for _, _, bound, _ in sizes])
        index = {g: i for i, g in enumerate(self.ids)}
        pairs = [(index[a], index[b]) for a, b in inspector.GetCollisionCandidates() if a in index and b in index]
        # The larger one first: the box around another tells more in its frame.
        both = np.array(sorted(sorted(x, key=lambda g: -self._bound[g]) for x in pairs), dtype=int).reshape(-1, 2)
        known = np.array([exact for _, _, _, exact in sizes], dtype=bool)
        mine = known[both].all(axis=1)
        self._pairs, self._others = both[mine], both[~mine]
        self.foreign = {g for g, k in zip(self.ids, known.tolist(), strict=True) if not k}
        """Geometries that are no rounded boxes."""

    def placed(self, n: int, robots: Mapping[str, Poses], free: Mapping[str, Poses]) -> Placed:
        """All geometries at n samples, from the poses of the robots' bodies (n, B) and of free bodies (n,).

        Free bodies that are not given are nowhere.
        """
        R, p = [np.broadcast_to(np.eye(3), (n, 1, 3, 3))], np.full((n, len(self.ids), 3), np.nan)
        p[:, self._static] = self._p[self._static]
        for name, parts in self._robots.items():
            R_WB, p_WB = robots[name]
            R.append(R_WB)
            for b, part in enumerate(parts):
                if len(part):
                    p[:, part] = self._carried(part, R_WB[:, b], p_WB[:, b])
        for name, part in self._free.items():
            R_WO, p_WO = free.get(name, (np.zeros((n, 3, 3)), None))
            R.append(R_WO[:, None])
            if p_WO is not None:
                p[:, part] = self._carried(part, R_WO, p_WO)
        return Placed(np.concatenate(R, axis=1), p)

    def _carried(self, part: np.ndarray, R: np.ndarray, p: np.ndarray) -> np.ndarray:
        """Centres (n, g, 3) of geometries that move with a body."""
        at = self._p[part]
        return p[:, None] + at @ np.swapaxes(R, 1, 2) if at.any() else p[:, None]

    def _solids(self, at: Placed, s: np.ndarray, g: np.ndarray) -> Solids:
        """Geometries g (N,) at samples s (N,)."""
        R = at.R[s, self._body[g]]
        turned = np.flatnonzero(self._turned[g])
        R[turned] = R[turned] @ self._R[g[turned]]
        return Solids(self._half[g], self._radius[g], R, at.p[s, g])

    def near(self, at: Placed, reach: float) -> Found:
        """All pairs of rounded boxes within `reach` (m) of each other."""
        s, c = self._within(at.p, self._pairs, reach)
        i, j = self._pairs[c].T
        a, b = self._solids(at, s, i), self._solids(at, s, j)
        maybe = np.flatnonzero(beyond(a, b) <= reach)
        maybe = maybe[beyond(b[maybe], a[maybe]) <= reach]
        d, n, x = signed_distances(a[maybe], b[maybe])
        close = np.flatnonzero(d < reach)
        kept = maybe[close]
        return Found(s[kept], i[kept], j[kept], d[close], n[close], x[close])

    def unsettled(self, at: Placed, reach: float) -> np.ndarray:
        """Samples at which something that is no rounded box may be within `reach` (m) of something else."""
        s, c = self._within(at.p, self._others, reach)
        if not len(s):
            return s
        i, j = self._others[c].T
        a, b = self._solids(at, s, i), self._solids(at, s, j)
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
