"""Batched kinematics of one robot in numpy, extracted from its Drake plant.

Drake evaluates one configuration per call; sampling transition strata needs thousands.  `Chain` reads the joint
tree of a robot out of a finalised `MultibodyPlant` (no second description of the robot exists) and evaluates body
poses, the grasp frame and its Jacobian for a whole batch at once.  Poses are kept as rotation `R` (N, 3, 3) and
translation `p` (N, 3), expressed in the world W.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.tree import Joint

from mrtamp.problem import MrtampError

Array = np.ndarray


def inverse(X: Array) -> Array:
    """Inverse of rigid transforms, shape (..., 4, 4)."""
    Y = np.zeros_like(X)
    Rt = np.swapaxes(X[..., :3, :3], -1, -2)
    Y[..., :3, :3] = Rt
    Y[..., :3, 3] = -(Rt @ X[..., :3, 3:])[..., 0]
    Y[..., 3, 3] = 1.0
    return Y


def matrix(R: Array, p: Array) -> Array:
    """Homogeneous transforms (..., 4, 4) from rotations (..., 3, 3) and translations (..., 3)."""
    X = np.zeros((*R.shape[:-2], 4, 4))
    X[..., :3, :3] = R
    X[..., :3, 3] = p
    X[..., 3, 3] = 1.0
    return X


def quaternions(R: Array) -> Array:
    """Unit quaternions (N, 4), order w, x, y, z, of rotation matrices (N, 3, 3); largest-component form."""
    m = R.reshape(-1, 9)
    xx, yy, zz = m[:, 0], m[:, 4], m[:, 8]
    # The 4x4 outer product q q^T times four; the row with the largest diagonal is the best conditioned.
    K = np.empty((len(m), 4, 4))
    K[:, 0, 0] = 1 + xx + yy + zz
    K[:, 1, 1] = 1 + xx - yy - zz
    K[:, 2, 2] = 1 - xx + yy - zz
    K[:, 3, 3] = 1 - xx - yy + zz
    K[:, 0, 1] = K[:, 1, 0] = m[:, 7] - m[:, 5]
    K[:, 0, 2] = K[:, 2, 0] = m[:, 2] - m[:, 6]
    K[:, 0, 3] = K[:, 3, 0] = m[:, 3] - m[:, 1]
    K[:, 1, 2] = K[:, 2, 1] = m[:, 1] + m[:, 3]
    K[:, 1, 3] = K[:, 3, 1] = m[:, 2] + m[:, 6]
    K[:, 2, 3] = K[:, 3, 2] = m[:, 5] + m[:, 7]
    best = np.argmax(np.einsum("nii->ni", K), axis=1)
    q = K[np.arange(len(m)), best]
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def rotation_vectors(R: Array) -> Array:
    """Rotation vectors (N, 3), angle times axis, of rotation matrices (N, 3, 3)."""
    v = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    sine = np.sqrt((v * v).sum(axis=1))
    cosine = R[:, 0, 0] + R[:, 1, 1] + R[:, 2, 2] - 1.0
    scale = np.where(sine > 1e-12, np.arctan2(sine, cosine) / np.maximum(sine, 1e-300), 0.5)
    out = v * scale[:, None]
    # Near half a turn the axis is badly conditioned that way.
    half = np.flatnonzero(cosine < -1.9999)
    if len(half):
        out[half] = _by_quaternions(R[half])
    return out


def _by_quaternions(R: Array) -> Array:
    q = quaternions(R)
    q = np.where(q[:, :1] < 0, -q, q)
    norm = np.linalg.norm(q[:, 1:], axis=1)
    angle = 2 * np.arctan2(norm, q[:, 0])
    return q[:, 1:] * (angle / np.maximum(norm, 1e-300))[:, None]


@dataclass
class _Link:
    """One body: X_WL = X_W(parent) X M X_after with poses (4, 4), and M the motion of its joint along or about z."""

    parent: int
    X: Array
    kind: str = "weld"
    column: int = -1
    X_after: Array | None = None


def _rotation_to_z(axis: Array) -> Array:
    """A rotation whose third column is `axis`."""
    z = axis / np.linalg.norm(axis)
    x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


class Chain:
    """Forward kinematics of one robot's bodies for batches of arm configurations.

    Parameters
    ----------
    joints : all joints of the robot, of a finalised plant.
    base : name of its base link, fixed in the world at `X_WB`.
    arm_joints : names of the n joints that are planned for, in the order of q.
    fixed : positions (rad or m) of the other joints, such as fingers.
    """

    def __init__(
        self,
        joints: Sequence[Joint],
        base: str,
        X_WB: RigidTransform,
        arm_joints: tuple[str, ...],
        fixed: dict[str, float],
    ) -> None:
        self.n = len(arm_joints)
        self.lower = np.empty(self.n)
        self.upper = np.empty(self.n)
        self.velocity = np.empty(self.n)
        self.prismatic = np.zeros(self.n, dtype=bool)
        self.bodies: list[str] = [base]
        self.links = [_Link(-1, X_WB.GetAsMatrix4())]
        self.index = {base: 0}
        pending = [j for j in joints if j.child_body().name() != base]
        while pending:
            ready = [j for j in pending if j.parent_body().name() in self.index]
            if not ready:
                break
            for joint in ready:
                self._append(joint, arm_joints, fixed)
            pending = [j for j in pending if j.child_body().name() not in self.index]
        missing = [name for name in arm_joints if not any(j.name() == name for j in joints)]
        if missing:
            raise MrtampError(f"arm joints {missing} do not exist; the model has {[j.name() for j in joints]}")

    def _append(self, joint, arm_joints: tuple[str, ...], fixed: dict[str, float]) -> None:
        X_PF = joint.frame_on_parent().GetFixedPoseInBodyFrame().GetAsMatrix4()
        X_MC = joint.frame_on_child().GetFixedPoseInBodyFrame().inverse().GetAsMatrix4()
        kind = joint.type_name()
        parent = self.index[joint.parent_body().name()]
        if kind == "weld":
            link = _Link(parent, X_PF @ joint.X_FM().GetAsMatrix4() @ X_MC)
        elif kind in ("revolute", "prismatic"):
            axis = joint.revolute_axis() if kind == "revolute" else joint.translation_axis()
            Z = matrix(_rotation_to_z(np.asarray(axis)), np.zeros(3))
            X, X_after = X_PF @ Z, inverse(Z) @ X_MC
            if joint.name() in arm_joints:
                column = arm_joints.index(joint.name())
                self.lower[column] = joint.position_lower_limit()
                self.upper[column] = joint.position_upper_limit()
                self.velocity[column] = joint.velocity_upper_limit()
                self.prismatic[column] = kind == "prismatic"
                link = _Link(parent, X, kind, column, None if np.array_equal(X_after, np.eye(4)) else X_after)
            else:
                link = _Link(parent, X @ _motion(kind, fixed.get(joint.name(), 0.0)) @ X_after)
        else:
            raise MrtampError(
                f"joint {joint.name()} is of type {kind}; arms may have revolute, prismatic and fixed joints"
            )
        self.index[joint.child_body().name()] = len(self.links)
        self.bodies.append(joint.child_body().name())
        self.links.append(link)

    def poses(self, q: Array, bodies: list[str] | None = None) -> tuple[Array, Array]:
        """World poses of `bodies` (default: all): R (B, N, 3, 3), p (B, N, 3) for configurations q (N, n)."""
        Rs, ps, _ = self.sweep(q)
        return self.stacked(Rs, ps, bodies)

    def stacked(self, Rs: Sequence[Array], ps: Sequence[Array], bodies: list[str] | None = None) -> tuple[Array, Array]:
        """The same, where a sweep has found all bodies at Rs (N, 3, 3), ps (N, 3)."""
        rows = range(len(self.links)) if bodies is None else [self.index[b] for b in bodies]
        return np.stack([Rs[i] for i in rows]), np.stack([ps[i] for i in rows])

    def sweep(self, q: Array) -> tuple[list[Array], list[Array], list[tuple[int, Array, Array]]]:
        """Rotations (N, 3, 3) and translations (N, 3) of all bodies in W at q (N, n), and every joint's column, axis
        (N, 3) and a point (N, 3) on that axis."""
        N = len(q)
        # To turn a frame about its z is to multiply x + iy by exp(-i angle).
        turn = np.exp(-1j * q)
        found: list[Array] = []
        axes: list[tuple[int, Array, Array]] = []
        for link in self.links:
            # All rows of all poses at once: far less time than a product of matrices per sample.
            X = link.X[None, :3] if link.parent < 0 else _times(found[link.parent], link.X)
            if link.kind != "weld":
                if len(X) != N:
                    # Nothing before this joint moves.
                    X = np.repeat(X, N, axis=0)
                axis, origin = X[:, :, 2], X[:, :, 3]
                if link.kind == "revolute":
                    X.view(complex)[:, :, 0] *= turn[:, link.column, None]
                else:
                    origin = origin.copy()
                    X[:, :, 3] += axis * q[:, link.column, None]
                axes.append((link.column, axis, origin))
                if link.X_after is not None:
                    X = _times(X, link.X_after)
            found.append(X)
        whole = [X if len(X) == N else np.broadcast_to(X, (N, 3, 4)) for X in found]
        return [X[:, :, :3] for X in whole], [X[:, :, 3] for X in whole], axes


def _times(poses: Array, X: Array) -> Array:
    """Poses (N, 3, 4), without their last row, times a constant one (4, 4)."""
    return (poses.reshape(-1, 4) @ X).reshape(-1, 3, 4)


def _motion(kind: str, value: float) -> Array:
    """The pose (4, 4) to which a joint of value `value` (rad or m) moves along or about z."""
    out = np.eye(4)
    if kind == "prismatic":
        out[2, 3] = value
    else:
        c, s = np.cos(value), np.sin(value)
        out[:2, :2] = [[c, -s], [s, c]]
    return out


class Tool:
    """The grasp frame G of a robot: batched forward kinematics and geometric Jacobian."""

    def __init__(self, chain: Chain, body: str, X_BG: RigidTransform) -> None:
        self.chain = chain
        self._R = X_BG.rotation().matrix()
        self._p = X_BG.translation()
        self._body = chain.index[body]
        # Only the links between base and tool are swept.
        path, i = [], self._body
        while i >= 0:
            path.append(i)
            i = chain.links[i].parent
        self._arm = _sub_chain(chain, path[::-1])

    def pose(self, q: Array) -> tuple[Array, Array]:
        """R_WG (N, 3, 3) and p_WG (N, 3) at q (N, n)."""
        Rs, ps, _ = self._arm.sweep(q)
        return Rs[-1] @ self._R, ps[-1] + Rs[-1] @ self._p

    def carried(self, Rs: Sequence[Array] | Array, ps: Sequence[Array] | Array) -> tuple[Array, Array]:
        """R_WG (N, 3, 3) and p_WG (N, 3) from the poses of all bodies, as `Chain.sweep` returns them."""
        R, p = Rs[self._body], ps[self._body]
        return R @ self._R, p + R @ self._p

    def matrix(self, q: Array) -> Array:
        """X_WG (N, 4, 4) at q (N, n)."""
        return matrix(*self.pose(q))

    def jacobian(self, q: Array) -> tuple[Array, Array, Array]:
        """R_WG, p_WG and the geometric Jacobian J (N, 6, n): rows are angular, then translational velocity in W."""
        Rs, ps, axes = self._arm.sweep(q)
        R, p = Rs[-1] @ self._R, ps[-1] + Rs[-1] @ self._p
        J = np.zeros((len(q), 6, self.chain.n))
        arm = np.zeros((len(q), 3, self.chain.n))
        for column, axis, origin in axes:
            J[:, :3, column] = axis
            arm[:, :, column] = p - origin
        (a, b, c), (x, y, z) = ((v[:, 0], v[:, 1], v[:, 2]) for v in (J, arm))
        J[:, 3], J[:, 4], J[:, 5] = b * z - c * y, c * x - a * z, a * y - b * x
        slides = self.chain.prismatic
        if slides.any():
            J[:, 3:, slides], J[:, :3, slides] = J[:, :3, slides], 0.0
        return R, p, J


def _sub_chain(chain: Chain, path: list[int]) -> Chain:
    """The links of `path` alone, welds folded into their neighbours, for the tool's hot loop."""
    arm = object.__new__(Chain)
    arm.n = chain.n
    links: list[_Link] = []
    for i in path:
        link = chain.links[i]
        if link.kind != "weld" or not links:
            links.append(replace(link, parent=len(links) - 1))
            continue
        last = links[-1]
        if last.kind == "weld":
            last.X = last.X @ link.X
        else:
            last.X_after = link.X if last.X_after is None else last.X_after @ link.X
    arm.links = links
    return arm
