"""Means over seeds with 95 % intervals, and what can be said of two configurations: bootstraps over seeds and episodes.

A resample takes as many seeds as there are, with replacement, and as many episodes; the episodes are the same in every run,
so that seeds and episodes are crossed (Owen, The pigeonhole bootstrap, Annals of Applied Statistics 1, 2007). Few seeds give
intervals that are too narrow (Agarwal et al., Deep Reinforcement Learning at the Edge of the Statistical Precipice, NeurIPS
2021): with one they tell of episodes alone.
"""

import importlib.util
import warnings
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from sb3_quad.base.arrays import FloatArray
from sb3_quad.base.files import one_line
from sb3_quad.evaluation.statistics import Estimate

RESAMPLES = 1000
AGGREGATES = ("median", "iqm", "mean", "optimality_gap")


class Comparison(NamedTuple):
    """The first of two configurations against the second, by a measure of which more is better."""

    difference: Estimate

    @property
    def verdict(self) -> str:
        """Better or worse if the interval of the difference leaves out zero."""
        return "better" if self.difference.low > 0 else "worse" if self.difference.high < 0 else "cannot tell"


def over_seeds(values: FloatArray, statistic: Callable[..., FloatArray] = np.nanmean) -> Estimate | None:
    """The mean over seeds of a statistic of a run's episodes; of the difference of two configurations, a paired bootstrap.

    :param values: of a measure, (seeds, episodes), NaN where there is none.
    :return: None if a run has no number at all.
    """
    if not np.isfinite(values).any(axis=1).all():
        return None
    random = np.random.default_rng(0)
    seeds, episodes = (random.integers(0, n, (RESAMPLES, n)) for n in values.shape)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a resample may miss the few episodes that have a number
        runs = np.stack([statistic(row[episodes], axis=1) for row in values], axis=1)  # (resamples, seeds)
        means = np.nanmean(np.take_along_axis(runs, seeds, axis=1), axis=1)
    low, high = np.nanpercentile(means, [2.5, 97.5])
    value = float(statistic(values, axis=1).mean())
    return Estimate(value=value, low=min(value, float(low)), high=max(value, float(high)), n=values.size)


def aggregates(rates: Mapping[str, FloatArray]) -> dict[str, Any] | None:
    """rliable's aggregate metrics of success rates, with 95 % intervals by its stratified bootstrap over runs.

    :param rates: by configuration, (runs, scenarios).
    :return: None: rliable cannot be imported (extra ``[sweep]``), or there are no rates.
    """
    if not rates or importlib.util.find_spec("rliable") is None:
        return None
    try:
        from rliable import library, metrics
    except Exception as error:  # with another pandas than it knows, a TypeError
        why = one_line(error)
        warnings.warn(f"no aggregate metrics: rliable cannot be imported ({why}); pip install 'pandas<3'", stacklevel=2)
        return None

    def measured(scores: Any) -> Any:
        return np.array([getattr(metrics, f"aggregate_{name}")(scores) for name in AGGREGATES])

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # what rliable calls will once want another generator
        random = np.random.RandomState(0)
        found, ends = library.get_interval_estimates(dict(rates), measured, reps=RESAMPLES, random_state=random)
    numbers = {name: np.vstack([found[name], ends[name]]).T.tolist() for name in rates}  # by aggregate: value, low, high
    words = ("value", "low", "high")
    return {
        name: {each: dict(zip(words, three, strict=True)) for each, three in zip(AGGREGATES, rows, strict=True)}
        for name, rows in numbers.items()
    }
