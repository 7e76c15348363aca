"""Hooks, which are called during flights: those that measure every flight, and the base of your
own.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from sb3_quad.base.types import BoolArray, Float32Array, FloatArray, IntArray
from sb3_quad.envs.simulation.state import QuadcopterState
from sb3_quad.envs.vehicles.vehicle import Vehicle

NEAR = 0.1  # m; settling is judged by it, or by the tightest tolerance if it is not among them
# A vehicle is stable while its tilt (rad) and its rate of roll and pitch together (rad/s) are below
# these for at least HOLD (s).
TILT = np.radians(45.0)
RATE = 2.0
HOLD = 0.2


class Hook:
    """Called during n flights; a subclass overrides the methods that it needs."""

    def on_start(self, state: QuadcopterState, vehicle: Vehicle) -> None:
        """See the state in which the flights start."""

    def after_step(
        self, step: int, state: QuadcopterState, actions: Float32Array, flying: BoolArray
    ) -> None:
        """See the state after control step ``step``.

        :param actions: (n, 4), that led to this state.
        :param flying: (n,), the flights that continue.
        """

    def results(self) -> Mapping[str, Any]:
        """Return what was measured, by name: arrays with a row for each flight."""
        return {}


class Course(Hook):
    """Which of W waypoints each flight has reached, and when: ``waypoint_times``.

    ``on_last`` (n,) says whether the present target is the last one; always without waypoints.

    :param waypoints: (W, 3), world frame, m.
    :param radius: a waypoint counts as reached within this, m.
    """

    def __init__(self, waypoints: FloatArray, radius: float) -> None:
        self._waypoints = waypoints
        self._radius = radius

    def on_start(self, state: QuadcopterState, vehicle: Vehicle) -> None:
        self._control_step = vehicle.control_step
        self._count = len(self._waypoints)
        self._next = np.zeros(state.n, dtype=np.int64)
        self._onward = np.zeros(0, dtype=np.int64)
        self._times = np.full((state.n, self._count), np.nan)
        self.on_last = self._next >= self._count - 1

    def after_step(
        self, step: int, state: QuadcopterState, actions: Float32Array, flying: BoolArray
    ) -> None:
        if self._count == 0:
            return
        # This step was still flown to the target before.
        self.on_last = self._next >= self._count - 1
        near = flying & (state.distance <= self._radius)
        reached = np.flatnonzero(near & (self._next < self._count))
        self._times[reached, self._next[reached]] = step * self._control_step
        self._next[reached] += 1
        self._onward = reached[self._next[reached] < self._count]

    def next_targets(self) -> tuple[IntArray, FloatArray]:
        """Return the rows that get their next target, (k,), and these targets, (k, 3), m."""
        return self._onward, self._waypoints[self._next[self._onward]]

    def results(self) -> Mapping[str, Any]:
        return {"waypoint_times": self._times}


class Arrivals(Hook):
    """When flights come within T tolerances of their targets; on a course, of the last waypoint.

    ``time_to``: time until |r - r_T| is first within a tolerance, s. ``settling_time``: time since
    when it has stayed within it, s; NaN if the flight is lost. Both are NaN if it never was.

    :param tolerances: m.
    :param course: sees each step before this hook does.
    """

    def __init__(self, tolerances: Sequence[float], course: Course) -> None:
        self._tolerances = tolerances
        self._limits = np.array(tolerances)[:, None]
        self._course = course

    def on_start(self, state: QuadcopterState, vehicle: Vehicle) -> None:
        self._control_step = vehicle.control_step
        self._flying = np.ones(state.n, bool)
        self._distance = state.distance
        self._time_to = np.full((len(self._tolerances), state.n), np.nan)
        self._settling_time = self._time_to.copy()
        self._update(0.0)

    def after_step(
        self, step: int, state: QuadcopterState, actions: Float32Array, flying: BoolArray
    ) -> None:
        # A step that ends a flight still counts; the distance of a lost one no longer changes.
        self._distance = np.where(self._flying, state.distance, self._distance)
        self._flying = flying
        self._update(step * self._control_step)

    def _update(self, time: float) -> None:
        distance = np.where(self._course.on_last, self._distance, np.inf)
        inside = distance <= self._limits
        np.fmin(self._time_to, np.where(inside, time, np.nan), out=self._time_to)
        self._settling_time = _since(self._settling_time, inside, time)

    def results(self) -> Mapping[str, Any]:
        # A lost flight has no time after which it stays at its target.
        settling_time = np.where(self._flying, self._settling_time, np.nan)
        return {
            "time_to": dict(zip(self._tolerances, self._time_to, strict=True)),
            "settling_time": dict(zip(self._tolerances, settling_time, strict=True)),
        }


def arrival_tolerance(tolerances: Iterable[float]) -> float:
    """Return the tolerance, m, by which settling is judged."""
    return min(tolerances, key=lambda tolerance: (tolerance != NEAR, tolerance))


def _since(times: FloatArray, holds: BoolArray, time: float) -> FloatArray:
    """Return the time since when a condition has held, given whether it ``holds`` now; otherwise
    NaN.
    """
    return np.where(holds, np.fmin(times, time), np.nan)


class Motion(Hook):
    """How flights move: the length of their paths, when they become stable, and how far they
    deviate from the straight line.

    ``path_length``: m, over the whole flight. ``recovery_time``: the beginning of the first 0.2 s
    in which the tilt stays below 45° and the body rate of roll and pitch together below 2 rad/s, s;
    NaN if there is none. The thesis reads such a time from Fig. 4.9. ``cross_track_error``: the
    largest distance from the straight line through start and target, m, on the way and beyond: the
    oscillations of 4.3.1; NaN if both are the same point.
    """

    def on_start(self, state: QuadcopterState, vehicle: Vehicle) -> None:
        way = state.target - state.position
        length = np.linalg.norm(way, axis=1, keepdims=True)
        self._control_step = vehicle.control_step
        self._flying = np.ones(state.n, bool)
        self._start = state.position.copy()
        self._position = self._start
        self._direction = np.divide(way, length, out=np.zeros_like(way), where=length > 0.0)
        self._path_length = np.zeros(state.n)
        self._stable_since = np.zeros(state.n)  # NaN while it is not stable
        self._recovery_time = np.full(state.n, np.nan)
        self._cross_track_error = np.where(length[:, 0] > 0.0, 0.0, np.nan)
        self._update(0.0, state, self._flying)

    def after_step(
        self, step: int, state: QuadcopterState, actions: Float32Array, flying: BoolArray
    ) -> None:
        # The path includes the step that ends a flight.
        way = np.linalg.norm(state.position - self._position, axis=1)
        self._path_length += np.where(self._flying, way, 0.0)
        self._position = state.position.copy()
        self._flying = flying
        self._update(step * self._control_step, state, flying)

    def _update(self, time: float, state: QuadcopterState, flying: BoolArray) -> None:
        # The cosine of the tilt is the z-z element of the rotation matrix.
        x, y = state.quaternion.T[1:3]
        upright = 1.0 - 2.0 * (x * x + y * y) > np.cos(TILT)
        stable = upright & (np.hypot(*state.body_rates.T[:2]) < RATE)
        self._stable_since = _since(self._stable_since, stable, time)
        # Allow half a step, since times are multiples of steps only up to rounding.
        held = flying & (time - self._stable_since > HOLD - 0.5 * self._control_step)
        np.fmin(self._recovery_time, self._stable_since, out=self._recovery_time, where=held)
        # The part of the way flown that lies across the line.
        flown = state.position - self._start
        along = (flown * self._direction).sum(axis=1, keepdims=True) * self._direction
        across = np.linalg.norm(flown - along, axis=1)
        error = self._cross_track_error
        np.maximum(error, across, out=error, where=flying)

    def results(self) -> Mapping[str, Any]:
        return {
            "path_length": self._path_length,
            "recovery_time": self._recovery_time,
            "cross_track_error": self._cross_track_error,
        }
