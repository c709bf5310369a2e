"""Families of relative poses: the continuous choices of a grasp or a placement.

A family is a smooth map from k bounded coordinates to relative poses X(c), with a chart back and the rows of the
six-dimensional residual that do not vanish identically.  Its members cut out a transition stratum of rank 6 - k.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from mrtamp.kinematics import inverse, matrix, rotation_vectors
from mrtamp.problem import AntipodalGrasps, ExplicitGrasp, MovableObject, Shape, Support
from mrtamp.resting import face_normal, face_rotation, rest_height


class Family(Protocol):
    """A k-parameter set of relative poses.

    `lower`, `upper` (k,) bound the coordinates; `rows` are the independent rows (of rotation vector, then
    translation) of the residual log(X(c(Y))^-1 Y) for a relative pose Y near the family.
    """

    @property
    def name(self) -> str:
        """What tells it from the other families."""
        ...

    @property
    def lower(self) -> np.ndarray:
        """Lower bounds (k,)."""
        ...

    @property
    def upper(self) -> np.ndarray:
        """Upper bounds (k,)."""
        ...

    @property
    def rows(self) -> tuple[int, ...]:
        """Independent rows of the residual."""
        ...

    def pose(self, c: np.ndarray) -> np.ndarray:
        """Members (N, 4, 4) at coordinates (N, k)."""
        ...

    def coordinates(self, Y: np.ndarray) -> np.ndarray:
        """Coordinates (N, k), not clipped, of the member nearest to relative poses Y (N, 4, 4)."""
        ...


def residual(family: Family, Y: np.ndarray) -> np.ndarray:
    """The constraint h (N, 6 - k): zero exactly on the members of the family (bounds aside)."""
    X = family.pose(family.coordinates(Y))
    D = inverse(X) @ Y
    parts = [rotation_vectors(D[:, :3, :3]), D[:, :3, 3]]
    if isinstance(family, RegionPlacement):
        # A placement's freedom lies along the axes of the support, however the object is turned on it.
        R_SO = family.X_BS[:3, :3].T @ X[:, :3, :3]
        parts = [np.einsum("nij,nj->ni", R_SO, v) for v in parts]
    return np.concatenate(parts, axis=1)[:, family.rows]


def _rotation_z(angle: np.ndarray) -> np.ndarray:
    R = np.zeros((len(angle), 3, 3))
    R[:, 0, 0] = R[:, 1, 1] = np.cos(angle)
    R[:, 1, 0] = np.sin(angle)
    R[:, 0, 1] = -R[:, 1, 0]
    R[:, 2, 2] = 1.0
    return R


@dataclass(frozen=True, eq=False)
class FixedFamily:
    """A single relative pose: no freedom, rank 6."""

    name: str
    X: np.ndarray
    width: float | None = None
    lower: np.ndarray = field(default_factory=lambda: np.zeros(0))
    upper: np.ndarray = field(default_factory=lambda: np.zeros(0))
    rows: tuple[int, ...] = (0, 1, 2, 3, 4, 5)

    def pose(self, c: np.ndarray) -> np.ndarray:
        """The pose, N times."""
        return np.broadcast_to(self.X, (len(c), 4, 4))

    def coordinates(self, Y: np.ndarray) -> np.ndarray:
        """Nothing to choose."""
        return np.zeros((len(Y), 0))


@dataclass(frozen=True, eq=False)
class SlidingGrasp:
    """Antipodal grasps of opposite flat faces: X_OG0 moved by s along x_G and d along z_G.

    Fixed coordinates (empty ranges) are not counted as freedom.
    """

    name: str
    X: np.ndarray
    width: float
    bounds: np.ndarray

    @property
    def _free(self) -> np.ndarray:
        return np.flatnonzero(self.bounds[:, 1] > self.bounds[:, 0])

    @property
    def lower(self) -> np.ndarray:
        """Lower bounds of the free coordinates."""
        return self.bounds[self._free, 0]

    @property
    def upper(self) -> np.ndarray:
        """Upper bounds of the free coordinates."""
        return self.bounds[self._free, 1]

    @property
    def rows(self) -> tuple[int, ...]:
        """Rotation, closing direction, and whichever slide is fixed."""
        slide = (3, 5)
        return (0, 1, 2, 4, *(slide[i] for i in (0, 1) if i not in self._free))

    def pose(self, c: np.ndarray) -> np.ndarray:
        """X_OG (N, 4, 4)."""
        t = np.tile(self.bounds[:, 0], (len(c), 1))
        t[:, self._free] = c
        X = np.tile(self.X, (len(c), 1, 1))
        X[:, :3, 3] += t[:, :1] * self.X[:3, 0] + t[:, 1:] * self.X[:3, 2]
        return X

    def coordinates(self, Y: np.ndarray) -> np.ndarray:
        """(s, d) read off the translation."""
        p = (inverse(self.X) @ Y)[:, :3, 3]
        return p[:, [0, 2]][:, self._free]


@dataclass(frozen=True, eq=False)
class TurningGrasp:
    """Grasps around a cylinder: turned by any angle about the object's z axis, then slid by s along `slide` of G.

    `slide` is 2 for a grasp from the end (depth) and 0 for one from the side (along the axis).
    """

    name: str
    X: np.ndarray
    width: float
    slide: int
    range: tuple[float, float]

    @property
    def _slides(self) -> bool:
        return self.range[1] > self.range[0]

    @property
    def lower(self) -> np.ndarray:
        """Angle, and slide where that is free."""
        return np.array([-np.pi, self.range[0]])[: 1 + self._slides]

    @property
    def upper(self) -> np.ndarray:
        """Angle, and slide where that is free."""
        return np.array([np.pi, self.range[1]])[: 1 + self._slides]

    @property
    def rows(self) -> tuple[int, ...]:
        """All but the turn (rotation about the G axis that is parallel to the object's z) and a free slide."""
        turn = 2 if self.slide == 2 else 0
        return tuple(i for i in range(6) if i != turn and not (self._slides and i == 3 + self.slide))

    def pose(self, c: np.ndarray) -> np.ndarray:
        """X_OG (N, 4, 4)."""
        Z = matrix(_rotation_z(c[:, 0]), np.zeros((len(c), 3)))
        X = np.tile(self.X, (len(c), 1, 1))
        slide = c[:, 1:] if self._slides else np.full((len(c), 1), self.range[0])
        X[:, :3, 3] += slide * self.X[:3, self.slide]
        return Z @ X

    def coordinates(self, Y: np.ndarray) -> np.ndarray:
        """The angle that brings the closing axis into line, and the slide along it."""
        y0, y = self.X[:3, 1], Y[:, :3, 1]
        angle = np.arctan2(y0[0] * y[:, 1] - y0[1] * y[:, 0], y0[0] * y[:, 0] + y0[1] * y[:, 1])
        Z = matrix(_rotation_z(-angle), np.zeros((len(Y), 3)))
        p = (inverse(self.X) @ Z @ Y)[:, :3, 3]
        return np.column_stack([angle, p[:, self.slide]])[:, : 1 + self._slides]


GraspFamily = FixedFamily | SlidingGrasp | TurningGrasp


def grasp_families(item: MovableObject, max_width: float, robot: str | None = None) -> list[GraspFamily]:
    """All grasp families of an object that fit an opening of `max_width` (m) and are not for other robots only."""
    out: list[GraspFamily] = []
    for number, grasp in enumerate(item.grasps):
        if robot is not None and grasp.robots is not None and robot not in grasp.robots:
            continue
        if isinstance(grasp, ExplicitGrasp):
            if grasp.width <= max_width:
                out.append(FixedFamily(f"grasp {number}", grasp.X_OG.GetAsMatrix4(), grasp.width))
        elif item.shape is not None:
            for approach in grasp.approaches:
                out += _antipodal(item.shape, grasp, approach, max_width)
    return out


def _frame(z: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.column_stack([np.cross(y, z), y, z])


def _antipodal(shape: Shape, grasp: AntipodalGrasps, approach: str, max_width: float) -> list[GraspFamily]:
    z = face_normal(approach)
    axis = int(np.argmax(np.abs(z)))
    if shape.kind == "box":
        extents = np.asarray(shape.size)
    elif shape.kind == "sphere":
        extents = np.full(3, 2 * shape.size[0])
    else:
        extents = np.array([2 * shape.size[0], 2 * shape.size[0], 2 * shape.half_height])
    out: list[GraspFamily] = []
    start = -z * extents[axis] / 2
    if shape.kind in ("cylinder", "capsule"):
        width = 2 * shape.size[0]
        if width > max_width:
            return []
        if axis == 2:
            X = matrix(_frame(z, np.array([0.0, 1.0, 0.0])), start)
            return [TurningGrasp(f"{approach} turning", X, width, 2, grasp.depth)]
        # From the side: the fingers straddle the axis, so the near face is a radius away and the depth is that radius.
        for sign in (1.0, -1.0):
            y = np.cross([0.0, 0.0, sign], z)
            X = matrix(_frame(z, y), np.zeros(3))
            s = (-grasp.offset, grasp.offset)
            out.append(TurningGrasp(f"side turning {'+' if sign > 0 else '-'}", X, width, 0, s))
        return out
    for closing in range(3):
        if closing == axis or extents[closing] > max_width:
            continue
        slide = min(grasp.offset, float(extents[3 - axis - closing]) / 2)
        for sign in (1.0, -1.0):
            y = np.zeros(3)
            y[closing] = sign
            bounds = np.array([[-slide, slide], grasp.depth])
            name = f"{approach} closing {'+' if sign > 0 else '-'}{'xyz'[closing]}"
            out.append(SlidingGrasp(name, matrix(_frame(z, y), start), float(extents[closing]), bounds))
    return out


@dataclass(frozen=True, eq=False)
class RegionPlacement:
    """Resting on a face inside a support: X_BO = X_BS * translate(x, y, h) * turn(yaw) * R_face.

    `reach` bounds |x| and |y| (m).
    """

    name: str
    X_BS: np.ndarray
    R_face: np.ndarray
    height: float
    reach: tuple[float, float]
    yaw: tuple[float, float]

    @property
    def _bounds(self) -> np.ndarray:
        x, y = self.reach
        return np.array([[-x, x], [-y, y], self.yaw])

    @property
    def _free(self) -> np.ndarray:
        return np.flatnonzero(self._bounds[:, 1] > self._bounds[:, 0])

    @property
    def lower(self) -> np.ndarray:
        """x, y, yaw, as far as they are free."""
        return self._bounds[self._free, 0]

    @property
    def upper(self) -> np.ndarray:
        """x, y, yaw, as far as they are free."""
        return self._bounds[self._free, 1]

    @property
    def rows(self) -> tuple[int, ...]:
        """Tilt and height, and what is not free, along the axes of S."""
        fixed = {0: 3, 1: 4, 2: 2}
        return (0, 1, 5, *(fixed[i] for i in range(3) if i not in self._free))

    def pose(self, c: np.ndarray) -> np.ndarray:
        """X_BO (N, 4, 4)."""
        full = np.tile(self._bounds[:, 0], (len(c), 1))
        full[:, self._free] = c
        X = matrix(_rotation_z(full[:, 2]), np.column_stack([full[:, :2], np.full(len(c), self.height)]))
        X[:, :3, :3] = X[:, :3, :3] @ self.R_face
        return self.X_BS @ X

    def coordinates(self, Y: np.ndarray) -> np.ndarray:
        """x, y and yaw read off the pose in S."""
        X = inverse(self.X_BS) @ Y
        R = X[:, :3, :3] @ self.R_face.T
        yaw = np.arctan2(R[:, 1, 0] - R[:, 0, 1], R[:, 0, 0] + R[:, 1, 1])
        middle = sum(self.yaw) / 2
        yaw = middle + (yaw - middle + np.pi) % (2 * np.pi) - np.pi
        return np.column_stack([X[:, :2, 3], yaw])[:, self._free]


PlacementFamily = FixedFamily | RegionPlacement


def placement_families(item: MovableObject, support: Support, package_paths: tuple = ()) -> list[PlacementFamily]:
    """All families of poses X_BO in which `item` rests on `support` (none where the support does not admit it)."""
    if support.body == item.name or (support.objects is not None and item.name not in support.objects):
        return []
    if support.X_BO is not None:
        return [FixedFamily(support.name, support.X_BO.GetAsMatrix4())]
    return [
        RegionPlacement(
            f"{support.name} on {face}",
            support.X_BS.GetAsMatrix4(),
            face_rotation(face).matrix(),
            rest_height(item, face, package_paths),
            support.reach,
            support.yaw,
        )
        for face in item.resting_faces
    ]
