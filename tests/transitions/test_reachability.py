"""The reachability map: what it says is nearest is nearest, by brute force over all its configurations."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RotationMatrix

from mrtamp import tasks
from mrtamp.collision import Collision
from mrtamp.kinematics import Tool, matrix
from mrtamp.transitions.reachability import ReachabilityMap


@pytest.fixture(scope="module")
def tool() -> Tool:
    problem = tasks.pick_place(1, 1)
    return Collision(problem).worlds[problem.robots[0].name].tool


def apart(X: np.ndarray, known: ReachabilityMap, tool: Tool) -> np.ndarray:
    """Squared distances (N, M) of poses (N, 4, 4) and those of the map, pair by pair."""
    R, p = tool.pose(known._q)
    out = np.empty((len(X), len(p)))
    for i, X_WG in enumerate(X):
        for k in range(len(p)):
            turn = RotationMatrix(R[k].T @ X_WG[:3, :3]).ToAngleAxis().angle()
            out[i, k] = np.sum((p[k] - X_WG[:3, 3]) ** 2) / 0.25**2 + 2 * (1 - np.cos(turn))
    return out


def test_distances_and_seeds_are_those_of_the_nearest(tool: Tool) -> None:
    known, rng = ReachabilityMap(tool), np.random.default_rng(1)
    axes = np.linalg.qr(rng.normal(size=(6, 3, 3)))[0]
    X = matrix(axes * np.linalg.det(axes)[:, None, None], rng.uniform(-0.8, 0.8, (6, 3)))
    brute = apart(X, known, tool)
    assert known.distances(X) == pytest.approx(brute.min(axis=1), rel=1e-9)
    nearest = [known._q[row].tolist() for row in np.argsort(brute, axis=1)[:, :8]]
    drawn = [known.seeds(X, rng) for _ in range(60)]
    assert all(q[i].tolist() in nearest[i] for q in drawn for i in range(len(X)))
    assert len(np.unique(np.array(drawn)[:, 0], axis=0)) == 8, "each of them now and then"
