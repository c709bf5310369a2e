"""Transition strata T^A: h_A(q), its Jacobian, rank and dimension, sampling and projection (paper, section IV).

An elementary stratum constrains one relative pose Y(q) to a k-parameter family, so h has 6 - k rows:

- pick, explicit grasp: rank 6; antipodal grasp that slides along the face and in depth: rank 4;
- place at a pose: rank 6; in a region with free yaw: rank 3;
- handover: the receiver's grasp relative to the giver's object, over both configurations: 6 - k of that grasp family.

A simultaneous stratum is the product of elementary ones with disjoint robots; ranks add (paper, equation 5).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mrtamp.kinematics import Tool, inverse
from mrtamp.transitions.families import Family, residual
from mrtamp.transitions.projection import mixed_seeds, solve_ik, uniform_configurations

_STEP = 1e-6


@dataclass(frozen=True, eq=False)
class Stratum:
    """An elementary stratum.  Y(q) = inverse(base) * X_WG(q_last) * offset must belong to `family`.

    `base` is constant (4, 4) for a pick (X_WO) or a place (X_WB of the support's body), and the held object's pose
    X_WG(q_0) * X_GO of the giver for a handover, when `giver_X_GO` is set.  `offset` is X_GO of what the active robot
    holds for a place, else the identity.
    """

    kind: str
    robots: tuple[str, ...]
    object: str
    tools: tuple[Tool, ...]
    family: Family
    base: np.ndarray
    offset: np.ndarray
    giver_X_GO: np.ndarray | None = None

    @property
    def active(self) -> tuple[str, ...]:
        """The active set A."""
        return tuple(sorted(self.robots))

    @property
    def dofs(self) -> int:
        """Degrees of freedom of the active robots together."""
        return sum(t.chain.n for t in self.tools)

    @property
    def rank(self) -> int:
        """Number of independent constraints, sum of k_r over A."""
        return len(self.family.rows)

    @property
    def dimension(self) -> int:
        """Dimension of the stratum within the active robots' configuration space; idle robots add their own."""
        return self.dofs - self.rank

    def split(self, q: np.ndarray) -> list[np.ndarray]:
        """Columns of q (N, dofs) per robot, in the order of `robots`."""
        return np.split(q, np.cumsum([t.chain.n for t in self.tools])[:-1], axis=1)

    def _base(self, parts: list[np.ndarray]) -> np.ndarray:
        if self.giver_X_GO is None:
            return self.base
        return self.tools[0].matrix(parts[0]) @ self.giver_X_GO

    def relative_pose(self, q: np.ndarray) -> np.ndarray:
        """Y(q) (N, 4, 4)."""
        parts = self.split(q)
        return inverse(self._base(parts)) @ self.tools[-1].matrix(parts[-1]) @ self.offset

    def h(self, q: np.ndarray) -> np.ndarray:
        """Constraint values (N, rank) at the active robots' configurations q (N, dofs); rad and m."""
        return residual(self.family, self.relative_pose(q))

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        """Dh (N, rank, dofs) by central differences of the batched kinematics (error about 1e-9)."""
        N, n = q.shape
        steps = _STEP * np.eye(n)
        plus = self.h((q[:, None] + steps).reshape(-1, n)).reshape(N, n, -1)
        minus = self.h((q[:, None] - steps).reshape(-1, n)).reshape(N, n, -1)
        return np.swapaxes(plus - minus, 1, 2) / (2 * _STEP)

    def draw_choices(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Continuous choices (n, k), uniform over the whole family: positive density everywhere."""
        return rng.uniform(self.family.lower, self.family.upper, size=(n, len(self.family.lower)))

    def sample(
        self, rng: np.random.Generator, n: int, near: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Try n samples: configurations (n, dofs), choices (n, k), and which are on the stratum (n,).

        `near` (M, dof of the last robot) biases the IK seeds.  Collisions are not considered here.
        """
        c = self.draw_choices(rng, n)
        parts = [uniform_configurations(t, rng, n) for t in self.tools]
        if near is not None:
            parts[-1] = mixed_seeds(self.tools[-1], rng, n, near)
        return self._solve(parts, c)

    def project(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Project configurations q (N, dofs) onto the stratum: nearest choice within bounds, then IK from q itself.

        In a handover the giver stays where it is.  Returns configurations, choices, success (N,).
        """
        parts = self.split(q)
        c = self.family.coordinates(self.relative_pose(q))
        return self._solve(parts, np.clip(c, self.family.lower, self.family.upper))

    def _solve(self, parts: list[np.ndarray], c: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        target = self.targets(self._base(parts), c)
        parts[-1], solved = solve_ik(self.tools[-1], target[:, :3, :3], target[:, :3, 3], parts[-1])
        return np.concatenate(parts, axis=1), c, solved

    def targets(self, base: np.ndarray, c: np.ndarray) -> np.ndarray:
        """Grasp frame poses X_WG (N, 4, 4) of the last robot that realise choices c (N, k)."""
        return base @ self.family.pose(c) @ inverse(self.offset)


@dataclass(frozen=True, eq=False)
class SimultaneousStratum:
    """Several elementary transitions at one composite configuration: A is the disjoint union, ranks add."""

    parts: tuple[Stratum, ...]

    @property
    def active(self) -> tuple[str, ...]:
        """The active set A."""
        return tuple(sorted(r for s in self.parts for r in s.robots))

    @property
    def rank(self) -> int:
        """Sum of the ranks."""
        return sum(s.rank for s in self.parts)

    @property
    def dofs(self) -> int:
        """Degrees of freedom of the active robots together."""
        return sum(s.dofs for s in self.parts)

    @property
    def dimension(self) -> int:
        """Dimension within the active robots' configuration space."""
        return self.dofs - self.rank

    def _split(self, q: np.ndarray) -> list[np.ndarray]:
        return np.split(q, np.cumsum([s.dofs for s in self.parts])[:-1], axis=1)

    def h(self, q: np.ndarray) -> np.ndarray:
        """Stacked constraints (N, rank)."""
        return np.concatenate([s.h(x) for s, x in zip(self.parts, self._split(q), strict=True)], axis=1)

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        """Block-diagonal Dh (N, rank, dofs)."""
        J = np.zeros((len(q), self.rank, self.dofs))
        row = column = 0
        for s, x in zip(self.parts, self._split(q), strict=True):
            J[:, row : row + s.rank, column : column + s.dofs] = s.jacobian(x)
            row, column = row + s.rank, column + s.dofs
        return J

    def sample(self, rng: np.random.Generator, n: int) -> tuple[np.ndarray, tuple[np.ndarray, ...], np.ndarray]:
        """n tries: configurations (n, dofs), choices per part, and which are on the stratum (n,)."""
        drawn = [s.sample(rng, n) for s in self.parts]
        return (
            np.concatenate([d[0] for d in drawn], axis=1),
            tuple(d[1] for d in drawn),
            np.logical_and.reduce([d[2] for d in drawn]),
        )

    def project(self, q: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, ...], np.ndarray]:
        """Project every part."""
        drawn = [s.project(x) for s, x in zip(self.parts, self._split(q), strict=True)]
        return (
            np.concatenate([d[0] for d in drawn], axis=1),
            tuple(d[1] for d in drawn),
            np.logical_and.reduce([d[2] for d in drawn]),
        )
