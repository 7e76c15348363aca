"""Means over seeds with 95 % intervals, and what can be said of two configurations: bootstraps over seeds and episodes.

A resample takes as many seeds as there are, with replacement, and as many episodes; the episodes are the same in every run,
so that seeds and episodes are crossed (Owen, The pigeonhole bootstrap, Annals of Applied Statistics 1, 2007). Of two
configurations it takes the same seeds and episodes (paired). Few seeds give intervals that are too narrow (Agarwal et al.,
Deep Reinforcement Learning at the Edge of the Statistical Precipice, NeurIPS 2021): with one they tell of episodes alone.
"""

from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from sb3_quad.base.arrays import FloatArray
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
    known = np.isfinite(values)
    if not known.any(axis=1).all():
        return None
    seeds, episodes = _counts(*values.shape)
    if measure == ERROR:
        value = float(np.nanmedian(values, axis=1).mean())
        runs = np.array([[_median(row, count) for row in values] for count in episodes])
    else:
        filled = np.where(known, values, 0.0)
        value = float((filled.sum(axis=1) / known.sum(axis=1)).mean())
        with np.errstate(invalid="ignore"):  # a resample may miss the few episodes that have a number
            runs = (episodes @ filled.T) / (episodes @ known.T)
    weights = np.where(np.isfinite(runs), seeds, 0.0)
    with np.errstate(invalid="ignore"):
        return _interval(value, (weights * np.nan_to_num(runs)).sum(axis=1) / weights.sum(axis=1))


def compare(first: FloatArray, second: FloatArray) -> Comparison:
    """Whether the first configuration is better than the second, by a measure of which more is better.

    :param first: of the same seeds and episodes as ``second``, (seeds, episodes), without NaN.
    """
    difference = first - second
    seeds, episodes = _counts(*difference.shape)
    found = np.einsum("rs,se,re->r", seeds, difference, episodes, optimize=True) / difference.size
    interval = _interval(float(difference.mean()), found)
    verdict: Verdict = "better" if interval.low > 0 else "worse" if interval.high < 0 else "cannot tell"
    return Comparison(interval, verdict)


def _median(values: FloatArray, counts: FloatArray) -> float:
    """The median of the finite values, each as often as it counts; NaN if none does."""
    found = np.repeat(values, counts.astype(np.int64))
    found = found[np.isfinite(found)]
    return float(np.median(found)) if found.size else float("nan")


def _counts(seeds: int, episodes: int) -> tuple[FloatArray, FloatArray]:
    """How often each resample has each seed and each episode, (RESAMPLES, n) each; the same for the same numbers."""
    random = np.random.default_rng(0)
    rows, columns = (random.multinomial(n, np.full(n, 1 / n), RESAMPLES).astype(np.float64) for n in (seeds, episodes))
    return rows, columns


def _interval(value: float, resampled: FloatArray) -> Interval:
    low, high = np.nanpercentile(resampled, [2.5, 97.5])
    return Interval(value, min(value, float(low)), max(value, float(high)))
