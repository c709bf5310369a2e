"""What optimisation goes on from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mrtamp.optimise.choices import Arrangement
from mrtamp.optimise.polyline import Polyline


@dataclass(frozen=True, eq=False)
class Iterate:
    """A polyline and what is attached to what along it."""

    line: Polyline
    q: np.ndarray
    arrangement: Arrangement
    cost: float
