"""What no observation shows, of a vehicle and of what pushes it, as numbers that a network can learn to say."""

import numpy as np

from sb3_quad.base.arrays import Float32Array
from sb3_quad.base.errors import ConfigError
from sb3_quad.simulation.state import FORCE_WORLD, TORQUE_BODY, WRENCH_SIZE, P, QuadcopterState

UNOBSERVED = (
    "load",  # the mean action that holds the height, against weight and push
    "weight",  # in greatest thrusts of the rotors
    *("push_x", "push_y"),  # horizontal accelerations by forces of the world frame, g
    "motor_lag",  # mean time constant of the motors, 0.2 s
    "delay",  # 5 control steps
    "turn_time",  # 1 / √(greatest angular acceleration about the weaker of roll and pitch), 0.2 s
    *("roll_torque", "pitch_torque", "yaw_torque"),  # of the body frame, in the rotors' greatest moments
)
_SAID = 0.9  # at most: tanh reaches 1 nowhere


def unobserved(state: QuadcopterState) -> Float32Array:
    """The numbers of :data:`UNOBSERVED`, dimensionless, clipped to ±0.9, float32 (n, 10).

    :raises ConfigError: a state that does not hold the vehicles.
    """
    if (v := state.vehicles) is None:
        raise ConfigError("this environment does not say which vehicles fly")
    wrench = np.zeros((WRENCH_SIZE, state.n)) if state.wrench is None else state.wrench
    x, y, z = wrench[FORCE_WORLD]
    weight, middle, half = v[P.mass] * v[P.gravity], v[P.thrust_middle], v[P.thrust_half_range]
    moments = np.abs(v[P.roll_arm_0 : P.roll_arm_0 + 12].reshape(3, 4, -1)).sum(axis=1) * half
    turn_time = 1.0 / np.sqrt((moments[:2] / v[[P.ixx, P.iyy]]).min(axis=0))
    lag = 0.5 / v[P.motor_gain_up] + 0.5 / v[P.motor_gain_down]
    load = ((weight - z) / 4.0 - middle) / half
    vehicle = [load, weight / (4.0 * (middle + half)), x / weight, y / weight, lag / 0.2, v[P.delay] / 5.0, turn_time / 0.2]
    return np.stack([*vehicle, *(wrench[TORQUE_BODY] / moments)], axis=1).clip(-_SAID, _SAID).astype(np.float32)
