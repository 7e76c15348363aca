"""The nested PID controller of the thesis (2.1.2, 3.2.1, Table A.1), for a batch of vehicles."""

import math

import numpy as np

from sb3_quad.base.compiled import compiled
from sb3_quad.base.errors import ConfigError
from sb3_quad.envs.simulation.physics import rotation, to_body
from sb3_quad.envs.simulation.settings import Action
from sb3_quad.envs.simulation.state import QuadcopterState, X
from sb3_quad.envs.simulation.vectors import scaled, subtract, vector_at
from sb3_quad.envs.vehicles.vehicle import VehicleSource
from sb3_quad.experts.protocol import Actions, Expert, command_rates

# The thesis scales φ_des and θ_des to a quarter, "to ensure smoother rotations" (3.2.1).
ANGLE_FACTOR = 0.25


class PIDExpert(Expert):
    """Position PID around an attitude PD controller, on the true state (thesis 2.1.2 and 3.2.1).

    It also tracks the velocity, acceleration and heading of a moving reference; the thesis's PID
    does not. It is made for small angles: from a random attitude it recovers less than a third of
    the time.
    The attitude gains are I ωn² and 2 ξ ωn I (Eq. 3.15), so they fit any vehicle. With ITM's
    inertia they are those of Table A.1.

    :param vehicle: name, YAML path or Vehicle that it is designed for.
    :param kp: position gain, 1/s² (Table A.1).
    :param ki: height gain, 1/s³. The printed integral acts over one control step, as ki e_z Δt: a
        true integrator with ki = 50 is unstable.
    :param kd: velocity gain, 1/s, on the body-frame velocity.
    :param natural_frequency: ωn, rad/s.
    :param damping: ξ.
    :param action: what its actions command, see :class:`Expert`. As ``rates`` they are the thrust,
        and ωn / 2 ξ times the errors of the angles.
    :raises ConfigError: a gain that is negative or not finite; or no damping for ``rates``.
    """

    def __init__(
        self,
        vehicle: VehicleSource = "itm",
        kp: float = 1.5,
        ki: float = 50.0,
        kd: float = 4.1,
        natural_frequency: float = 9.0,
        damping: float = 1.0,
        action: Action = "thrusts",
    ) -> None:
        super().__init__(vehicle, action)
        gains = (kp, ki, kd, natural_frequency, damping)
        if not all(0.0 <= gain < math.inf for gain in gains):
            raise ConfigError(
                f"PIDExpert: kp, ki, kd, natural_frequency, damping are {gains}, must be finite "
                "numbers of at least 0"
            )
        # Table A.1, for any inertia (Eq. 3.15).
        v = self.vehicle
        inertia = np.asarray(v.inertia)
        position_gains = np.array([kp, kd, ki * v.control_step, v.mass, v.gravity])
        proportional = inertia * natural_frequency**2
        derivative = inertia * 2 * damping * natural_frequency
        slope = 0.0
        if action == "rates":
            if 0.0 in (damping, natural_frequency):
                raise ConfigError("PIDExpert: natural_frequency and damping: rates need both")
            slope = natural_frequency / (2 * damping)
        self._constants = (
            position_gains,
            np.stack([proportional, derivative]),
            v.mixer_inverse,
            np.array(v.thrust_range),
            v.parameters(),
            slope,
        )

    def actions(self, state: QuadcopterState) -> Actions:
        """Return actions in [-1, 1], float32 of shape (n, 4), for the true state of n vehicles."""
        actions = np.empty((state.n, 4), dtype=np.float32)
        _pid(state.array, *self._constants, actions)
        return actions


@compiled
def _pid(state, gains, attitude, mixer_inverse, limits, vehicle, slope, actions):  # type: ignore[no-untyped-def]
    """Write the actions of n vehicles, (n, 4), from their state, (STATE_SIZE, n).

    :param vehicle: parameters, (len(PARAMETER_NAMES),).
    :param slope: body rate per error of an angle, 1/s; 0 for actions that are thrusts.
    """
    kp, kd, ki_dt, mass, g = gains
    proportional, derivative = attitude
    low, high = limits
    middle = (high + low) / 2
    half = (high - low) / 2
    thrusts = np.empty(4)
    for i in range(actions.shape[0]):
        position_error = subtract(vector_at(state, X.target, i), vector_at(state, X.position, i))
        ahead = vector_at(state, X.target_ahead, i)
        c, s, yaw_rate = vector_at(state, X.target_heading, i)
        if c == s == 0.0:
            c = 1.0
        # The velocity in the body frame, and the Euler angles Z-Y-X.
        body_to_world = rotation(state[X.quaternion :], i)
        v = subtract(vector_at(state, X.velocity, i), vector_at(state, X.target_velocity, i))
        vx, vy, vz = to_body(body_to_world, v)
        p, q, r = vector_at(state, X.body_rates, i)
        (r11, _, _), (r21, _, _), (r31, r32, r33) = body_to_world
        roll = math.atan2(r32, r33)
        pitch = math.asin(min(1.0, max(-1.0, -r31)))
        yaw = math.atan2(r21, r11)

        # Position: desired accelerations, and the angles for the horizontal ones. The thesis
        # assumes that the body is aligned with the world; here it is aligned with the heading.
        # Accelerations of the reference need the full angle, by the time the body has turned.
        ax = kp * position_error[0] - kd * (c * vx - s * vy) + ahead[0] / ANGLE_FACTOR
        ay = kp * position_error[1] - kd * (c * vy + s * vx) + ahead[1] / ANGLE_FACTOR
        az = kp * position_error[2] - kd * vz + ahead[2]
        sine = math.sin(yaw)
        cosine = math.cos(yaw)
        roll_des = ANGLE_FACTOR * (ax * sine - ay * cosine) / g
        pitch_des = ANGLE_FACTOR * (ax * cosine + ay * sine) / g

        # Attitude: the thrust and the moments (Eqs. 2.7 to 2.10). The desired yaw is 0, or the
        # commanded heading.
        u1 = mass * (g + az + ki_dt * position_error[2])
        u2 = proportional[0] * (roll_des - roll) - derivative[0] * p
        u3 = proportional[1] * (pitch_des - pitch) - derivative[1] * q
        yaw = math.atan2(c * r21 - s * r11, c * r11 + s * r21)
        u4 = -proportional[2] * yaw - derivative[2] * (r - yaw_rate)
        if slope > 0.0:
            errors = roll_des - roll, pitch_des - pitch, yaw_rate / slope - yaw
            command_rates(u1, scaled(slope, errors), vehicle, actions[i])
            continue

        # Scale all four thrusts by one factor, so that the largest is allowed.
        largest = -math.inf
        for k in range(4):
            row = mixer_inverse[k]
            thrusts[k] = row[0] * u1 + row[1] * u2 + row[2] * u3 + row[3] * u4
            largest = max(largest, thrusts[k])
        scale = 1.0
        if largest > high:
            scale = high / largest
        for k in range(4):
            thrust = max(low, scale * thrusts[k])
            actions[i, k] = min(1.0, max(-1.0, (thrust - middle) / half))
