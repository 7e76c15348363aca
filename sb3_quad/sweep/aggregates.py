"""The aggregate metrics of rliable, where it is installed (extra ``[sweep]``): over seeds and scenarios of a configuration.

Agarwal et al., Deep Reinforcement Learning at the Edge of the Statistical Precipice, NeurIPS 2021.
"""

import importlib.util
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sb3_quad.base.files import one_line
from sb3_quad.sweep.records import SUCCESS, RunRecord

REPETITIONS = 2000
NAMES = ("aggregate_median", "aggregate_iqm", "aggregate_mean", "aggregate_optimality_gap")


def aggregates(groups: Mapping[str, Sequence[RunRecord]]) -> dict[str, Any] | None:
    """Median, interquartile mean, mean and optimality gap of the success rates, with 95 % intervals, by configuration.

    The intervals are rliable's stratified bootstrap over runs. None: rliable cannot be imported, or nothing has success
    rates.
    """
    scores = {name: _scores(group) for name, group in groups.items()}
    scores = {name: score for name, score in scores.items() if score is not None}
    if not scores or importlib.util.find_spec("rliable") is None:
        return None
    try:
        from rliable import library, metrics
    except Exception as error:  # with another pandas than it knows, a TypeError
        why = one_line(error)
        warnings.warn(f"no aggregate metrics: rliable cannot be imported ({why}); pip install 'pandas<3'", stacklevel=2)
        return None

    def measured(values: Any) -> Any:
        return np.array([getattr(metrics, name)(values) for name in NAMES])

    state = np.random.RandomState(0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # what rliable calls will once want another generator
        found, intervals = library.get_interval_estimates(scores, measured, reps=REPETITIONS, random_state=state)
    words = [name.removeprefix("aggregate_") for name in NAMES]
    return {
        name: {
            word: {"value": float(value), "low": float(low), "high": float(high)}
            for word, value, low, high in zip(words, found[name], *intervals[name], strict=True)
        }
        for name in scores
    }


def _scores(group: Sequence[RunRecord]) -> Any:
    """Success rates, (runs, scenarios)."""
    rows = [[measures.get(SUCCESS) for measures in record.flights.values()] for record in group]
    if not rows or any(values is None for row in rows for values in row) or len({len(row) for row in rows}) != 1:
        return None
    return np.array([[np.mean([value or 0.0 for value in values or ()]) for values in row] for row in rows])
