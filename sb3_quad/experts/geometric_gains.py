"""The constants of the geometric expert's law: gains, and values that follow from a vehicle."""

from typing import NamedTuple

import numpy as np

from sb3_quad.base.types import FloatArray
from sb3_quad.envs.simulation.state import P, first_rows
from sb3_quad.envs.vehicles.gains import GAIN_NAMES, GeometricGains
from sb3_quad.envs.vehicles.vehicle import Vehicle

G = first_rows(dict.fromkeys(GAIN_NAMES, 1))

# The yaw gain is this many times larger if the external torque is known, so that an error in
# compensating it causes a smaller yaw rate.
PRIVILEGED_YAW = 4.0
# If commands act late, ``privileged_derived`` slows down the outer loop and speeds up the inner one
# by these factors of the gains.
_LATE = {
    "position": 0.85,
    "velocity": 0.85,
    "height_position": 0.85,
    "height_velocity": 0.85,
    "attitude": 0.85,
    "descent": 0.5,
    "body_rates": 1.25,
}
# Command lags, s, at which these factors set in and at which they apply in full.
_LATE_FROM = 0.085
_LATE_TO = 0.125


class LawConstants(NamedTuple):
    """Constants of n vehicles, a column each, in the layout that the law is compiled for."""

    vehicles: FloatArray
    """Parameters, (len(PARAMETER_NAMES), n)."""
    gains: FloatArray
    """Shape (len(GAIN_NAMES), n), in the order of ``GAIN_NAMES``."""
    lag: FloatArray
    """Shape (n,), τ, from a command to its thrust, s."""
    mixer_inverse: FloatArray
    """Shape (4, 4, n), rotor thrusts from thrust and moments."""


def derived_gains(vehicle: Vehicle) -> GeometricGains:
    """Return gains for a vehicle whose YAML has none, in proportion to its control authority.

    The factors were found by search, for ITM, Crazyflie, Hummingbird, a vehicle with slow motors
    and vehicles of the distribution ``raptor`` together, with a privileged expert. The scales are
    the lag τ from a command to its thrust (:func:`command_lag`); the greatest angular
    acceleration a_φ about the weaker of roll and pitch; the time to turn, τ + 1/√a_φ; and the
    greatest accelerations: upwards, g (c - 1), sideways at constant height, g √(c² - 1), and
    downwards, g (1 - l), with thrust limits l and c in hover thrusts.
    """
    rows = gains_by_authority(vehicle.parameters()[:, None], vehicle.control_step)
    return GeometricGains.model_validate(dict(zip(GAIN_NAMES, rows[:, 0].tolist(), strict=True)))


def gains_by_authority(v: FloatArray, control_step: float) -> FloatArray:
    """Return the gains of :func:`derived_gains`, (len(GAIN_NAMES), n).

    :param v: parameters of n vehicles, (len(PARAMETER_NAMES), n).
    """
    # How quickly the vehicle can turn, by the weaker of roll and pitch
    gravity = v[P.gravity]
    lag = command_lag(v, control_step)
    roll_pitch_arms = v[P.roll_arm_0 : P.yaw_arm_0].reshape(2, 4, -1)
    factors = v[P.thrust_factor_0 : P.thrust_factor_0 + 4]
    moments = np.abs(roll_pitch_arms * factors).sum(axis=1) * v[P.thrust_half_range]
    turn = (moments / v[[P.ixx, P.iyy]]).min(axis=0)
    rate = np.minimum(1.0 / (lag + 1.0 / np.sqrt(turn)), 0.438 / lag)

    # In hover thrusts of the rotor with the least margin. Worn motors or a low battery may not even
    # lift the vehicle.
    hovers = v[P.hover_share_0 : P.hover_share_0 + 4] * v[P.hover_thrust]
    least = (v[P.thrust_middle] - v[P.thrust_half_range]) / hovers.min(axis=0)
    most = (v[P.thrust_middle] + v[P.thrust_half_range]) / hovers.max(axis=0)
    most = np.maximum(most, 1.01)
    sideways = np.sqrt(most**2 - 1.0)
    upwards = gravity * (most - 1.0)
    downwards = 1.0 - least

    gains = {
        "position": 0.285 * rate,
        "velocity": 0.607 * rate,
        "height_position": 0.407 * rate,
        "height_velocity": 0.937 * rate,
        "deceleration": 1.07 * gravity * sideways,
        "height_deceleration": 1.63 * gravity * downwards,
        "descent": gravity * np.minimum(0.9, 1.56 * downwards),
        "tilt": 1.90 * sideways,
        "attitude": 1.53 * rate,
        "angular_deceleration": 1.17 * turn,
        "body_rates": 0.587 / lag,
        "yaw_rate": 0.132 / lag,
        "descent_deceleration": 0.612 * upwards,
    }
    return np.stack([gains[name] for name in GAIN_NAMES])


