"""Which columns the logs of each flight stack have, with units, axes and the order of motors.

Everything becomes SI units, the body frame x forward, y left, z up, and a world frame with z up.
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

DEGREE = math.radians(1.0)
G = 9.80665  # m/s², of an accelerometer that shows multiples of it
PWM = 65_535.0  # full motor command of a Crazyflie


class Columns(NamedTuple):
    """Columns that hold a quantity."""

    names: Sequence[str]
    scale: float = 1.0
    """their factor to the unit of the quantity"""
    zero: float = 0.0
    """what is subtracted first"""


class Format(NamedTuple):
    """The log of a flight stack."""

    name: str
    order: str
    """a key of :data:`~sb3_quad.envs.vehicles.layout.ORDERS`; empty: that of the vehicle file"""
    series: Mapping[str, Sequence[Columns]]
    """for each quantity the columns that may hold it; the first ones that the log has count.

    ``thrust`` (N), ``rotor_speed`` (rad/s), ``share`` (motor command, 0 to 1), ``pwm_battery`` (a
    Crazyflie's commands and V), ``gyro`` (rad/s), ``accelerometer`` (m/s²), ``attitude`` (w, x, y,
    z, body to world), ``velocity`` (m/s) and ``position`` (m).
    """
    time: Columns = Columns(["t"])
    is_down: bool = False
    """whether y and z of body and world point right and down, as in PX4"""


def numbered(text: str, keys: Sequence[object] = (1, 2, 3, 4)) -> list[str]:
    """Return names with something in the place of ``*``, such as ``motor.m1`` to ``motor.m4``."""
    return [text.replace("*", str(key)) for key in keys]


_XYZ = ("x", "y", "z")
_CAPTURE = {
    "attitude": [Columns(["qw", "qx", "qy", "qz"])],
    "velocity": [Columns(numbered("v*", _XYZ))],
    "position": [Columns(numbered("p*", _XYZ))],
}
NANOBENCH = Format(
    "NanoBench",
    "crazyflie",
    {
        "pwm_battery": [Columns([*numbered("motor_motor_m*"), "pwr_pm_vbat"])],
        "gyro": [Columns(numbered("imu_gyro_*", _XYZ))],
        "accelerometer": [Columns(numbered("imu_acc_*", _XYZ), G)],
        **_CAPTURE,
    },
)
PLAIN = Format(
    "plain CSV",
    "",
    {
        "thrust": [Columns(numbered("thrust_m*"))],
        "rotor_speed": [Columns(numbered("rpm_m*"), math.pi / 30.0)],
        "share": [Columns(numbered("command_m*"))],
        "gyro": [Columns(numbered("gyro_*", _XYZ)), Columns(numbered("imu_gyro_*", _XYZ))],
        "accelerometer": [Columns(numbered("acc_*", _XYZ))],
        **_CAPTURE,
    },
)
CRAZYFLIE = Format(
    "Crazyflie",
    "crazyflie",
    {
        "share": [Columns(numbered("motor.m*"), 1.0 / PWM)],
        "gyro": [Columns(numbered("gyro.*", _XYZ), DEGREE)],
        "accelerometer": [Columns(numbered("acc.*", _XYZ), G)],
        "attitude": [Columns(numbered("stateEstimate.q*", ("w", *_XYZ)))],
        "velocity": [Columns(numbered("stateEstimate.v*", _XYZ))],
        "position": [Columns(numbered("stateEstimate.*", _XYZ))],
    },
    Columns(["timestamp"], 1e-3),
)
# Betaflight's axes are those of this package: rolling right, pitching down and yawing to the left
# are positive. A command of DShot runs from 48 to 2047, one of PWM from 1000 to 2000.
BETAFLIGHT = Format(
    "Betaflight",
    "betaflight",
    {
        "share": [Columns(numbered("motor[*]", range(4)), 1.0 / 1999.0, 48.0)],
        "gyro": [Columns(numbered("gyroADC[*]", range(3)), DEGREE)],
        "accelerometer": [Columns(numbered("accSmooth[*]", range(3)), G / 2048.0)],
    },
    Columns(["time"], 1e-6),
)
PX4 = Format(
    "PX4",
    "px4",
    {
        "share": [
            Columns(numbered("actuator_motors.control[*]", range(4))),
            Columns(numbered("actuator_outputs.output[*]", range(4)), 1e-3, 1000.0),
        ],
        "gyro": [
            Columns(numbered("vehicle_angular_velocity.xyz[*]", range(3))),
            Columns(numbered("sensor_combined.gyro_rad[*]", range(3))),
        ],
        "accelerometer": [
            Columns(numbered("vehicle_acceleration.xyz[*]", range(3))),
            Columns(numbered("sensor_combined.accelerometer_m_s2[*]", range(3))),
        ],
        "attitude": [Columns(numbered("vehicle_attitude.q[*]", range(4)))],
        "velocity": [Columns(numbered("vehicle_local_position.v*", _XYZ))],
        "position": [Columns(numbered("vehicle_local_position.*", _XYZ))],
    },
    is_down=True,
)
TABLES = (NANOBENCH, PLAIN, CRAZYFLIE, BETAFLIGHT)
COMMANDS = ("thrust", "rotor_speed", "share", "pwm_battery")
