"""How a solid stands on a surface: bounding boxes, faces, and the pose of an object on one of its faces.

Faces and directions are named by object axes: "-z" is the face (or direction) against the object's own z.  A surface
frame S has its origin on the surface and z out of it, as in `mrtamp.problem.Support`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from mrtamp.model_files import model_facts
from mrtamp.problem import MovableObject, Shape, StaticBody

FACES = ("-z", "+z", "-x", "+x", "-y", "+y")


def face_normal(face: str) -> np.ndarray:
    """The outward unit normal (3,) of `face`, in the frame of the solid."""
    normal = np.zeros(3)
    normal["xyz".index(face[1])] = 1.0 if face[0] == "+" else -1.0
    return normal


def opposite(face: str) -> str:
    """The face on the other side."""
    return ("-" if face[0] == "+" else "+") + face[1]


def shape_extent(shape: Shape) -> np.ndarray:
    """Full sizes (3,) of the axis-aligned bounding box of `shape`, which is centred on its frame."""
    if shape.kind == "box":
        return np.array(shape.size)
    diameter = 2 * shape.size[0]
    if shape.kind == "sphere":
        return np.full(3, diameter)
    return np.array([diameter, diameter, 2 * shape.half_height])


def bounding_box(
    body: MovableObject | StaticBody, package_paths: tuple[Path, ...] = ()
) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner (3,), (3,) of the bounding box of `body` in its own frame.

    Raises
    ------
    ProblemError
        The model of `body` cannot be parsed or has no collision geometry.
    """
    if body.shape is not None:
        half = shape_extent(body.shape) / 2
        return -half, half
    assert body.model is not None
    return model_facts(body.model, package_paths).bounding_box()


def face_rotation(face: str) -> RotationMatrix:
    """R_SO that turns `face` of the object onto a surface (its outward normal becomes -z_S), without further yaw."""
    turn = {
        "-z": RotationMatrix(),
        "+z": RotationMatrix.MakeXRotation(np.pi),
        "-x": RotationMatrix.MakeYRotation(-np.pi / 2),
        "+x": RotationMatrix.MakeYRotation(np.pi / 2),
        "-y": RotationMatrix.MakeXRotation(np.pi / 2),
        "+y": RotationMatrix.MakeXRotation(-np.pi / 2),
    }
    return turn[face]


def rest_height(body: MovableObject, face: str, package_paths: tuple[Path, ...] = ()) -> float:
    """Height (m) of the object's origin above the surface it stands on with `face`."""
    lower, upper = bounding_box(body, package_paths)
    axis = "xyz".index(face[1])
    return float(upper[axis] if face[0] == "+" else -lower[axis])


def resting_pose(
    body: MovableObject, face: str, xy: tuple[float, float], yaw: float, package_paths: tuple[Path, ...] = ()
) -> RigidTransform:
    """X_SO of `body` standing with `face` on the surface, origin at `xy` (m), turned by `yaw` about z_S (rad)."""
    R_SO = RotationMatrix.MakeZRotation(yaw) @ face_rotation(face)
    p_SO: Any = np.array([xy[0], xy[1], rest_height(body, face, package_paths)])
    return RigidTransform(R_SO, p_SO)


def face_down(X_SO: RigidTransform) -> tuple[str, float]:
    """The face of the object that looks most towards the surface, and its tilt away from it (rad)."""
    z_S_in_O = X_SO.rotation().matrix()[2]
    face = min(FACES, key=lambda name: float(face_normal(name) @ z_S_in_O))
    cosine = float(-(face_normal(face) @ z_S_in_O))
    return face, float(np.arccos(np.clip(cosine, -1.0, 1.0)))


def flat_face(
    shape: Shape | None, lower: np.ndarray, upper: np.ndarray, face: str
) -> tuple[RigidTransform, np.ndarray] | None:
    """X_BS and full size (2,) of the flat `face` of a body with this bounding box; None where it is round.

    On a cylinder's end the size is that of the inscribed square.
    """
    if shape is not None and (shape.kind in ("sphere", "capsule") or (shape.kind == "cylinder" and face[1] != "z")):
        return None
    normal = face_normal(face)
    centre = (lower + upper) / 2
    p_BS = centre + normal * ((upper - lower) / 2)
    # A top or bottom face keeps the body's x axis, so that sizes read as one expects.
    R_BS = RotationMatrix() if face == "+z" else face_rotation(opposite(face)).inverse()
    extent = np.abs(R_BS.matrix().T @ (upper - lower))[:2]
    if shape is not None and shape.kind == "cylinder":
        extent = np.full(2, shape.size[0] * np.sqrt(2))
    return RigidTransform(R_BS, p_BS), extent
