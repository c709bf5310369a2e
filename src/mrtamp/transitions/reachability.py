"""A robot's reachability map: random configurations and where they put the hand.

Two uses: how far a hand pose is from anything the robot was seen to reach, and IK seeds that start close to their
targets.
"""

from __future__ import annotations

import numpy as np

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
        R, self._p = tool.pose(self._q)
        self._R = R.reshape(_SIZE, 9)
        self.centre = self._p.mean(axis=0)
        # Random configurations rarely stretch out fully.
        self.radius = 1.05 * float(np.linalg.norm(self._p - self.centre, axis=1).max()) + 0.03

    def distances(self, X_WG: np.ndarray) -> np.ndarray:
        """Squared distances (N, M) of hand poses (N, 4, 4) to those of the map; a turn by t counts 2 (1 - cos t)."""
        # einsum, because a matrix product of this shape is spread over threads, which costs more than it gains.
        p = X_WG[:, :3, 3]
        square = (p**2).sum(axis=1)[:, None] + (self._p**2).sum(axis=1) - 2 * np.einsum("ni,mi->nm", p, self._p)
        turn = 3 - np.einsum("ni,mi->nm", X_WG[:, :3, :3].reshape(-1, 9), self._R)
        return square / _LENGTH**2 + turn

    def seeds(self, X_WG: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """For each hand pose (N, 4, 4) one of the configurations (N, n) that come nearest to it."""
        nearest = np.argpartition(self.distances(X_WG), _NEAREST, axis=1)[:, :_NEAREST]
        return self._q[nearest[np.arange(len(X_WG)), rng.integers(_NEAREST, size=len(X_WG))]]
