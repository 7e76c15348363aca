"""Shares, means and quantiles with their 95 % intervals: Wilson's for shares, the percentile
bootstrap for the others.
"""

import math
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from sb3_quad.base.types import FloatArray
from sb3_quad.base.validate import Frozen

Z = 1.959963984540054  # the 97.5 % quantile of the normal distribution
RESAMPLES = 1000
Statistic = Callable[..., Any]
BLOCK = 2**21  # values of a bootstrap in memory at once, 16 MiB


class Estimate(Frozen):
    """A statistic of a sample with its 95 % interval."""

    value: float
    low: float
    high: float
    n: int
    """size of the sample"""


def share(hits: npt.ArrayLike) -> Estimate:
    """Estimate the share of True with Wilson's score interval (Wilson, JASA 22, 1927).

    :param hits: bool, (n,), n at least 1.
    """
    array = np.asarray(hits, bool)
    n = array.size
    p = float(array.mean())
    scale = 1 + Z * Z / n
    centre = p + Z * Z / (2 * n)
    half = Z * math.sqrt(p * (1 - p) / n + Z * Z / (4 * n * n))
    return Estimate(
        value=p, low=min(p, (centre - half) / scale), high=max(p, (centre + half) / scale), n=n
    )


def mean(values: FloatArray, statistic: Statistic = np.mean) -> Estimate | None:
    """Return the :func:`bootstrap` of the finite values; None if there are none."""
    finite = values[np.isfinite(values)]
    return bootstrap(finite, statistic) if finite.size else None


def bootstrap(values: FloatArray, statistic: Statistic = np.mean) -> Estimate:
    """Estimate a statistic with the percentile bootstrap's interval (Efron, 1979).

    The same values yield the same interval, since the seed of the resamples is fixed.

    :param values: finite, (n,), n at least 1.
    :param statistic: a function of an array (..., n) and ``axis``.
    """
    n = values.size
    value = float(statistic(values, axis=-1))
    random = np.random.default_rng(0)
    resampled = np.empty(RESAMPLES)
    # A million values would make arrays of 7.5 GiB: take as many resamples at once as fit into a
    # block. The generator draws the same numbers however they are split.
    rows = max(1, BLOCK // n)
    for first in range(0, RESAMPLES, rows):
        part = resampled[first : first + rows]
        part[:] = statistic(random.choice(values, (len(part), n)), axis=-1)
    low, high = np.percentile(resampled, [2.5, 97.5]).tolist()
    return Estimate(value=value, low=min(value, low), high=max(value, high), n=n)


def over_seeds(values: FloatArray) -> Estimate | None:
    """Estimate the mean over seeds and episodes, with a bootstrap over both; for the difference of
    two configurations, this is a paired bootstrap.

    A resample draws as many seeds as there are, with replacement, and as many episodes; the
    episodes are the same in every run, so seeds and episodes are crossed (Owen, The pigeonhole
    bootstrap, Annals of Applied Statistics 1, 2007). Few seeds lead to intervals that are too
    narrow (Agarwal et al., Deep Reinforcement Learning at the Edge of the Statistical Precipice,
    NeurIPS 2021): with one seed they cover only the choice of episodes.

    :param values: values of a measure, (seeds, episodes), NaN without a number.
    :return: None if a run has no number at all, or if there is no run.
    """
    # Without a number from some run, there is no mean over seeds.
    if values.size == 0 or np.isnan(values).all(axis=1).any():
        return None
    # The same resamples each time, so that equal values yield equal intervals.
    random = np.random.default_rng(0)
    seeds, episodes = (random.integers(0, n, (RESAMPLES, n)) for n in values.shape)
    with warnings.catch_warnings():
        # A resample may miss the few episodes that have a number.
        warnings.simplefilter("ignore", RuntimeWarning)
        # (resamples, seeds)
        runs = np.stack([np.nanmean(row[episodes], axis=1) for row in values], axis=1)
        means = np.nanmean(np.take_along_axis(runs, seeds, axis=1), axis=1)
    # The interval includes the value, even if every resample misses it.
    value = float(np.nanmean(values, axis=1).mean())
    low, high = np.nanpercentile(means, [2.5, 97.5])
    return Estimate(value=value, low=min(value, low), high=max(value, high), n=values.size)