def command_lag(v: FloatArray, control_step: float) -> FloatArray:
    """Return the times τ from a command to its thrust, (n,), s, for parameters
    (len(PARAMETER_NAMES), n).

    It is the delay, half the control step it is held for, and the motors' time constant: 1/k_m, the
    mean of a rotor that speeds up and one that slows down.
    """
    held = (v[P.delay] + 0.5) * control_step
    return np.asarray(held + 0.5 / v[P.motor_gain_up] + 0.5 / v[P.motor_gain_down])


def constants_of(v: FloatArray, control_step: float, gains: FloatArray) -> LawConstants:
    """Return the constants for n vehicles, from their parameters and gains.

    :param v: parameters, (len(PARAMETER_NAMES), n).
    :param gains: (len(GAIN_NAMES), n).
    """
    # [ΣF; Mx; My; Mz] = mixer · F: ones, then the arms of the rotors about each axis.
    arms = v[P.roll_arm_0 : P.roll_arm_0 + 12].reshape(3, 4, -1)
    mixers = np.concatenate([np.ones_like(arms[:1]), arms])
    # Commanded thrusts: those that the rotors give, divided by their factors
    mixers *= v[P.thrust_factor_0 : P.thrust_factor_0 + 4]
    inverse = np.linalg.inv(mixers.transpose(2, 0, 1)).transpose(1, 2, 0)
    # A randomized centre of mass may lie outside the rotors, where a share would be negative.
    inverse[:, 0] = np.maximum(inverse[:, 0], 0.01)
    lag = command_lag(v, control_step)
    return LawConstants(v.copy(), gains, lag, np.ascontiguousarray(inverse))


class TrueConstants:
    """The law's constants for vehicles whose true parameters are known.

    They are kept, and recomputed only for vehicles that have changed: in each control step of a
    training, only a few rows begin a new episode with another vehicle.

    :param vehicle: the vehicle that ``gains`` are for. The gains of other vehicles scale with their
        control authority, as :func:`derived_gains` do.
    :param is_gentle: whether the gains change if commands act late.
    """

    def __init__(self, vehicle: Vehicle, gains: GeometricGains, is_gentle: bool = False) -> None:
        self._control_step = vehicle.control_step
        own = vehicle.parameters()[:, None]
        self._scale = gains.values()[:, None] / gains_by_authority(own, self._control_step)
        self._scale[G.yaw_rate] *= PRIVILEGED_YAW
        self._is_gentle = is_gentle
        self._kept = self._compute(own)

    def of(self, vehicles: FloatArray) -> LawConstants:
        """Return the constants for parameters (len(PARAMETER_NAMES), n)."""
        # Another number of vehicles means another environment.
        if self._kept.vehicles.shape != vehicles.shape:
            self._kept = self._compute(vehicles)
        changed = np.flatnonzero((self._kept.vehicles != vehicles).any(axis=0))
        if changed.size:
            new = self._compute(vehicles[:, changed])
            for kept, values in zip(self._kept, new, strict=True):
                kept[..., changed] = values
        return self._kept

    def _compute(self, v: FloatArray) -> LawConstants:
        gains = self._scale * gains_by_authority(v, self._control_step)
        if self._is_gentle:
            lag = command_lag(v, self._control_step)
            lateness = np.clip((lag - _LATE_FROM) / (_LATE_TO - _LATE_FROM), 0.0, 1.0)
            factors = np.array([[_LATE.get(name, 1.0)] for name in GAIN_NAMES])
            gains *= 1.0 + (factors - 1.0) * lateness
        return constants_of(v, self._control_step, gains)
