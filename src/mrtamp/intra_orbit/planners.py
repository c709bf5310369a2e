"""The intra-orbit planner: motion within one orbit, behind an interface of its own (paper, section V).

Two implementations extend the same tensor tree; `INTRA_ORBIT` names them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

import numpy as np

from mrtamp.deadline import Deadline
from mrtamp.intra_orbit.prioritised import Prioritised
from mrtamp.intra_orbit.tensor_search import TensorSearch
from mrtamp.problem import CostWeights
from mrtamp.roadmap import Roadmap
from mrtamp.steering import Insert
from mrtamp.tensor_tree import Node
from mrtamp.validity import Validity


class IntraOrbitPlanner(Protocol):
    """Extends the tree inside the orbit of a node; every step it inserts has been validated.

    Attributes
    ----------
    trouble : (robot, obstacle) -> how often the obstacle, another robot or "world", was found in the robot's way.
    """

    trouble: Counter[tuple[str, str]]

    def drive(self, node: Node, targets: Mapping[str, int], depth: int = 1) -> Node | None:
        """Extend the tree from `node` to a node at which every robot in `targets` stands at its vertex.

        The other robots may move aside, and others again for them, up to `depth` levels deep; 0: nobody moves aside.
        None if no such node was found.

        Raises
        ------
        TimeIsUp : the deadline has passed; what the tree was extended by until then is valid.
        """
        ...

    def explore(self, node: Node) -> Node | None:
        """A uniformly chosen tensor neighbour of `node`, if the step to it is valid: positive density for all."""
        ...


Factory = Callable[[Sequence[Roadmap], Validity, Insert, np.random.Generator, CostWeights, Deadline], IntraOrbitPlanner]

INTRA_ORBIT: dict[str, Factory] = {"tensor-tree": TensorSearch, "prioritised": Prioritised}
"""The implementations by name."""
