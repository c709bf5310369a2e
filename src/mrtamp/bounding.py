"""Bounding spheres of geometries, bodies and robots: the cheap first answer to whether anything may touch at all.

A robot has two sets of spheres: one per body, whose centres also set an edge's resolution, and *beads*, several along
every collision shape, which fit more closely.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.geometry import Box, Capsule, Cylinder, Ellipsoid, GeometryId, SceneGraphInspector, Sphere

from mrtamp.kinematics import Chain
from mrtamp.scene import Scene, geometry_ids, robot_bodies

_MOST_BEADS = 8
"""Beads along one shape, at most: they no longer fit much more closely."""
_CORNERS = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T


@dataclass(frozen=True)
class _Extent:
    """A shape lies within `extra` (m) of the convex hull of `points` (k, 3), all in its own frame.

    `across` is the radius (m) of a cylinder along its longest axis that holds it, if that is less than the points show.
    """

    points: np.ndarray
    extra: float = 0.0
    across: float = np.inf

    def beads(self) -> tuple[np.ndarray, float]:
        """Centres (k, 3) and radius of equal spheres in a row that hold the shape."""
        low, high = self.points.min(axis=0), self.points.max(axis=0)
        centre = (low + high) / 2
        axis = int(np.argmax(high - low))
        off = np.delete(self.points - centre, axis, axis=1)
        across = min(self.across, float(np.linalg.norm(off, axis=1).max()) + self.extra)
        length = float(high[axis] - low[axis])
        if length == 0.0:
            return centre[None], self.extra
        length += 2 * self.extra
        k = min(_MOST_BEADS, int(np.ceil(length / max(2 * across, length / _MOST_BEADS) - 1e-9)))
        centres = np.repeat(centre[None], k, axis=0)
        centres[:, axis] += length * ((np.arange(k) + 0.5) / k - 0.5)
        return centres, float(np.hypot(across, length / (2 * k)))


def _extent(inspector: SceneGraphInspector, g: GeometryId) -> _Extent | None:
    """Where a geometry is; None for what has no end."""
    shape = inspector.GetShape(g)
    if isinstance(shape, Sphere):
        return _Extent(np.zeros((1, 3)), shape.radius())
    if isinstance(shape, Capsule):
        return _Extent(_CORNERS * [0, 0, shape.length() / 2], shape.radius())
    if isinstance(shape, Cylinder):
        r, half = shape.radius(), shape.length() / 2
        return _Extent(_CORNERS * [r, r, half], across=r if half > r else np.inf)
    if isinstance(shape, Box):
        return _Extent(_CORNERS * (np.asarray(shape.size()) / 2))
    if isinstance(shape, Ellipsoid):
        return _Extent(_CORNERS * [shape.a(), shape.b(), shape.c()])
    hull = inspector.GetConvexHull(g)
    return None if hull is None else _Extent(np.array([hull.vertex(i) for i in range(hull.num_vertices())]))


def beads_of(inspector: SceneGraphInspector, g: GeometryId) -> tuple[np.ndarray, float]:
    """Centres (k, 3) in the body frame and radius (m) of beads along a geometry; none where it has no end."""
    extent = _extent(inspector, g)
    if extent is None:
        return np.zeros((0, 3)), 0.0
    X = inspector.GetPoseInFrame(g).GetAsMatrix4()
    centres, radius = extent.beads()
    return centres @ X[:3, :3].T + X[:3, 3], radius


def geometry_bound(scene: Scene, body_geometries: Sequence[GeometryId]) -> tuple[np.ndarray, float]:
    """Centre (3,) in the body frame and radius (m) of a sphere around some collision geometries of one body."""
    inspector = scene.scene_graph.model_inspector()
    points, extra = [], []
    for g in body_geometries:
        extent = _extent(inspector, g)
        if extent is not None:
            X = inspector.GetPoseInFrame(g).GetAsMatrix4()
            points.append(extent.points @ X[:3, :3].T + X[:3, 3])
            extra += [extent.extra] * len(extent.points)
    if not points:
        return np.zeros(3), 0.0
    stacked = np.concatenate(points)
    centre = (stacked.min(axis=0) + stacked.max(axis=0)) / 2
    return centre, float((np.linalg.norm(stacked - centre, axis=1) + extra).max())


@dataclass
class Bounds:
    """Spheres around parts of a robot: `bodies` says which body each belongs to, `centres` (B, 3) are in its frame."""

    chain: Chain
    bodies: list[str]
    centres: np.ndarray
    radii: np.ndarray

    def spheres(self, q: np.ndarray) -> np.ndarray:
        """World centres (N, B, 3) at configurations q (N, n)."""
        return self._moved(*self.chain.poses(q, self.bodies))

    def placed(self, Rs: Sequence[np.ndarray], ps: Sequence[np.ndarray]) -> np.ndarray:
        """World centres (N, B, 3) where all bodies of the chain are at Rs (N, 3, 3), ps (N, 3), see `Chain.sweep`."""
        return self._moved(*self.chain.stacked(Rs, ps, self.bodies))

    def _moved(self, R: np.ndarray, p: np.ndarray) -> np.ndarray:
        """World centres (N, B, 3) where the bodies are at R (B, N, 3, 3), p (B, N, 3)."""
        # One product of a tall matrix per sphere: a fifth of the time of small ones.
        turned = R.reshape(len(R), -1, 3) @ self.centres[:, :, None]
        return np.swapaxes(p + turned.reshape(p.shape), 0, 1)


class Balls:
    """Balls, stacked in any way (..., K), of which one product tells whether any comes near any of others.

    The squared distance of two centres p, q less the square of the sum of their radii r, s is the product of
    (-2 p, -2 r, |p|^2 - r^2, 1) and (q, s, 1, |q|^2 - s^2).  It is as precise as the centres: single precision is right
    to some 1e-6 m.
    """

    def __init__(self, centres: np.ndarray, radii: np.ndarray) -> None:
        """Centres (..., K, 3) and radii (K,), in m."""
        self.centres = centres
        self.radii = radii
        self._rows: dict[float | None, np.ndarray] = {}

    def _row(self, margin: float | None) -> np.ndarray:
        """Left factors (..., K, 6), or right ones of balls that are larger by a margin; kept for single stacks."""
        known = self._rows.get(margin)
        if known is not None:
            return known
        p, r = self.centres, self.radii + (margin or 0.0)
        out = np.empty((*p.shape[:-1], 6), dtype=p.dtype)
        rest = np.einsum("...i,...i->...", p, p) - r**2
        out[..., :3], out[..., 3] = p, r
        if margin is None:
            out[..., :4] *= -2
            out[..., 4], out[..., 5] = rest, 1.0
        else:
            out[..., 4], out[..., 5] = 1.0, rest
        if p.ndim == 2:
            self._rows[margin] = out
        return out

    def near(self, other: Balls, margin: float) -> np.ndarray:
        """Whether any of these is less than `margin` (m) from any of the others (...)."""
        products = self._row(None) @ other._row(margin).swapaxes(-1, -2)
        return products.min(axis=(-1, -2)) < 0.0


def body_radius(scene: Scene, name: str) -> float:
    """Radius (m) around the body's origin that holds a free body."""
    centre, radius = geometry_bound(scene, geometry_ids(scene.plant, scene.free_bodies[name]))
    return float(np.linalg.norm(centre)) + radius


