"""Optimisation of a whole plan by sequential convex programming, transitions sliding along their strata (DESIGN 8)."""

from mrtamp.optimise.local_search import LocalSearch
from mrtamp.optimise.optimiser import Optimiser

__all__ = ["LocalSearch", "Optimiser"]
