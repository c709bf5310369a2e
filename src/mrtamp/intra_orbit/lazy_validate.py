"""LazyValidate: one synchronous step of the tensor tree, judged from the cached factors (paper, algorithm 1)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from mrtamp.modes import Mode
from mrtamp.roadmap import Roadmap
from mrtamp.tensor_tree import At
from mrtamp.validity import Validity


def step_is_valid(roadmaps: Sequence[Roadmap], validity: Validity, mode: Mode, a: At, b: At) -> bool:
    """Whether the robots may move from vertices a to b in one step: robots alone first, then pairs of which one moves.

    The direction of travel makes no difference.
    """
    moving = [i for i in range(len(a)) if a[i] != b[i]]
    for i in moving:
        g = roadmaps[i]
        if not validity.edge(g.name, g.edge(a[i], b[i]), mode):
            return False
    pairs = [(i, j) for i in moving for j in range(len(a)) if j != i and not (j in moving and j < i)]
    return all(pair_is_apart(roadmaps, validity, mode, a, b, i, j) for i, j in pairs)


def pair_is_apart(roadmaps: Sequence[Roadmap], validity: Validity, mode: Mode, a: At, b: At, i: int, j: int) -> bool:
    """Whether robots i and j keep clear of each other in the step from a to b."""
    if a[i] == b[i]:
        i, j = j, i
    g, h = roadmaps[i], roadmaps[j]
    if a[i] == b[i]:
        return validity.against(g.name, g.edge(a[i], a[i]), mode, h.name, a[j])
    if a[j] == b[j]:
        return validity.against(g.name, g.edge(a[i], b[i]), mode, h.name, a[j])
    # One direction stands for both, so that the cache knows each synchronous motion once.
    k = min(i, j)
    if a[k] > b[k]:
        a, b = b, a
    return validity.move(mode, g.name, (a[i], b[i]), h.name, (a[j], b[j]))


def at_once(roadmaps: Sequence[Roadmap], validity: Validity, mode: Mode, goal: Mapping[int, int]) -> bool:
    """Whether robots (by index) could stand at their goal vertices at the same time, as far as they alone go."""
    at = tuple(goal.get(i, 0) for i in range(len(roadmaps)))
    return all(pair_is_apart(roadmaps, validity, mode, at, at, i, j) for i in goal for j in goal if i < j)
