"""Optimisation of a whole plan by sequential convex programming, transitions sliding along their strata (DESIGN 8)."""

from mrtamp.optimise.legs import Stock
from mrtamp.optimise.local_search import LocalSearch, tools_of
from mrtamp.optimise.optimiser import Optimiser

__all__ = ["LocalSearch", "Optimiser", "Stock", "tools_of"]
