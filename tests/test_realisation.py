"""Which skeletons are drafted: those that refinement would bring to the same plan as another only once."""

from __future__ import annotations

import numpy as np
import pytest

from mrtamp.options import Happening, Skeleton
from mrtamp.realisation import _CHEAPER, _LIKE, _Drafted
from mrtamp.skeleton_guidance import Proposal
from mrtamp.transitions.ways import Stop, Way

ORDER = ((("red", 0, ("a", "b")), ("blue", 0, ("a", "b"))),)


def proposal(
    red: list[float],
    blue: list[float],
    *,
    order: tuple = ORDER,
    turned: bool = False,
    cost: float = 1.0,
    shortened: bool = True,
    robots: tuple[str, ...] = ("a", "b"),
) -> Proposal:
    ways = {
        item: Way((Stop("handover", robots, None, None, {r: np.array(q) for r in robots}),), shortened=shortened)
        for item, q in (("red", red), ("blue", blue))
    }
    happenings = tuple(Happening(item, 0, 0.0) for item in (reversed(ways) if turned else ways))
    skeleton = Skeleton({item: (0, 0) for item in ways}, happenings, cost, 1.0, {}, order)
    stops = tuple((ways[h.task].stops[0], ways[h.task]) for h in happenings)
    return Proposal(skeleton, stops, ((), ()), 0)


@pytest.mark.parametrize(
    ("other", "known"),
    [
        (proposal([0.0, 0.0], [1.0, 1.0]), True),
        (proposal([0.0, 0.9 * _LIKE], [1.0 - 0.9 * _LIKE, 1.0]), True),
        (proposal([0.0, 0.0], [1.0, 1.0 + 1.1 * _LIKE]), False),
        (proposal([1.0, 1.0], [0.0, 0.0]), False),
        # What has become clearly cheaper is worth another draft.
        (proposal([0.0, 0.0], [1.0, 1.0], cost=_CHEAPER + 0.01), True),
        (proposal([0.0, 0.0], [1.0, 1.0], cost=_CHEAPER - 0.01), False),
        # Only when things happen is different, which the decoupled timing decides anew.
        (proposal([0.0, 0.0], [1.0, 1.0], turned=True), True),
        (proposal([0.0, 0.0], [1.0, 1.0], order=()), False),
        (proposal([0.0, 0.0], [1.0, 1.0], shortened=False), False),
        (proposal([0.0, 0.0], [1.0, 1.0], robots=("a",)), False),
    ],
)
def test_shortened_handovers_near_to_drafted_ones_are_known(other: Proposal, known: bool) -> None:
    drafted = _Drafted()
    assert not drafted.knows(other)
    drafted.add(proposal([5.0, 5.0], [5.0, 5.0]))
    drafted.add(proposal([0.0, 0.0], [1.0, 1.0], robots=other.ways[0].robots))
    assert drafted.knows(other) is known
