"""Shares, means and quantiles with their 95 % intervals: Wilson's for shares, the percentile
bootstrap for the others.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import Field

from sb3_quad.base.arrays import FloatArray
from sb3_quad.base.validate import Frozen

Z = 1.959963984540054  # 97.5 % of the normal distribution lie below
RESAMPLES = 1000


class Estimate(Frozen):
    """A statistic of a sample with its 95 % interval."""

    value: float
    low: float
    high: float
    n: int = Field(description="size of the sample")


def share(hits: npt.ArrayLike) -> Estimate:
    """The share of True with Wilson's score interval (Wilson, JASA 22, 1927).

    :param hits: bool, (n,), n at least 1.
    """
    array = np.asarray(hits, dtype=np.bool_)
    n = array.size
    p = float(array.mean())
    centre, half = p + Z * Z / (2 * n), Z * math.sqrt(p * (1 - p) / n + Z * Z / (4 * n * n))
    scale = 1 + Z * Z / n
    return Estimate(
        value=p, low=min(p, (centre - half) / scale), high=max(p, (centre + half) / scale), n=n
    )


def mean(values: npt.ArrayLike) -> Estimate | None:
    """The mean of the finite values with its bootstrap interval; None if there are none."""
    array = np.asarray(values, dtype=np.float64)
    finite = array[np.isfinite(array)]
    return bootstrap(finite) if finite.size else None


def bootstrap(values: FloatArray, statistic: Callable[..., Any] = np.mean) -> Estimate:
    """A statistic with the percentile bootstrap's interval (Efron, 1979).

    The same values give the same interval: the resamples are those of a fixed seed.

    :param values: finite, (n,), n at least 1.
    :param statistic: a function of an array (..., n) and ``axis``.
    """
    n, middle = values.size, float(statistic(values, axis=-1))
    rows = np.random.default_rng(0).integers(0, n, (RESAMPLES, n))
    low, high = np.percentile(statistic(values[rows], axis=-1), [2.5, 97.5])
    return Estimate(value=middle, low=min(middle, float(low)), high=max(middle, float(high)), n=n)
