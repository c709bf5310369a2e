"""Tolerated penetration: all that is about to collide at one instant has a share in it, and no more than all of it."""

from __future__ import annotations

import numpy as np
import pytest

from mrtamp.optimise.collisions import _CONTENDS, _contention, _Found
from mrtamp.optimise.nearness import Near, Samples


def found(
    sample: list[int], distance: list[float], touching: list[bool] | None = None, t: float | None = None
) -> _Found:
    """Pairs of solids at samples of which there are four, or five, the last one at t in the first step."""
    P, n = len(sample), 4 + (t is not None)
    nothing = np.zeros(P, dtype=int)
    near = Near(np.array(sample), np.array(distance), np.zeros((P, 6)), nothing, nothing)
    samples = Samples(np.arange(n) % 4, np.array([0.0, 0.0, 0.0, 0.0, t or 0.0])[:n], np.zeros(n, dtype=int))
    return _Found(samples, {}, near, np.array(touching or P * [False]), np.zeros(n))


def shares(*all_of_them: _Found) -> list[np.ndarray]:
    claimed = _contention(all_of_them, 4)
    return [x.shares(c) for x, c in zip(all_of_them, claimed, strict=True)]


def test_shares_of_all_robots_add_up_to_one_where_something_is_about_to_collide() -> None:
    alone = found([0, 0, 1, 2], [-0.002, 0.001, 0.05, -0.01], [False, False, False, True])
    pair = found([0, 1], [-0.004, 0.002])
    mine, theirs = shares(alone, pair)
    assert mine[:2].sum() + theirs[0] == pytest.approx(1.0)
    assert theirs[0] > mine[0] > mine[1] > 0, "the deeper, the more"
    assert mine[2] < 1e-6 and theirs[1] > 1 - 1e-6, "what is far away has none while something is close"
    assert mine[3] == 0, "what may touch needs none"


def test_what_collides_alone_has_all_of_it_and_so_has_the_closest() -> None:
    [own] = shares(found([3, 3], [-0.005, 2 * _CONTENDS]))
    assert own.tolist() == pytest.approx([1.0, 0.0], abs=1e-4)
    [own] = shares(found([1, 1], [2 * _CONTENDS, 12 * _CONTENDS]))
    assert own.tolist() == pytest.approx([1.0, 0.0], abs=1e-4)


def test_samples_of_some_robots_only_are_shared_among_these() -> None:
    """Beyond the samples that are the same for all robots there are those that were demanded for some of them."""
    one, two, three = (found([0, 4], [-0.001, -0.001], t=t) for t in (0.25, 0.25, 0.75))
    assert [x.tolist() for x in shares(one, two, three)] == [
        pytest.approx([1 / 3, 1 / 2]),
        pytest.approx([1 / 3, 1 / 2]),
        pytest.approx([1 / 3, 1.0]),
    ]
