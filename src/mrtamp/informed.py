"""Uniform samples of the points through which a path between two others is not longer than a bound."""

from __future__ import annotations

import numpy as np


def ellipsoid_sample(a: np.ndarray, b: np.ndarray, longest: float, rng: np.random.Generator) -> np.ndarray:
    """A point x (n,), uniform among those with |x - a| + |b - x| <= `longest` (Gammell et al., 2014).

    Where no point but those between a and b satisfies that, one of these.
    """
    n, d = len(a), b - a
    gap = float(np.linalg.norm(d))
    ball = rng.normal(size=n)
    ball *= rng.random() ** (1 / n) / max(float(np.linalg.norm(ball)), 1e-12)
    across = 0.5 * np.sqrt(max(longest**2 - gap**2, 0.0))
    x = across * ball
    if gap > 0:
        axis = d / gap
        x += (0.5 * max(longest, gap) - across) * float(axis @ ball) * axis
    return (a + b) / 2 + x
