"""Screws: everything that moves a rigid body, as angular velocity and linear velocity at the origin, side by side (6,).

In that form velocities of bodies, of objects on bodies and of witness points need no case distinction: they add.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from mrtamp.kinematics import Chain


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products (..., 3); numpy's own spends its time on axes."""
    x, y, z = a[..., 0], a[..., 1], a[..., 2]
    u, v, w = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=-1)


def transported(screws: np.ndarray, X: np.ndarray) -> np.ndarray:
    """Screws (..., k, 6) of frame P in the frame in which P has pose X (..., 4, 4)."""
    R = np.swapaxes(X[..., :3, :3], -1, -2)
    omega = screws[..., :3] @ R
    return np.concatenate([omega, screws[..., 3:] @ R + cross(X[..., None, :3, 3], omega)], axis=-1)


def joint_screws(chain: Chain, q: np.ndarray) -> np.ndarray:
    """Screws (N, n, 6) of all joints in W at q (N, n)."""
    return screws_of(chain, len(q), chain.sweep(q)[2])


def screws_of(chain: Chain, n: int, axes: Iterable[tuple[int, np.ndarray, np.ndarray]]) -> np.ndarray:
    """The same (n, joints, 6) from the axes of a sweep of the chain."""
    out = np.zeros((n, chain.n, 6))
    for column, axis, origin in axes:
        if chain.prismatic[column]:
            out[:, column, 3:] = axis
        else:
            out[:, column, :3] = axis
            out[:, column, 3:] = cross(origin, axis)
    return out


def upstream(chain: Chain) -> dict[str, np.ndarray]:
    """Body -> which joints (n,) move it, 0 or 1."""
    masks: list[np.ndarray] = []
    for link in chain.links:
        mask = np.zeros(chain.n) if link.parent < 0 else masks[link.parent].copy()
        if link.column >= 0:
            mask[link.column] = 1.0
        masks.append(mask)
    return {body: masks[chain.index[body]] for body in chain.bodies}
