"""Shares, means and quantiles with their 95 % intervals: Wilson's for shares, the percentile
bootstrap for the others.
"""

import math
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