def robot_bounds(scene: Scene, name: str, chain: Chain) -> tuple[Bounds, Bounds]:
    """Spheres around a robot's bodies, one each, and its beads; both hold for every opening of its hand."""
    in_scene = scene.robots[name]
    inspector = scene.scene_graph.model_inspector()
    gripper = in_scene.robot.model.gripper
    # The chain shows fingers fully open; they close by at most this much.
    travel = max((abs(f) for f in gripper.joints.values()), default=0.0) * gripper.max_width if gripper else 0.0
    spheres: list[tuple[str, np.ndarray, float]] = []
    beads: list[tuple[str, np.ndarray, float]] = []
    for body in robot_bodies(scene.plant, in_scene):
        geometries = scene.plant.GetCollisionGeometriesForBody(body)
        if not geometries or body.name() not in chain.index:
            continue
        extra = travel if gripper and body.name() in gripper.bodies else 0.0
        centre, radius = geometry_bound(scene, geometries)
        spheres.append((body.name(), centre, radius + extra))
        for g in geometries:
            centres, radius = beads_of(inspector, g)
            beads += [(body.name(), c, radius + extra) for c in centres]
    return _bounds(chain, spheres), _bounds(chain, beads)


def _bounds(chain: Chain, spheres: Sequence[tuple[str, np.ndarray, float]]) -> Bounds:
    names, centres, radii = (list(x) for x in zip(*spheres, strict=True)) if spheres else ([], [], [])
    return Bounds(chain, names, np.reshape(centres, (-1, 3)), np.array(radii, dtype=float))
