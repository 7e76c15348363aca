r"""The thesis's PID law in each way in which you can read its text.

The readings differ in the order of the Euler angles and in the frame of the velocity.

    python examples/thesis_readings.py
    PYTHONPATH=examples sb3-quad evaluate ours=pid zxy_body=thesis_readings:zxy_body \
        zyx_world=thesis_readings:zyx_world zxy_world=thesis_readings:zxy_world \
        --suite thesis -o evaluations/readings

Eq. 2.1 prints the order Z-X-Y and Eq. 2.9 the velocity of the world frame. ``PIDExpert`` takes
Z-Y-X and the body frame. docs/choices.md says why, with the figures of this command. Everything
else is the same as in ``PIDExpert``.
"""

import numpy as np
import numpy.typing as npt

from sb3_quad import PIDExpert
from sb3_quad.envs.simulation.state import QuadcopterState
from sb3_quad.envs.vehicles.vehicle import Vehicle
from sb3_quad.evaluation.flights import fly

# Table A.1
KP = 1.5
KI = 50.0
KD = 4.1
NATURAL_FREQUENCY = 9.0
DAMPING = 1.0
# Section 3.2.1
ANGLE_FACTOR = 0.25


class PIDReading(PIDExpert):
    """The PID law with a given order of angles and frame of the velocity.

    :param order: ``zyx``, ``zxy`` or ``xyz``: body to world is the product of the three turns, the
        first one leftmost.
    :param frame: ``body`` or ``world``: the axes of the velocity in Eq. 2.9.
    """

    def __init__(self, vehicle: str | Vehicle, order: str, frame: str) -> None:
        super().__init__(vehicle)
        self._order = order
        self._frame = frame

    def actions(self, state: QuadcopterState) -> npt.NDArray[np.float32]:
        """Actions in [-1, 1], float32 of shape (n, 4)."""
        vehicle = self.vehicle
        rotation = state.rotation  # (n, 3, 3), body to world
        roll, pitch, yaw = euler_angles(rotation, self._order)
        velocity = state.velocity
        if self._frame == "body":
            velocity = np.einsum("nji,nj->ni", rotation, velocity)

        # The acceleration that the position loop commands, and the tilt that produces it.
        error = state.target - state.position
        wanted = KP * error - KD * velocity
        sin = np.sin(yaw)
        cos = np.cos(yaw)
        wanted_roll = ANGLE_FACTOR / vehicle.gravity * (wanted[:, 0] * sin - wanted[:, 1] * cos)
        wanted_pitch = ANGLE_FACTOR / vehicle.gravity * (wanted[:, 0] * cos + wanted[:, 1] * sin)

        # The attitude loop: a damped oscillator about each axis.
        angles = np.stack([wanted_roll - roll, wanted_pitch - pitch, -yaw], axis=1)
        damping = 2 * DAMPING * NATURAL_FREQUENCY * state.body_rates
        turning = NATURAL_FREQUENCY**2 * angles - damping

        height = wanted[:, 2] + KI * vehicle.control_step * error[:, 2]
        force = vehicle.mass * (vehicle.gravity + height)
        wrench = np.column_stack([force, np.asarray(vehicle.inertia) * turning])
        thrusts = wrench @ vehicle.mixer_inverse.T
        low, high = vehicle.thrust_range
        # If a rotor would exceed its limit, all four are scaled down.
        thrusts *= (high / np.maximum(thrusts.max(1), high))[:, None]
        half = (high - low) / 2
        actions = (np.maximum(thrusts, low) - low) / half - 1
        return np.asarray(np.clip(actions, -1, 1), dtype=np.float32)


def euler_angles(r: npt.NDArray[np.float64], order: str) -> tuple[npt.NDArray[np.float64], ...]:
    """Roll, pitch and yaw, (n,) each, of rotation matrices (n, 3, 3)."""

    def arcsin(x: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        return np.asarray(np.arcsin(np.clip(x, -1, 1)))

    if order == "zyx":
        return (
            np.arctan2(r[:, 2, 1], r[:, 2, 2]),
            arcsin(-r[:, 2, 0]),
            np.arctan2(r[:, 1, 0], r[:, 0, 0]),
        )
    if order == "zxy":
        return (
            arcsin(r[:, 2, 1]),
            np.arctan2(-r[:, 2, 0], r[:, 2, 2]),
            np.arctan2(-r[:, 0, 1], r[:, 1, 1]),
        )
    return (
        np.arctan2(-r[:, 1, 2], r[:, 2, 2]),
        arcsin(r[:, 0, 2]),
        np.arctan2(-r[:, 0, 1], r[:, 0, 0]),
    )


def zyx_body(vehicle: str | Vehicle) -> PIDReading:
    """Z-Y-X, velocity of the body frame: the same as ``PIDExpert``."""
    return PIDReading(vehicle, "zyx", "body")


def zyx_world(vehicle: str | Vehicle) -> PIDReading:
    """Z-Y-X, velocity of the world frame."""
    return PIDReading(vehicle, "zyx", "world")


def zxy_body(vehicle: str | Vehicle) -> PIDReading:
    """Z-X-Y, velocity of the body frame."""
    return PIDReading(vehicle, "zxy", "body")


def zxy_world(vehicle: str | Vehicle) -> PIDReading:
    """Z-X-Y, velocity of the world frame: both as printed."""
    return PIDReading(vehicle, "zxy", "world")


def xyz_body(vehicle: str | Vehicle) -> PIDReading:
    """X-Y-Z, velocity of the body frame."""
    return PIDReading(vehicle, "xyz", "body")


def xyz_world(vehicle: str | Vehicle) -> PIDReading:
    """X-Y-Z, velocity of the world frame."""
    return PIDReading(vehicle, "xyz", "world")


if __name__ == "__main__":
    for reading in (zyx_body, zyx_world, zxy_body, zxy_world, xyz_body, xyz_world):
        flights = fly(reading("itm"), "state_recovery", n_episodes=240, seed=0)
        print(
            f"{reading.__name__}: {flights.survival.mean():.1%} of 240 recoveries survive "
            "(thesis: 29.48%)"
        )
