"""A geometric controller for large angles: it recovers from nearly every attitude, spin and fall, and flies to targets."""

from __future__ import annotations

import math

import numba
import numpy as np
import numpy.typing as npt

from sb3_quad.dynamics.gains import GeometricGains
from sb3_quad.dynamics.state import QuadcopterState
from sb3_quad.dynamics.vehicle import Vehicle
from sb3_quad.experts.protocol import Actions, Expert


def derived_gains(vehicle: Vehicle) -> GeometricGains:
    """Gains for a vehicle whose YAML has none, from its control authority: ITM's, found by search, without their dimension.

    The units are the lag from a command to its thrust, τ = 1/k_m + (delay + ½) Δt (rates 1/τ); the greatest angular
    acceleration about the weaker of roll and pitch; and the greatest accelerations upwards, g (c - 1), and sideways at
    constant height, g √(c² - 1), with c the greatest thrust in hover thrusts.
    """
    low, high = vehicle.thrust_range
    moments = np.abs(vehicle.mixer[1:3]).sum(axis=1) * (high - low) / 2
    turn = float(np.min(moments / np.asarray(vehicle.inertia[:2])))
    lag = 1.0 / vehicle.motor_gain + (vehicle.delay + 0.5) * vehicle.control_step
    up = vehicle.gravity * (vehicle.thrust_limits[1] - 1.0)
    tangent = math.sqrt(vehicle.thrust_limits[1] ** 2 - 1.0)
    attitude = 0.249 / lag
    return GeometricGains(
        position=0.0762 * attitude**2,
        velocity=0.384 * attitude,
        horizontal_acceleration=0.547 * tangent * vehicle.gravity,
        fall_speed=0.673 * up,  # of 1 s
        fall_tilt=0.084,
        tilt=0.716 * tangent,
        attitude=attitude,
        braking=0.318 * turn,
        body_rates=0.975 / lag,
        thrust_cone=0.3,
        long_way=1.29,
    )


class GeometricExpert(Expert):
    """Position and attitude control on S² for large angles, with braking profile and prioritised mixing.

    After Lee, Leok and McClamroch, "Geometric tracking control of a quadrotor UAV on SE(3)" (CDC 2010), with reduced
    attitude (the thrust direction only; yaw is damped, as in Brescianini and D'Andrea, "Tilt-prioritized quadrocopter
    attitude control", 2018), since no task here asks for a heading. What recovery needs beyond it: a vehicle that points
    away from the desired force gives its least thrust, turns by a rate profile that it can brake from, goes on turning
    the long way round where its spin makes that quicker, and stops a fall before it travels.

    :param vehicle: name, YAML path or Vehicle it is designed for.
    :param gains: the :class:`GeometricGains`; None for those in the vehicle's YAML (``geometric_gains``), or
        :func:`derived_gains` where it has none.
    """

    def __init__(
        self,
        vehicle: str | Vehicle = "itm",
        gains: GeometricGains | None = None,
        observation_mean: npt.ArrayLike | None = None,
        observation_std: npt.ArrayLike | None = None,
    ) -> None:
        super().__init__(vehicle, observation_mean, observation_std)
        v = self.vehicle
        self.gains = gains or v.geometric_gains or derived_gains(v)
        self._gains = self.gains.values()
        self._body = np.array([v.mass, v.gravity, *v.inertia, 4 * v.moment_thrust_ratio * np.diff(v.thrust_range)[0] / 2])
        self._thrust_range = np.array(v.thrust_range)

    def actions(self, state: QuadcopterState) -> Actions:
        """Actions in [-1, 1], float32 of shape (n, 4), for the true state of n vehicles."""
        actions = np.empty((state.n, 4), dtype=np.float32)
        _geometric(state.array, self._gains, self._body, self.vehicle.mixer_inverse, self._thrust_range, actions)
        return actions


