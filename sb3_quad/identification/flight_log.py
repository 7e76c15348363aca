"""A log of a flight on the time grid of the simulation."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.types import BoolArray, FloatArray
from sb3_quad.envs.simulation.state import QUATERNION, VELOCITY
from sb3_quad.envs.vehicles.layout import ORDERS
from sb3_quad.envs.vehicles.vehicle import GRAVITY, Vehicle
from sb3_quad.identification.series import means_of_steps

MOTION_SIZE = 13
UPWARD = np.array([0.0, 0.0, GRAVITY])


@dataclass(frozen=True, eq=False)
class Log:
    """A flight of n rows, one for each step of the time grid, in SI units."""

    path: Path  #: of its file
    order: str  #: of the motors, a key of ``ORDERS``; empty: that of the vehicle
    kind: str  #: of the commands: thrust (N), rotor_speed (rad/s) or share (0 to 1)
    step: float  #: from row to row, s
    #: (n, 13): position, quaternion, velocity and body rates, as the rows of the state have them
    motion: FloatArray
    #: (n, 3), specific force, body axes, m/s²: the accelerometer's, or what the motion says
    force: FloatArray
    has_motion: bool  #: whether attitude and velocity are known, not the body rates alone
    flying: BoolArray  #: (n,), in the air
    times: FloatArray  #: (n,), of the rows by the vehicle's clock, s
    commands: FloatArray  #: as recorded: time, s, and values, (samples, 5)
    offset: float  #: how far the vehicle's clock was behind that of the motion capture, s
    notes: tuple[str, ...]  #: on rows without numbers

    def mean_commands(self, delay: float = 0.0) -> FloatArray:
        """Return the mean command of each step, (n, 4).

        Each command is held until the next one, and a row's command acts from the row on.

        :param delay: how much later commands act, s.
        """
        return means_of_steps(self.commands, self.times - delay, self.step)

    @cached_property
    def airspeed(self) -> FloatArray:
        """Velocity of the rows in the air, (rows, 3), body axes, m/s."""
        motion = self.motion[self.flying]
        to_body = attitudes(motion).inv()
        velocity: FloatArray = to_body.apply(motion[:, VELOCITY])
        return velocity

    def part(self, rows: slice) -> "Log":
        """Return a log with some rows that count alone."""
        flying = np.zeros_like(self.flying)
        flying[rows] = self.flying[rows]
        return replace(self, flying=flying)


def attitudes(motion: FloatArray) -> Rotation:
    """Return the rotations from body to world of motions, (n, 13)."""
    return Rotation.from_quat(motion[:, QUATERNION], scalar_first=True)


def quaternions(rotations: Rotation) -> FloatArray:
    """Return the quaternions (w, x, y, z) of rotations, (n, 4)."""
    wxyz: FloatArray = rotations.as_quat(canonical=True, scalar_first=True)
    return wxyz


def rotor_columns(log: Log, vehicle: Vehicle) -> list[int]:
    """Return for each rotor of a vehicle the column of a log's commands.

    :raises ConfigError: the rotors form no X, and the log numbers those of one.
    """
    if not log.order:
        return [0, 1, 2, 3]
    centre = np.mean(vehicle.rotor_positions, axis=0)
    places = vehicle.rotor_positions - centre
    wanted = [tuple(place) for place in np.sign(places).tolist()]
    order = ORDERS[log.order]
    arms = np.abs(places)
    if sorted(wanted) != sorted(order) or arms.min() < 0.2 * arms.max():
        raise ConfigError(
            f"{vehicle.name}: logs are of an X with the motors of {log.order}; the rotors of this "
            "vehicle form none; write a plain CSV file, whose motors are those of the vehicle file"
        )
    return [order.index(place) for place in wanted]
