"""Means over seeds with 95 % intervals, and what can be said of two configurations: bootstraps over seeds and episodes.

A resample takes as many seeds as there are, with replacement, and as many episodes; the episodes are the same in every run,
so that seeds and episodes are crossed (Owen, The pigeonhole bootstrap, Annals of Applied Statistics 1, 2007). Few seeds give
intervals that are too narrow (Agarwal et al., Deep Reinforcement Learning at the Edge of the Statistical Precipice, NeurIPS
2021): with one they tell of episodes alone.
"""

import importlib.util
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from sb3_quad.base.arrays import FloatArray
from sb3_quad.evaluation.statistics import Estimate

RESAMPLES = 1000
AGGREGATES = ("median", "iqm", "mean", "optimality_gap")


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
    :return: None: rliable is not installed (extra ``[sweep]``), or there are no rates.
    """
    if not rates or importlib.util.find_spec("rliable") is None:
        return None
    from rliable import library, metrics

    def measured(scores: Any) -> Any:
        return np.array([getattr(metrics, f"aggregate_{name}")(scores) for name in AGGREGATES])

    random = np.random.RandomState(0)
    found, ends = library.get_interval_estimates(dict(rates), measured, reps=RESAMPLES, random_state=random)
    return {
        name: {
            each: {"value": value, "low": low, "high": high}
            for each, value, low, high in zip(AGGREGATES, found[name].tolist(), *ends[name].tolist(), strict=True)
        }
        for name in rates
    }
