"""Means, deviations and bootstrap intervals of what was measured."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

RESAMPLES = 10_000
CONFIDENCE = 0.95
_CURVE_RESAMPLES = 2000


@dataclass(frozen=True)
class Summary:
    """Mean and standard deviation (with n - 1; None for a single value) of n values."""

    mean: float
    deviation: float | None
    n: int


def summarise(values: Sequence[float]) -> Summary | None:
    """Mean and standard deviation; None where there is nothing."""
    if not values:
        return None
    deviation = float(np.std(values, ddof=1)) if len(values) > 1 else None
    return Summary(float(np.mean(values)), deviation, len(values))


@dataclass(frozen=True)
class Interval:
    """An estimate, and the bounds between which it lies with `CONFIDENCE`."""

    value: float
    low: float
    high: float


def geometric_mean_ratio(
    ratios: Sequence[Sequence[float]], rng: np.random.Generator, resamples: int = RESAMPLES
) -> Interval | None:
    """Geometric mean of ratios of paired measurements, with its bootstrap interval.

    Logarithms of ratios are resampled; the bounds are percentiles of the resampled means.  For n units that are
    resampled, percentiles are taken farther out, as the t distribution with n - 1 degrees of freedom and the n - 1 in
    the deviation demand: without that, intervals from a few units are too narrow (expanded percentile interval;
    Hesterberg, What Teachers Should Know About the Bootstrap, The American Statistician 69, 2015, section 5.3).

    Parameters
    ----------
    ratios : positive numbers, one list per instance of a problem.  With several instances, instances are resampled,
        each with all its ratios, since runs on the same instance have much in common; with one, its ratios are.  How
        much ratios within an instance vary is in how much instances do: resampling them too would count it twice
        (Davison and Hinkley, Bootstrap Methods and their Application, 1997, section 3.8).

    Returns
    -------
    None where there is no ratio; with a single unit to resample, bounds are 0 and infinity: nothing is known of them.
    """
    logs = [np.log(np.asarray(group, dtype=float)) for group in ratios if len(group)]
    if not logs:
        return None
    units = np.array([group.mean() for group in logs]) if len(logs) > 1 else logs[0]
    estimate, n = float(np.exp(units.mean())), len(units)
    if n == 1:
        return Interval(estimate, 0.0, math.inf)
    means = units[rng.integers(n, size=(resamples, n))].mean(axis=1)
    tail = expanded_tail(n)
    low, high = np.quantile(means, [tail, 1 - tail])
    return Interval(estimate, float(np.exp(low)), float(np.exp(high)))


def expanded_tail(n: int, confidence: float = CONFIDENCE) -> float:
    """The share of resampled means of n units to leave out on either side."""
    t = stats.t.ppf(0.5 + confidence / 2, n - 1)
    return float(stats.norm.cdf(-math.sqrt(n / (n - 1)) * t))


@dataclass(frozen=True, eq=False)
class Band:
    """Medians (T,) and the bounds (T,) of their interval; infinite where too many runs have no plan yet."""

    median: np.ndarray
    low: np.ndarray
    high: np.ndarray


def median_band(values: np.ndarray, rng: np.random.Generator, resamples: int = _CURVE_RESAMPLES) -> Band:
    """Medians of n runs at T moments and their bootstrap percentile interval.

    Parameters
    ----------
    values : (n, T), infinite where a run has no plan yet: these count, so that runs that fail make no median better.
    """
    n = len(values)
    drawn = rng.integers(n, size=(resamples, n))
    tail = (1 - CONFIDENCE) / 2
    low, high = np.empty(values.shape[1]), np.empty(values.shape[1])
    for k, column in enumerate(values.T):
        if k and np.array_equal(column, values[:, k - 1]):
            low[k], high[k] = low[k - 1], high[k - 1]
            continue
        medians = np.sort(np.median(column[drawn], axis=1))
        # The outer of two neighbours, since a mean with infinity would say nothing.
        low[k] = medians[math.floor(tail * (resamples - 1))]
        high[k] = medians[math.ceil((1 - tail) * (resamples - 1))]
    return Band(np.median(values, axis=0), low, high)
