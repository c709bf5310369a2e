"""What optimisation goes on from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mrtamp.optimise.choices import Arrangement
from mrtamp.optimise.polyline import Polyline

_WORTH, _FINER = 2e-3, 4.0
"""Share of the cost that is worth having at the first level, and by how much less is at every finer one."""


def worth(level: int) -> float:
    """Share of the cost that is worth having at a level."""
    return _WORTH / _FINER**level


@dataclass(frozen=True, eq=False)
class Iterate:
    """A polyline and what is attached to what along it."""

    line: Polyline
    q: np.ndarray
    arrangement: Arrangement
    cost: float
