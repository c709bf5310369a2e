"""Projection onto transition strata by inverse kinematics, batched in numpy.

Damped Gauss-Newton with the damping of Sugihara (2011): the square of the error plus a constant, so that it is Newton
near a solution and gradient descent far from one.  Joint limits are kept by clipping every iterate.
"""

from __future__ import annotations

import numpy as np

from mrtamp.kinematics import Tool, rotation_vectors

TOLERANCE = 1e-7
"""Largest residual (rad, m) of an accepted solution."""
ITERATIONS = 30
_DAMPING = 1e-5
_STEP = 1.0


def solve_ik(
    tool: Tool,
    R_WG: np.ndarray,
    p_WG: np.ndarray,
    q0: np.ndarray,
    iterations: int = ITERATIONS,
) -> tuple[np.ndarray, np.ndarray]:
    """Bring the grasp frame to N target poses from N seeds.

    Parameters
    ----------
    R_WG, p_WG : (N, 3, 3), (N, 3) targets in W.
    q0 : (N, n) seeds.

    Returns
    -------
    q : (N, n) final iterates, inside the joint limits; solved : (N,) whether the residual is at most `TOLERANCE`.
    """
    lower, upper = tool.chain.lower, tool.chain.upper
    q = np.clip(q0, lower, upper)
    solved = np.zeros(len(q), dtype=bool)
    active = np.arange(len(q))
    x = q.copy()
    best = np.full(len(q), np.inf)
    enough = max(8, len(q) // 3)
    eye = np.eye(6)
    for k in range(iterations):
        R, p, J = tool.jacobian(x)
        e = np.concatenate([rotation_vectors(R_WG[active] @ np.swapaxes(R, 1, 2)), p_WG[active] - p], axis=1)
        error = np.abs(e).max(axis=1)
        done = error <= TOLERANCE
        # A seed that has stopped improving is stuck at a limit or in a local minimum; it is not worth its time.
        stuck = (k >= 8) & (error > 0.05) & (error > 0.95 * best[active]) if k % 4 == 0 else np.zeros(len(x), bool)
        if k % 4 == 0:
            best[active] = np.minimum(best[active], error)
        if done.any() or stuck.any():
            q[active] = x
            solved[active[done]] = True
            keep = ~(done | stuck)
            active, x, e, J = active[keep], x[keep], e[keep], J[keep]
            # The rest of a large batch converges slowly or not at all; every seed has had a fair number of steps.
            if not len(active) or (k >= 14 and solved.sum() >= enough):
                break
        damping = 0.05 * (e * e).sum(axis=1) + _DAMPING
        A = J @ np.swapaxes(J, 1, 2) + damping[:, None, None] * eye
        dq = (np.swapaxes(J, 1, 2) @ np.linalg.solve(A, e[:, :, None]))[:, :, 0]
        size = np.abs(dq).max(axis=1, keepdims=True)
        x = np.clip(x + dq * np.minimum(1.0, _STEP / np.maximum(size, 1e-12)), lower, upper)
    q[active] = x
    return q, solved


def uniform_configurations(tool: Tool, rng: np.random.Generator, n: int) -> np.ndarray:
    """n configurations (n, dof), uniform within the limits (unlimited joints: half a turn, or one metre, each way)."""
    limit = np.where(tool.chain.prismatic, 1.0, np.pi)
    lower = np.where(np.isfinite(tool.chain.lower), tool.chain.lower, -limit)
    upper = np.where(np.isfinite(tool.chain.upper), tool.chain.upper, limit)
    return rng.uniform(lower, upper, size=(n, tool.chain.n))


def mixed_seeds(
    tool: Tool, rng: np.random.Generator, n: int, near: np.ndarray, spread: float = 0.5, share: float = 0.6
) -> np.ndarray:
    """IK seeds (n, dof): a share around `near` (M, dof) for short motions, the rest uniform for coverage."""
    q = uniform_configurations(tool, rng, n)
    local = rng.random(n) < share
    rows = rng.integers(len(near), size=n)
    noise = rng.normal(scale=spread, size=q.shape)
    return np.where(local[:, None], near[rows] + noise, q)
