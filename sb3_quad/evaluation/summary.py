"""The figures of many flights in a few numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from sb3_quad.evaluation.flights import Flights, fly


@dataclass(frozen=True)
class Summary:
    """Means over flights.

    :param success_rate: 0 to 1.
    :param mean_reward: per episode.
    :param time_to: for each tolerance in m: the mean over the flights that reached it in s (NaN if none), and their share.
    :param mean_path: m; like the errors, of the successful flights, NaN if there are none.
    """

    n: int
    success_rate: float
    mean_reward: float
    time_to: Mapping[float, tuple[float, float]]
    mean_path: float
    median_final_error: float
    max_final_error: float


def summarise(flights: Flights) -> Summary:
    """The summary of some flights."""
    done = flights.success
    path, error = flights.path_length[done], flights.final_error[done]
    some = bool(done.any())
    return Summary(
        n=flights.n,
        success_rate=float(done.mean()),
        mean_reward=float(flights.reward.mean()),
        time_to={tolerance: _time(times) for tolerance, times in flights.time_to.items()},
        mean_path=float(path.mean()) if some else float("nan"),
        median_final_error=float(np.median(error)) if some else float("nan"),
        max_final_error=float(error.max()) if some else float("nan"),
    )


def fly_all(pilots: Mapping[str, Any], task: Any, n_episodes: int, seed: int, **keywords: Any) -> dict[str, Summary]:
    """The figures of several controllers on the same episodes, by name.

    :param keywords: further arguments of :func:`~sb3_quad.evaluation.flights.fly`, such as ``vehicle``.
    """
    return {name: summarise(fly(pilot, task, n_episodes, seed, **keywords)) for name, pilot in pilots.items()}


def _time(times: np.ndarray[tuple[int], np.dtype[np.float64]]) -> tuple[float, float]:
    reached = np.isfinite(times)
    return (float(times[reached].mean()) if reached.any() else float("nan")), float(reached.mean())
