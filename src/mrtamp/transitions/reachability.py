"""A robot's reachability map: random configurations and where they put the hand.

Two uses: how far a hand pose is from anything the robot was seen to reach, and IK seeds that start close to their
targets.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from mrtamp.kinematics import Tool
from mrtamp.transitions.projection import uniform_configurations

_SIZE = 2000
_LENGTH = 0.25
"""Distance (m) that counts as much as a turn of about one radian."""
_NEAREST = 8


class ReachabilityMap:
    """Poses of the grasp frame at uniform random configurations.

    Attributes
    ----------
    centre, radius : a ball (3,), m, that holds every grasp point of the map with a margin.
    """

    def __init__(self, tool: Tool) -> None:
        # A generator of its own: the map belongs to the robot, not to a planning run.
        self._q = uniform_configurations(tool, np.random.default_rng(0), _SIZE)
        R, p = tool.pose(self._q)
        self._tree = cKDTree(_features(R, p))
        self.centre = p.mean(axis=0)
        # Random configurations rarely stretch out fully.
        self.radius = 1.05 * float(np.linalg.norm(p - self.centre, axis=1).max()) + 0.03

    def distances(self, X_WG: np.ndarray) -> np.ndarray:
        """Squared distances (N,) from hand poses (N, 4, 4) to the nearest of the map; to turn by t is 2 (1 - cos t)."""
        return self._tree.query(_features(X_WG[:, :3, :3], X_WG[:, :3, 3]))[0] ** 2

    def seeds(self, X_WG: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """For each hand pose (N, 4, 4) one of the configurations (N, n) that come nearest to it."""
        nearest = self._tree.query(_features(X_WG[:, :3, :3], X_WG[:, :3, 3]), _NEAREST)[1]
        return self._q[nearest[np.arange(len(X_WG)), rng.integers(_NEAREST, size=len(X_WG))]]


def _features(R: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Points (N, 12) as far apart as poses are: half the square of the distance of two rotation matrices is 3 minus the
    trace of the one times the inverse of the other, 2 (1 - cos t)."""
    return np.concatenate([R.reshape(-1, 9) / np.sqrt(2), p / _LENGTH], axis=1)