@numba.njit(cache=True)
def _desired_force(ex, ey, ez, vx, vy, vz, gains, g):  # type: ignore[no-untyped-def]
    """Desired force per mass in the world frame, m/s²: to the target, but out of a fall first."""
    kp, kv, a_max, fall_speed, fall_tilt, tilt = gains[0], gains[1], gains[2], gains[3], gains[4], gains[5]
    ax, ay = kp * ex - kv * vx, kp * ey - kv * vy
    horizontal = math.sqrt(ax * ax + ay * ay)
    fz = max(1.0, g + min(30.0, max(-4.0, kp * ez - kv * vz)))
    limit = min(a_max, fz * (fall_tilt if vz < -fall_speed else tilt))
    scale = limit / horizontal if horizontal > limit else 1.0
    return scale * ax, scale * ay, fz


@numba.njit(cache=True)
def _moments(b1, b2, b3, p, q, r, gains, body):  # type: ignore[no-untyped-def]
    """Body moments that turn the thrust to the direction (b1, b2, b3), body frame, N m."""
    k_a, a_w, k_w, long_way, k_yaw, yaw_limit = gains[6], gains[7], gains[8], gains[10], gains[11], gains[12] * body[5]
    sine = math.sqrt(b1 * b1 + b2 * b2)
    angle = math.atan2(sine, b3)
    nx, ny = (-b2 / sine, b1 / sine) if sine > 1e-9 else (1.0, 0.0)
    along = p * nx + q * ny
    if along < 0.0 and math.pi - angle < long_way * min(1.0, -along / 8.0):
        nx, ny, angle = -nx, -ny, 2 * math.pi - angle
    rate = min(k_a * angle, math.sqrt(2 * a_w * angle))
    mx = body[2] * k_w * (rate * nx - p)
    my = body[3] * k_w * (rate * ny - q)
    mz = min(yaw_limit, max(-yaw_limit, -k_yaw * body[4] * r))
    return mx, my, mz


@numba.njit(cache=True)
def _geometric(x, gains, body, mixer_inverse, thrust_range, actions):  # type: ignore[no-untyped-def]
    mass, g = body[0], body[1]
    low, high = thrust_range
    middle, half = (high + low) / 2, (high - low) / 2
    difference = np.empty(4)
    for i in range(x.shape[1]):
        w, qx, qy, qz = x[3, i], x[4, i], x[5, i], x[6, i]
        ex, ey, ez = x[17, i] - x[0, i], x[18, i] - x[1, i], x[19, i] - x[2, i]
        fx, fy, fz = _desired_force(ex, ey, ez, x[7, i], x[8, i], x[9, i], gains, g)
        size = math.sqrt(fx * fx + fy * fy + fz * fz)
        b1 = ((1 - 2 * (qy * qy + qz * qz)) * fx + 2 * (qx * qy + w * qz) * fy + 2 * (qx * qz - w * qy) * fz) / size
        b2 = (2 * (qx * qy - w * qz) * fx + (1 - 2 * (qx * qx + qz * qz)) * fy + 2 * (qy * qz + w * qx) * fz) / size
        b3 = (2 * (qx * qz + w * qy) * fx + 2 * (qy * qz - w * qx) * fy + (1 - 2 * (qx * qx + qy * qy)) * fz) / size
        mx, my, mz = _moments(b1, b2, b3, x[10, i], x[11, i], x[12, i], gains, body)
        common = mass * size * b3 / 4 if b3 > gains[9] else low
        largest, least, most = 0.0, 0.0, 0.0
        for k in range(4):
            m = mixer_inverse[k]
            difference[k] = m[1] * mx + m[2] * my + m[3] * mz
            largest = max(largest, abs(difference[k]))
            least, most = min(least, difference[k]), max(most, difference[k])
        scale = half / largest if largest > half else 1.0  # the moments come first: all differences by one factor ...
        common = min(
            high - scale * most, max(low - scale * least, min(high, max(low, common)))
        )  # ... then the thrust gives way
        for k in range(4):
            actions[i, k] = min(1.0, max(-1.0, (common + scale * difference[k] - middle) / half))
