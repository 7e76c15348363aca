"""Many flights in a few metrics."""

from typing import Any

import numpy as np
from pydantic import Field

from sb3_quad.base.arrays import FloatArray
from sb3_quad.base.validate import Frozen
from sb3_quad.evaluation.flights import Flights
from sb3_quad.evaluation.scenarios.parts import Vector
from sb3_quad.evaluation.statistics import Estimate, bootstrap, mean, share


class Moment(Frozen):
    """Something that a flight comes to, or never does."""

    share: Estimate = Field(description="of the flights that came to it")
    time: Estimate | None = Field(
        description="mean time until then of those flights, s; None: no flight did"
    )


class Arrival(Moment):
    """Arrival within one tolerance: when it is first touched, and after which time it is not left
    again.
    """

    tolerance: float = Field(description="m")
    settling: Moment = Field(
        description="flights that end within it, and after which time they stay"
    )
    overshoot_rate: Estimate | None = Field(
        description="share that leaves it again, of the flights that came to it"
    )


class Course(Frozen):
    """A course of waypoints."""

    reached: Estimate = Field(description="mean number of waypoints reached")
    completed: Estimate = Field(description="share of the flights that reached all")
    time: Estimate | None = Field(
        description="mean time until the last waypoint of those flights, s"
    )


class Metrics(Frozen):
    """What one controller reached in one scenario; path and errors are of the flights that were not
    lost.
    """

    n: int = Field(description="flights")
    success: Estimate = Field(description="share that survived and ended at the target")
    survival: Estimate = Field(
        description="share that neither touched the ground nor left the range"
    )
    collisions: int = Field(description="flights that touched the ground")
    out_of_range: int = Field(description="flights that left the range")
    reward: Estimate = Field(description="mean sum of rewards (Eqs. 4.5-4.9)")
    flown: Estimate = Field(description="mean time flown, until lost or the end, s")
    arrivals: list[Arrival] = Field(description="by tolerance, the tightest first")
    overshoot: float | None = Field(description="median of the largest |r - r_T| since arrival, m")
    path: Estimate | None = Field(description="mean length of the path over the whole episode, m")
    final_error: Estimate | None = Field(description="mean |r - r_T| at the end, m")
    final_error_median: float | None = Field(description="m")
    final_error_95: Estimate | None = Field(description="its 95 % quantile, m")
    final_error_max: float | None = Field(description="m")
    final_offset: Vector | None = Field(description="mean r - r_T at the end, world frame, m")
    recovery_time: Moment = Field(description="which flights got stable again, and when")
    cross_track_error: Estimate | None = Field(
        description="mean largest distance from the straight way, m; None: there is none"
    )
    course: Course | None = Field(description="of scenarios with waypoints")


def summarise(flights: Flights) -> Metrics:
    """The metrics of some flights, at least one."""
    done = flights.survival
    error, offset = flights.final_error[done], flights.final_offset[done]
    some, reached = bool(done.any()), np.isfinite(flights.waypoint_times)
    course = None
    if reached.shape[1]:
        count, time = (
            bootstrap(reached.sum(axis=1, dtype=np.float64)),
            mean(flights.waypoint_times[:, -1]),
        )
        course = Course(reached=count, completed=share(reached.all(axis=1)), time=time)
    return Metrics(
        n=flights.n,
        success=share(flights.success),
        survival=share(done),
        collisions=int(flights.collision.sum()),
        out_of_range=int((~done & ~flights.collision).sum()),
        reward=bootstrap(flights.reward),
        flown=bootstrap(flights.flown),
        arrivals=[
            _arrival(each, times, flights.settling_time[each])
            for each, times in sorted(flights.time_to.items())
        ],
        overshoot=float(np.nanmedian(flights.overshoot))
        if np.isfinite(flights.overshoot).any()
        else None,
        path=mean(flights.path_length[done]),
        final_error=mean(error),
        final_error_median=float(np.median(error)) if some else None,
        final_error_95=bootstrap(error, lambda values, axis: np.quantile(values, 0.95, axis=axis))
        if some
        else None,
        final_error_max=float(error.max()) if some else None,
        final_offset=tuple(offset.mean(axis=0).tolist()) if some else None,
        recovery_time=Moment(**_moment(flights.recovery_time)),
        cross_track_error=mean(flights.cross_track_error[done]),
        course=course,
    )


def _arrival(tolerance: float, times: FloatArray, stays: FloatArray) -> Arrival:
    arrived = np.isfinite(times)
    overshoot_rate = share((stays != times)[arrived]) if arrived.any() else None
    return Arrival(
        tolerance=tolerance,
        settling=Moment(**_moment(stays)),
        overshoot_rate=overshoot_rate,
        **_moment(times),
    )


def _moment(times: FloatArray) -> dict[str, Any]:
    return {"share": share(np.isfinite(times)), "time": mean(times)}
