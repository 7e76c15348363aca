"""Many flights in a few metrics, with 95 % intervals: Wilson's for shares, the bootstrap for means."""

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from sb3_quad.base.arrays import FloatArray
from sb3_quad.evaluation.flights import Flights
from sb3_quad.evaluation.records import Arrival, Course, Estimate, Metrics, Moment

Z = 1.959963984540054  # 97.5 % of the normal distribution lie below
RESAMPLES = 1000


def summarise(flights: Flights) -> Metrics:
    """The metrics of some flights, at least one."""
    done = flights.survival
    error, offset = flights.final_error[done], flights.final_offset[done]
    some, reached = bool(done.any()), np.isfinite(flights.waypoint_times)
    course = None
    if reached.shape[1]:
        count, time = _bootstrap(reached.sum(axis=1, dtype=np.float64)), mean(flights.waypoint_times[:, -1])
        course = Course(reached=count, completed=share(reached.all(axis=1)), time=time)
    return Metrics(
        n=flights.n,
        success=share(flights.success),
        survival=share(done),
        collisions=int(flights.collision.sum()),
        out_of_range=int((~done & ~flights.collision).sum()),
        reward=_bootstrap(flights.reward),
        flown=_bootstrap(flights.flown),
        arrivals=[Arrival(tolerance=each, **_moment(times)) for each, times in sorted(flights.time_to.items())],
        path=mean(flights.path_length[done]),
        final_error=mean(error),
        final_error_median=float(np.median(error)) if some else None,
        final_error_95=_bootstrap(error, 0.95) if some else None,
        final_error_max=float(error.max()) if some else None,
        final_offset=tuple(offset.mean(axis=0).tolist()) if some else None,
        stabilised=Moment(**_moment(flights.stabilised)),
        sideways=mean(flights.sideways[done]),
        course=course,
    )


def _moment(times: FloatArray) -> dict[str, Any]:
    return {"share": share(np.isfinite(times)), "time": mean(times)}


def share(hits: npt.ArrayLike) -> Estimate:
    """The share of True with Wilson's score interval (Wilson, JASA 22, 1927).

    :param hits: bool, (n,), n at least 1.
    """
    array = np.asarray(hits, dtype=np.bool_)
    n = array.size
    p = float(array.mean())
    centre, half = p + Z * Z / (2 * n), Z * math.sqrt(p * (1 - p) / n + Z * Z / (4 * n * n))
    scale = 1 + Z * Z / n
    return Estimate(value=p, low=min(p, (centre - half) / scale), high=max(p, (centre + half) / scale), n=n)


def mean(values: npt.ArrayLike) -> Estimate | None:
    """The mean of the finite values with the percentile bootstrap's interval (Efron, 1979); None if there are none.

    The same values give the same interval: the resamples are those of a fixed seed.
    """
    array = np.asarray(values, dtype=np.float64)
    finite = array[np.isfinite(array)]
    return _bootstrap(finite) if finite.size else None


def _bootstrap(array: FloatArray, quantile: float | None = None) -> Estimate:
    """The mean, or a quantile."""

    def statistic(values: FloatArray) -> FloatArray:
        found: FloatArray = values.mean(axis=-1) if quantile is None else np.quantile(values, quantile, axis=-1)
        return found

    n, middle = array.size, float(statistic(array))
    rows = np.random.default_rng(0).integers(0, n, (RESAMPLES, n))
    low, high = np.percentile(statistic(array[rows]), [2.5, 97.5])
    return Estimate(value=middle, low=min(middle, float(low)), high=max(middle, float(high)), n=n)
