"""The nested PID controller of the thesis (2.1.2, 3.2.1, Table A.1), for a batch of vehicles at
once.
"""

import math

import numpy as np
import numpy.typing as npt

from sb3_quad.base.errors import ConfigError
from sb3_quad.experts.protocol import Actions, Expert
from sb3_quad.simulation.compiled import compiled
from sb3_quad.simulation.physics import rotation_rows
from sb3_quad.simulation.state import (
    BODY_RATES,
    POSITION,
    QUATERNION,
    TARGET,
    VELOCITY,
    QuadcopterState,
)
from sb3_quad.vehicles.vehicle import Vehicle

ANGLE_FACTOR = (
    0.25  # φ_des and θ_des are taken at a quarter, "to ensure smoother rotations" (3.2.1)
)


class PIDExpert(Expert):
    """Position PID around an attitude PD controller, on the true state (thesis 2.1.2 and 3.2.1).

    For small angles; from a random attitude it recovers less than a third of the time. The attitude
    gains are I ωn² and 2 ξ ωn I (Eq. 3.15), so they fit any vehicle; with ITM's inertia they are
    those of Table A.1.

    :param vehicle: name, YAML path or Vehicle it is designed for.
    :param kp: position gain, 1/s² (Table A.1).
    :param ki: height gain, 1/s³. The printed integral acts over one control step, as ki e_z Δt: a
        true integrator with ki = 50 is unstable.
    :param kd: velocity gain, 1/s, on the body-frame velocity.
    :param natural_frequency: ωn, rad/s.
    :param damping: ξ.
    :raises ConfigError: a gain that is negative or not finite.
    """

    def __init__(
        self,
        vehicle: str | Vehicle = "itm",
        kp: float = 1.5,
        ki: float = 50.0,
        kd: float = 4.1,
        natural_frequency: float = 9.0,
        damping: float = 1.0,
        observation_mean: npt.ArrayLike | None = None,
        observation_std: npt.ArrayLike | None = None,
    ) -> None:
        super().__init__(vehicle, observation_mean, observation_std)
        gains = {
            "kp": kp,
            "ki": ki,
            "kd": kd,
            "natural_frequency": natural_frequency,
            "damping": damping,
        }
        for name, value in gains.items():
            if not (math.isfinite(value) and value >= 0):
                raise ConfigError(
                    f"PIDExpert: {name} is {value}, must be a finite number of at least 0"
                )
        v = self.vehicle
        inertia = np.asarray(v.inertia)
        position = np.array([kp, kd, ki * v.control_step, v.mass, v.gravity])
        attitude = np.stack(
            [inertia * natural_frequency**2, inertia * 2 * damping * natural_frequency]
        )
        self._constants = position, attitude, v.mixer_inverse, np.array(v.thrust_range)

    def actions(self, state: QuadcopterState) -> Actions:
        """Actions in [-1, 1], float32 of shape (n, 4), for the true state of n vehicles."""
        actions = np.empty((state.n, 4), dtype=np.float32)
        moving = [
            state.array[rows] for rows in (POSITION, QUATERNION, VELOCITY, BODY_RATES, TARGET)
        ]
        _pid(*moving, *self._constants, actions)
        return actions


@compiled
def _pid(
    position, quaternion, velocity, rates, target, gains, attitude, mixer_inverse, limits, actions
):  # type: ignore[no-untyped-def]
    kp, kd, ki_dt, mass, g = gains
    low, high = limits
    middle, half = (high + low) / 2, (high - low) / 2
    for i in range(actions.shape[0]):
        ex = target[0, i] - position[0, i]
        ey = target[1, i] - position[1, i]
        ez = target[2, i] - position[2, i]
        vx, vy, vz = velocity[0, i], velocity[1, i], velocity[2, i]
        (r11, r12, r13), (r21, r22, r23), (r31, r32, r33) = rotation_rows(
            quaternion[0, i], quaternion[1, i], quaternion[2, i], quaternion[3, i]
        )
        roll, pitch, yaw = (
            math.atan2(r32, r33),
            math.asin(min(1.0, max(-1.0, -r31))),
            math.atan2(r21, r11),
        )
        ax = kp * ex - kd * (r11 * vx + r21 * vy + r31 * vz)  # body-frame velocity
        ay = kp * ey - kd * (r12 * vx + r22 * vy + r32 * vz)
        az = kp * ez - kd * (r13 * vx + r23 * vy + r33 * vz)
        sin_yaw, cos_yaw = math.sin(yaw), math.cos(yaw)
        roll_des = ANGLE_FACTOR * (ax * sin_yaw - ay * cos_yaw) / g
        pitch_des = ANGLE_FACTOR * (ax * cos_yaw + ay * sin_yaw) / g
        u1 = mass * (g + az + ki_dt * ez)
        u2 = attitude[0, 0] * (roll_des - roll) - attitude[1, 0] * rates[0, i]
        u3 = attitude[0, 1] * (pitch_des - pitch) - attitude[1, 1] * rates[1, i]
        u4 = -attitude[0, 2] * yaw - attitude[1, 2] * rates[2, i]  # ψ_des = 0
        largest = -math.inf
        for k in range(4):
            m = mixer_inverse[k]
            largest = max(largest, m[0] * u1 + m[1] * u2 + m[2] * u3 + m[3] * u4)
        scale = (
            high / largest if largest > high else 1.0
        )  # all four by one factor, so that the largest is allowed
        for k in range(4):
            m = mixer_inverse[k]
            thrust = max(low, scale * (m[0] * u1 + m[1] * u2 + m[2] * u3 + m[3] * u4))
            actions[i, k] = min(1.0, max(-1.0, (thrust - middle) / half))
