"""Many flights, summarised in a few metrics."""

from functools import partial

import numpy as np

from sb3_quad.base.types import FloatArray
from sb3_quad.base.validate import Frozen
from sb3_quad.evaluation.flights import Flights
from sb3_quad.evaluation.following import FOLLOWED
from sb3_quad.evaluation.hover import HOVERED
from sb3_quad.evaluation.statistics import Estimate, bootstrap, mean, share


class Moment(Frozen):
    """An event that a flight reaches at some time, or never."""

    share: Estimate
    """share of the flights that reach it"""
    time: Estimate | None
    """mean time until then of those flights, s; None: no flight reaches it"""


class Arrival(Moment):
    """Arrival within one tolerance: when a flight is first within it, and when it stays there."""

    tolerance: float
    """m"""
    settling: Moment
    """settling time: flights that end within the tolerance, and the time from which they stay in it
    """
    overshoot_rate: Estimate | None
    """share of the flights that arrived and then left the tolerance again, or were lost"""


class Course(Frozen):
    """A course of waypoints."""

    reached: Estimate
    """mean number of waypoints reached"""
    completed: Estimate
    """share of the flights that reached all"""
    time: Estimate | None
    """mean time until the last waypoint of those flights, s"""


class Metrics(Frozen):
    """The metrics of one controller in one scenario; path and errors are means over survivors."""

    n: int
    """flights"""
    success: Estimate
    """share that survived and ended at the target"""
    survival: Estimate
    """share that neither touched the ground nor left the range"""
    collisions: int
    """flights that touched the ground"""
    out_of_range: int
    """flights that left the range"""
    reward: Estimate
    """mean sum of rewards (Eqs. 4.5-4.9)"""
    flown: Estimate
    """mean time flown until the loss or the end, s"""
    arrivals: list[Arrival]
    """by tolerance, the tightest first"""
    path: Estimate | None
    """mean length of the path over the whole episode, m"""
    final_error: Estimate | None
    """mean |r - r_T| at the end, m"""
    final_error_median: Estimate | None
    """m"""
    final_error_95: Estimate | None
    """95 % quantile of the final error, m"""
    recovery_time: Moment
    """flights that became stable again, and when"""
    cross_track_error: Estimate | None
    """mean largest distance from the straight line to the target, m; None: there is no line"""
    hover_body_rates: Estimate | None
    """mean root mean square of the body rates in hover, rad/s; this and the next two are over the
    flights that hover at their targets, from 2 s after they came within 0.1 m; None: none does
    """
    hover_tilt: Estimate | None
    """mean root mean square of the tilt in hover, degrees"""
    hover_command_change: Estimate | None
    """mean root mean square of the change of commands, which reach from -1 to 1, in hover, 1/s"""
    rms_error: Estimate | None
    """mean root mean square of |r - r_T| after the first 2 s, m; like the next four, only for
    targets that move or turn
    """
    greatest_error: Estimate | None
    """mean largest |r - r_T| after the first 2 s, m"""
    path_error: Estimate | None
    """mean root mean square of the part of r - r_T across the target's velocity, m"""
    lag: Estimate | None
    """mean delay along the path, s"""
    heading_error: Estimate | None
    """mean root mean square of the heading error, degrees; None: no heading is commanded"""
    course: Course | None
    """only for scenarios with waypoints"""


def summarise(flights: Flights) -> Metrics:
    """Return the metrics of some flights, at least one."""
    survived = flights.survival
    error = flights.final_error[survived]
    course = None
    if flights.waypoint_times.shape[1] > 0:
        reached = np.isfinite(flights.waypoint_times)
        course = Course(
            reached=bootstrap(reached.sum(axis=1, dtype=np.float64)),
            completed=share(reached.all(axis=1)),
            time=mean(flights.waypoint_times[:, -1]),
        )
    return Metrics(
        n=flights.n,
        success=share(flights.success),
        survival=share(survived),
        collisions=int(flights.collision.sum()),
        out_of_range=int((~survived & ~flights.collision).sum()),
        reward=bootstrap(flights.reward),
        flown=bootstrap(flights.flown),
        arrivals=[_arrival(flights, tolerance) for tolerance in sorted(flights.time_to)],
        path=mean(flights.path_length[survived]),
        final_error=mean(error),
        final_error_median=mean(error, np.median),
        final_error_95=mean(error, partial(np.quantile, q=0.95)),
        recovery_time=_moment(flights.recovery_time),
        cross_track_error=mean(flights.cross_track_error[survived]),
        **{name: mean(getattr(flights, name)) for name in (*HOVERED, *FOLLOWED)},
        course=course,
    )


def _arrival(flights: Flights, tolerance: float) -> Arrival:
    times = flights.time_to[tolerance]
    settled = flights.settling_time[tolerance]
    arrived = np.isfinite(times)
    return Arrival(
        tolerance=tolerance,
        settling=_moment(settled),
        overshoot_rate=share((settled != times)[arrived]) if arrived.any() else None,
        **dict(_moment(times)),
    )


def _moment(times: FloatArray) -> Moment:
    return Moment(share=share(np.isfinite(times)), time=mean(times))
