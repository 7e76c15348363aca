"""What a vehicle can do, from its parameters alone: how hard its rotors lift and turn it, and how soon they answer."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sb3_quad.base.arrays import FloatArray
from sb3_quad.vehicles.vehicle import Vehicle


class Authority(NamedTuple):
    """Accelerations in m/s² and rad/s², moments in N m, times in s; axes are roll, pitch, yaw.

    :param thrust_to_weight: greatest thrust of all rotors by the weight.
    :param least_thrust: least thrust of all rotors by the weight; what is left of it upside down pulls down.
    :param climb: greatest acceleration upwards, g (c - 1).
    :param sideways: greatest horizontal acceleration at constant height, g √(c² - 1).
    :param tilt: the tilt at that, rad.
    :param fall: greatest acceleration downwards while level, g (1 - l).
    :param moments: (3,), greatest moment about each axis, the other axes and the thrust left to themselves.
    :param accelerations: (3,), what they accelerate the body by.
    :param hover_moments: (3,), greatest moment about each axis at hover thrust, either way, without any about the others.
    :param hover_accelerations: (3,), likewise.
    :param motor_lag: time constant 1/k_m of the rotor speeds (Eq. 4.1).
    :param command_lag: from a command to its thrust: delay, half the control step it is held for, and the motors.
    :param half_turn: time to turn by 180° about the weaker of roll and pitch and stop, from rest, without the lags.
    """

    thrust_to_weight: float
    least_thrust: float
    climb: float
    sideways: float
    tilt: float
    fall: float
    moments: FloatArray
    accelerations: FloatArray
    hover_moments: FloatArray
    hover_accelerations: FloatArray
    motor_lag: float
    command_lag: float
    half_turn: float


def authority(vehicle: Vehicle) -> Authority:
    """What a vehicle can do by its parameters; no drag and no rotor gyroscopics, as in the environments (thesis 4.1.1)."""
    least, most = vehicle.thrust_limits
    inertia = np.asarray(vehicle.inertia)
    moments, at_hover = greatest_moments(vehicle), _hover_moments(vehicle)
    accelerations = moments / inertia
    return Authority(
        thrust_to_weight=most,
        least_thrust=least,
        climb=vehicle.gravity * (most - 1.0),
        sideways=vehicle.gravity * math.sqrt(most**2 - 1.0),
        tilt=math.acos(1.0 / most),
        fall=vehicle.gravity * (1.0 - least),
        moments=moments,
        accelerations=accelerations,
        hover_moments=at_hover,
        hover_accelerations=at_hover / inertia,
        motor_lag=1.0 / vehicle.motor_gain,
        command_lag=command_lag(vehicle),
        half_turn=2.0 * math.sqrt(math.pi / float(accelerations[:2].min())),
    )


def greatest_moments(vehicle: Vehicle) -> FloatArray:
    """Greatest roll, pitch and yaw moment that the rotor limits allow, each by itself, (3,), N m.

    Equal thrusts give none (the vehicle's validation), so what counts is how far each rotor can go from the middle.
    """
    low, high = vehicle.thrust_range
    return np.asarray(np.abs(vehicle.mixer[1:]).sum(axis=1) * (high - low) / 2)


def command_lag(vehicle: Vehicle) -> float:
    """τ, s, from a command to its thrust: the delay, half of the control step it is held for, and the motors (Eq. 4.1)."""
    return (vehicle.delay + 0.5) * vehicle.control_step + 1.0 / vehicle.motor_gain


def gyration_ratio(vehicle: Vehicle) -> FloatArray:
    """Radii of gyration √(I/m) by the distance of the outermost rotor, (3,); above 1 the mass would lie beyond the rotors."""
    arm = max(math.hypot(x, y) for x, y in vehicle.rotor_positions)
    return np.sqrt(np.asarray(vehicle.inertia) / vehicle.mass) / arm


def _hover_moments(vehicle: Vehicle) -> FloatArray:
    low, high = vehicle.thrust_range
    up, down = high - vehicle.hover_thrust, vehicle.hover_thrust - low
    per_moment = vehicle.mixer_inverse[:, 1:]  # N of each rotor for 1 N m about each axis, (4, 3)
    used = [np.maximum(sign * per_moment / up, -sign * per_moment / down).max(axis=0) for sign in (1.0, -1.0)]
    return np.asarray(1.0 / np.maximum(*used))
