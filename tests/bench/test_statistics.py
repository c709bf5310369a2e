"""Statistics: agreement with closed forms, and intervals that cover the truth as often as they say."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from mrtamp.bench.statistics import expanded_tail, geometric_mean_ratio, median_band, summarise


def test_mean_and_deviation() -> None:
    found = summarise([1.0, 2.0, 6.0])
    assert found is not None and (found.mean, found.n) == (3.0, 3)
    assert found.deviation == pytest.approx(math.sqrt((4 + 1 + 9) / 2))
    alone = summarise([5.0])
    assert alone is not None and alone.deviation is None
    assert summarise([]) is None


def test_geometric_mean_and_its_interval_have_the_closed_form_for_many_pairs() -> None:
    """The bootstrap deviation of a mean is s sqrt((n - 1) / n) / sqrt(n), and with the expansion the t interval."""
    rng = np.random.default_rng(1)
    logs = rng.normal(-0.7, 0.5, size=60)
    found = geometric_mean_ratio([np.exp(logs).tolist()], np.random.default_rng(2), resamples=40_000)
    assert found is not None
    half = stats.t.ppf(0.975, 59) * logs.std(ddof=1) / math.sqrt(60)
    assert found.value == pytest.approx(math.exp(logs.mean()))
    assert math.log(found.low) == pytest.approx(logs.mean() - half, abs=0.08 * half)
    assert math.log(found.high) == pytest.approx(logs.mean() + half, abs=0.08 * half)


@pytest.mark.parametrize(("n", "least"), [(5, 0.90), (20, 0.92)])
def test_intervals_cover_the_true_ratio_as_often_as_they_say(n: int, least: float) -> None:
    rng = np.random.default_rng(3)
    truth, covered, trials = 0.4, 0, 400
    for _ in range(trials):
        ratios = truth * np.exp(rng.normal(0, 0.6, size=n))
        found = geometric_mean_ratio([ratios.tolist()], rng, resamples=2000)
        assert found is not None
        covered += found.low <= truth <= found.high
    assert least <= covered / trials <= 0.985


def test_runs_of_the_same_instance_are_not_taken_for_independent_ones() -> None:
    """Instances differ much, runs on one of them hardly: only intervals that resample instances cover the truth."""
    rng = np.random.default_rng(4)
    truth, trials = 2.0, 200
    covered = {"instances": 0, "runs": 0}
    for _ in range(trials):
        instances = [truth * np.exp(rng.normal(0, 0.5) + rng.normal(0, 0.05, size=8)) for _ in range(8)]
        together = [[float(x) for group in instances for x in group]]
        for name, groups in (("instances", [g.tolist() for g in instances]), ("runs", together)):
            found = geometric_mean_ratio(groups, rng, resamples=1000)
            assert found is not None
            covered[name] += found.low <= truth <= found.high
    assert covered["instances"] >= 0.9 * trials > 0.75 * trials >= covered["runs"]


def test_ratios_within_instances_are_not_counted_twice() -> None:
    """Instances that are all alike: their means vary as ratios within them do, and intervals are no wider than that."""
    rng = np.random.default_rng(10)
    truth, covered, trials = 2.0, 0, 400
    for _ in range(trials):
        instances = [(truth * np.exp(rng.normal(0, 0.5, size=5))).tolist() for _ in range(10)]
        found = geometric_mean_ratio(instances, rng, resamples=1000)
        assert found is not None
        covered += found.low <= truth <= found.high
    assert 0.91 <= covered / trials <= 0.985


def test_a_ratio_and_its_inverse_have_inverse_intervals() -> None:
    ratios = [[0.5, 0.8, 1.2, 0.7, 0.9]]
    one = geometric_mean_ratio(ratios, np.random.default_rng(5), resamples=20_000)
    two = geometric_mean_ratio([[1 / x for x in ratios[0]]], np.random.default_rng(6), resamples=20_000)
    assert one is not None and two is not None
    assert one.value * two.value == pytest.approx(1)
    assert one.low * two.high == pytest.approx(1, abs=0.03) and one.high * two.low == pytest.approx(1, abs=0.03)


def test_nothing_is_claimed_of_a_single_pair_or_none() -> None:
    alone = geometric_mean_ratio([[2.0]], np.random.default_rng(0))
    assert alone is not None and (alone.value, alone.low, alone.high) == (pytest.approx(2.0), 0.0, math.inf)
    assert geometric_mean_ratio([[], []], np.random.default_rng(0)) is None


def test_percentiles_move_out_for_few_and_become_the_usual_ones_for_many() -> None:
    tails = [expanded_tail(n) for n in (3, 5, 20, 100_000)]
    assert tails == sorted(tails) and tails[0] < 1e-6 and tails[-1] == pytest.approx(0.025, abs=1e-4)


def test_band_of_a_median_has_the_closed_form() -> None:
    """A resampled median of five is the k-th value or less with the chance that a binomial count is three or more."""
    values = np.array([[1.0], [2.0], [4.0], [8.0], [16.0]])
    band = median_band(values, np.random.default_rng(7))
    at_most = [stats.binom.sf(2, 5, k / 5) for k in range(1, 6)]
    low = values[next(k for k, p in enumerate(at_most) if p >= 0.025), 0]
    high = values[next(k for k, p in enumerate(at_most) if p >= 0.975), 0]
    assert (band.low[0], band.median[0], band.high[0]) == (low, 4.0, high) == (1.0, 4.0, 16.0)


def test_runs_without_a_plan_keep_the_band_open() -> None:
    values = np.array([[1.0], [2.0], [3.0], [np.inf], [np.inf]])
    band = median_band(values, np.random.default_rng(8))
    assert band.median[0] == 3.0 and band.high[0] == np.inf and np.isfinite(band.low[0])
    none = median_band(np.full((4, 2), np.inf), np.random.default_rng(9))
    assert np.isinf(none.median).all() and np.isinf(none.low).all()
