"""Means over seeds with 95 % intervals, and what can be said of two configurations: bootstraps over seeds and episodes.

A resample takes as many seeds as there are, with replacement, and as many episodes; the episodes are the same in every run,
so that seeds and episodes are crossed (Owen, The pigeonhole bootstrap, Annals of Applied Statistics 1, 2007). Of two
configurations it takes the same seeds and episodes (paired). Few seeds give intervals that are too narrow (Agarwal et al., Deep
Reinforcement Learning at the Edge of the Statistical Precipice, NeurIPS 2021): with one seed they tell of episodes alone.
"""

from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from sb3_quad.base.arrays import FloatArray, IntArray
from sb3_quad.sweep.records import ERROR, REWARD, SUCCESS, SURVIVAL

RESAMPLES = 1000
HIGHER_IS_BETTER = (SUCCESS, SURVIVAL, REWARD)  # and compared over all episodes
Verdict: TypeAlias = Literal["better", "worse", "cannot tell"]


class Interval(NamedTuple):
    """A number with the ends of its 95 % interval."""

    value: float
    low: float
    high: float


class Comparison(NamedTuple):
    """The first of two configurations against the second."""

    difference: Interval
    verdict: Verdict


def over_seeds(values: FloatArray, measure: str) -> Interval | None:
    """The mean over seeds of what a measure is in a run: a mean over its episodes, the median of final errors.

    :param values: of a measure, (seeds, episodes), NaN where there is none.
    :return: None if a run has no number at all.
    """
    if not np.isfinite(values).any(axis=1).all():
        return None
    seeds, episodes = _resamples(*values.shape)
    found = [_of_runs(values[np.ix_(rows, columns)], measure) for rows, columns in zip(seeds, episodes, strict=True)]
    return _interval(_of_runs(values, measure), np.array(found))


def compare(first: FloatArray, second: FloatArray) -> Comparison:
    """Whether the first configuration is better than the second, by a measure of which more is better.

    :param first: of the same seeds and episodes as ``second``, (seeds, episodes), without NaN.
    """
    difference = first - second
    seeds, episodes = _resamples(*difference.shape)
    found = [difference[np.ix_(rows, columns)].mean() for rows, columns in zip(seeds, episodes, strict=True)]
    interval = _interval(float(difference.mean()), np.array(found))
    verdict: Verdict = "better" if interval.low > 0 else "worse" if interval.high < 0 else "cannot tell"
    return Comparison(interval, verdict)


def _of_runs(values: FloatArray, measure: str) -> float:
    finite = np.isfinite(values)
    if not finite.all() and not finite.any(axis=1).all():  # a resample may miss the few episodes that have a number
        values = values[finite.any(axis=1)]
    if not len(values):
        return float("nan")
    each = np.nanmedian(values, axis=1) if measure == ERROR else np.nanmean(values, axis=1)
    return float(each.mean())


def _resamples(seeds: int, episodes: int) -> tuple[IntArray, IntArray]:
    """Rows and columns of every resample; the same for the same numbers."""
    random = np.random.default_rng(0)
    return random.integers(0, seeds, (RESAMPLES, seeds)), random.integers(0, episodes, (RESAMPLES, episodes))


def _interval(value: float, resampled: FloatArray) -> Interval:
    low, high = np.nanpercentile(resampled, [2.5, 97.5])
    return Interval(value, min(value, float(low)), max(value, float(high)))
