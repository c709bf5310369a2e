"""Tolerated penetration: all that is about to collide at one instant has a share in it, and no more than all of it."""

from __future__ import annotations

import numpy as np
import pytest

from mrtamp.optimise.collisions import _CONTENDS, _Found
from mrtamp.optimise.nearness import Near, Samples


def found(sample: list[int], distance: list[float], touching: list[bool] | None = None) -> _Found:
    """Pairs of solids at samples of which there are four; where one touches what it rests on it needs no share."""
    P = len(sample)
    nothing = np.zeros(P, dtype=int)
    near = Near(np.array(sample), np.array(distance), np.zeros((P, 6)), nothing, nothing, np.zeros(P))
    samples = Samples(np.arange(4), np.zeros(4), np.zeros(4, dtype=int))
    return _Found(samples, {}, near, np.array(touching or P * [False]), np.zeros(4))


def test_shares_of_all_robots_add_up_to_one_where_something_is_about_to_collide() -> None:
    alone = found([0, 0, 1, 2], [-0.002, 0.001, 0.05, -0.01], [False, False, False, True])
    pair = found([0, 1], [-0.004, 0.04])
    contention = alone.contention(4) + pair.contention(4)
    mine, theirs = alone.shares(contention), pair.shares(contention)
    assert mine[:2].sum() + theirs[0] == pytest.approx(1.0)
    assert theirs[0] > mine[0] > mine[1] > 0, "the deeper, the more"
    assert mine[2] == theirs[1] == 0, "what is far away has none"
    assert mine[3] == 0, "what may touch needs none"


def test_what_collides_alone_has_all_of_it() -> None:
    one = found([3, 3], [-0.005, _CONTENDS])
    assert one.shares(one.contention(4)).tolist() == [1.0, 0.0]


def test_samples_of_some_robots_only_are_shared_among_these() -> None:
    """Beyond the samples that are the same for all robots there are those that were demanded for two of them."""
    one = found([0, 3, 3], [-0.001, -0.001, -0.001])
    shares = one.shares(one.contention(2) + np.array([0.004, 0.0]))
    assert shares.tolist() == pytest.approx([0.5, 0.5, 0.5])
