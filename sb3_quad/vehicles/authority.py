"""What a vehicle can do, from its parameters alone: how hard its rotors lift and turn it, and how soon they answer."""

import math

import numpy as np

from sb3_quad.base.arrays import FloatArray
from sb3_quad.vehicles.vehicle import Vehicle


class Authority:
    """What a vehicle can do by its parameters; no drag and no rotor gyroscopics, as in the environments (thesis 4.1.1).

    Accelerations in m/s² and rad/s², moments in N m, times in s; axes are roll, pitch, yaw.

    :ivar thrust_to_weight: greatest thrust of all rotors by the weight.
    :ivar least_thrust: least thrust of all rotors by the weight; what is left of it upside down pulls down.
    :ivar climb: greatest acceleration upwards, g (c - 1).
    :ivar sideways: greatest horizontal acceleration at constant height, g √(c² - 1).
    :ivar tilt: the tilt at that, rad.
    :ivar fall: greatest acceleration downwards while level, g (1 - l).
    :ivar moments: (3,), greatest moment about each axis, the other axes and the thrust left to themselves.
    :ivar accelerations: (3,), what they accelerate the body by.
    :ivar hover_moments: (3,), greatest moment about each axis at hover thrust, either way, without any about the others.
    :ivar hover_accelerations: (3,), likewise.
    :ivar motor_lag: time constant 1/k_m of the rotor speeds (Eq. 4.1).
    :ivar command_lag: τ, from a command to its thrust: delay, half the control step it is held for, and the motors.
    :ivar half_turn: time to turn by 180° about the weaker of roll and pitch and stop, from rest, without the lags.
    :ivar gyration_ratios: (3,), radii of gyration √(I/m) by the arm length; above 1 the mass would lie beyond the rotors.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        self.least_thrust, self.thrust_to_weight = least, most = vehicle.thrust_limits
        gravity, inertia = vehicle.gravity, np.array(vehicle.inertia)
        self.climb = gravity * (most - 1.0)
        self.sideways = gravity * math.sqrt(most**2 - 1.0)
        self.tilt = math.acos(1.0 / most)
        self.fall = gravity * (1.0 - least)
        low, high = vehicle.thrust_range
        # Equal thrusts give no moment (the vehicle's validation): what counts is how far each rotor can go from the middle.
        self.moments: FloatArray = np.abs(vehicle.mixer[1:]).sum(axis=1) * (high - low) / 2
        self.accelerations: FloatArray = self.moments / inertia
        up, down = high - vehicle.hover_thrust, vehicle.hover_thrust - low
        per_moment = vehicle.mixer_inverse[:, 1:]  # N of each rotor for 1 N m about each axis, (4, 3)
        used = [np.maximum(sign * per_moment / up, -sign * per_moment / down).max(axis=0) for sign in (1.0, -1.0)]
        self.hover_moments: FloatArray = 1.0 / np.maximum(*used)
        self.hover_accelerations: FloatArray = self.hover_moments / inertia
        self.motor_lag = 1.0 / vehicle.motor_gain
        self.command_lag = (vehicle.delay + 0.5) * vehicle.control_step + self.motor_lag
        self.half_turn = 2.0 * math.sqrt(math.pi / float(self.accelerations[:2].min()))
        self.gyration_ratios: FloatArray = np.sqrt(inertia / vehicle.mass) / vehicle.arm_length
