"""Recorded commands flown again from recorded states, and how far that is off."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.types import FloatArray
from sb3_quad.envs.simulation.batch import QuadcopterBatch
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.simulation.state import BODY_RATES, POSITION, QUATERNION, ROTOR_SPEEDS, VELOCITY
from sb3_quad.envs.vehicles.vehicle import Vehicle
from sb3_quad.evaluation.tables import Table
from sb3_quad.identification.curve import Curve, fit_curve, lagged
from sb3_quad.identification.flight_log import (
    MOTION_SIZE,
    Log,
    attitudes,
    quaternions,
    rotor_columns,
)

HORIZONS = (0.1, 0.2, 0.5)  # s
# Time before a window whose commands spin up the rotors, s
WARM_UP = 0.25
QUANTITIES = ("position, m", "velocity, m/s", "attitude, °", "body rates, rad/s")
ATTITUDE = 2


class Windows:
    """Pieces of logs that begin in recorded states.

    :param logs: with rows at the vehicle's control step.
    :param ends: control steps from the begin of a window to where it is compared, rising.
    :param stride: rows from one window to the next.
    :raises ConfigError: no log flies for long enough.
    """

    def __init__(
        self, logs: Sequence[Log], vehicle: Vehicle, ends: Sequence[int], stride: int = 1
    ) -> None:
        self.ends = ends
        before = round(WARM_UP / vehicle.control_step) + vehicle.delay
        length = before + ends[-1] + 1
        # A window is valid only if all of its rows fly, and are of one log.
        flying = np.concatenate([np.append(log.flying[:-1], False) for log in logs])
        whole = np.convolve(flying, np.ones(length), "valid") > length - 0.5
        self.rows = before + np.flatnonzero(whole)[::stride]
        if self.rows.size == 0:
            seconds = length * vehicle.control_step
            raise ConfigError(f"no log flies for {seconds:.3g} s without a gap")
        self.record = np.concatenate([log.motion for log in logs])
        if not logs[0].has_motion:
            # Where gravity is unknown, it must not matter how high a vehicle flies.
            self.record[:, 2] = 100.0
        self.start = self.record[self.rows]
        # The compiled step leaves out the air's moments, unless a vehicle has some.
        in_air = vehicle.model_copy(update={"rate_damping": [1e-12] * 3})
        settings = FlightSettings(vehicle=in_air, noise=0.0)
        self.batch = QuadcopterBatch(self.rows.size, settings, seed=0, autoreset=False)

    def fly(self, vehicle: Vehicle, thrusts: FloatArray) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Fly all windows.

        :param vehicle: with the control step and delay of the one that the windows were made for.
        :param thrusts: of all rows of all logs, in the vehicle's order, (n, 4), N.
        :return: after each of ``ends`` the motion, (windows, 13), and the specific force, body
            axes, m/s², (windows, 3).
        """
        batch = self.batch
        batch.vehicles[:] = vehicle.parameters()[:, None]
        batch.reset()
        actions = vehicle.thrust_to_action(thrusts)
        speeds = rotor_speeds(vehicle, thrusts, vehicle.control_step)
        # Commands that still wait are given first.
        for now in range(-vehicle.delay, self.ends[-1]):
            if now == 0:
                before = self.rows - vehicle.delay - 1
                batch.state[ROTOR_SPEEDS] = speeds[before].T
                batch.state[:MOTION_SIZE] = self.start.T
            batch.step(actions[self.rows + now])
            if now + 1 in self.ends:
                state = batch.true_state()
                motion = state.array[:MOTION_SIZE]
                yield motion.T.copy(), state.specific_force


def rotor_speeds(vehicle: Vehicle, thrusts: FloatArray, step: float) -> FloatArray:
    """Return the rotor speeds that commanded thrusts, (n, 4), N, lead to, (n, 4), rad/s."""
    held = np.sqrt(np.clip(thrusts, *vehicle.thrust_range) / vehicle.lift)
    gain = 0.5 * (vehicle.motor_gain_up + vehicle.motor_gain_down)
    return lagged(held, gain, step)


def log_thrusts(
    logs: Sequence[Log], vehicle: Vehicle, curve: Curve, delay: float = 0.0
) -> FloatArray:
    """Return the commanded thrusts of all logs in the order of a vehicle's rotors, (n, 4), N.

    The motors of each log are calibrated against each other, so that the mean moment of the rotors
    balances that of the air.
    """
    scaled = []
    arms = np.vstack([np.ones(4), vehicle.rotor_arms])
    for log in logs:
        commands = log.mean_commands(delay)[:, rotor_columns(log, vehicle)]
        thrusts = curve.thrust(commands)
        # Rotors that lag push with less than the mean of commands that change quickly.
        speeds = rotor_speeds(vehicle, thrusts, log.step)[log.flying]
        mean = vehicle.lift * np.square(speeds).mean(axis=0)
        x, y, _ = speeds.sum(axis=1) @ log.airspeed / len(speeds)
        roll, pitch = vehicle.airspeed_moment
        wrench = [mean.sum(), -roll * y, pitch * x, 0.0]
        wanted = np.linalg.solve(arms, wrench)
        scaled.append(thrusts * wanted / mean)
    return np.concatenate(scaled)


def gaps(motion: FloatArray, record: FloatArray) -> list[FloatArray]:
    """Return how far predictions (n, 13) are off what was recorded, (n, 3) each, in the order and
    units of ``QUANTITIES`` but rad: attitudes as rotation vectors in recorded body axes.
    """
    turned = attitudes(record).inv() * attitudes(motion)
    gap = motion - record
    position = gap[:, POSITION]
    velocity = gap[:, VELOCITY]
    rates = gap[:, BODY_RATES]
    return [position, velocity, turned.as_rotvec(), rates]


def open_loop(logs: Sequence[Log], vehicle: Vehicle, curve: Curve) -> FloatArray:
    """Fly recorded commands from recorded states.

    Each row from which a log flies on for long enough begins a window. Its rotors begin with the
    speeds that the commands of the preceding ``WARM_UP`` lead to.

    :param logs: logs with rows at the vehicle's control step.
    :param curve: thrust of a motor over its command.
    :return: root mean squares of the errors, (horizons, 2, quantities), of the vehicle and of one
        whose velocity and body rates stay, in the order of ``HORIZONS`` and ``QUANTITIES``.
    :raises ConfigError: no log flies for long enough, or the rotors are not placed as those of the
        log.
    """
    ends = [round(horizon / vehicle.control_step) for horizon in HORIZONS]
    windows = Windows(logs, vehicle, ends)
    start = windows.start
    stays = start.copy()
    thrusts = log_thrusts(logs, vehicle, curve)
    # They are calibrated already.
    vehicle = vehicle.model_copy(update={"thrust_factors": [1.0] * 4})
    errors = []
    for end, (flown, _) in zip(ends, windows.fly(vehicle, thrusts), strict=True):
        time = end * vehicle.control_step
        way = start[:, VELOCITY] * time
        stays[:, POSITION] = start[:, POSITION] + way
        turn = Rotation.from_rotvec(start[:, BODY_RATES] * time)
        stays[:, QUATERNION] = quaternions(attitudes(start) * turn)
        record = windows.record[windows.rows + end]
        errors.append([gaps(flown, record), gaps(stays, record)])
    squares = np.square(errors).sum(axis=4)
    typical: FloatArray = np.sqrt(squares.mean(axis=3))
    typical[..., ATTITUDE] *= 180.0 / np.pi
    return typical


def error_table(logs: Sequence[Log], vehicles: Mapping[str, tuple[Vehicle, Curve | None]]) -> Table:
    """Return the errors of vehicles in open loop, over all windows of all logs.

    :param vehicles: by the heading of their column, with the thrust of a motor over its command, or
        None: fitted to these logs.
    """
    columns = []
    for vehicle, curve in vehicles.values():
        known = curve or fit_curve(logs, vehicle)
        predicted, stays = np.moveaxis(open_loop(logs, vehicle, known), 1, 0)
        columns.append(predicted)
    errors = np.stack([*columns, stays], axis=-1)
    rows = []
    # Without motion, body rates are all that is known.
    first = 0 if logs[0].has_motion else len(QUANTITIES) - 1
    for number, quantity in enumerate(QUANTITIES[first:], first):
        for horizon, values in zip(HORIZONS, errors[:, number], strict=True):
            cells = [f"{value:.3g}" for value in values]
            rows.append([f"{quantity}, after {horizon:g} s", *cells])
    return Table(
        ("root mean square of the error", *vehicles, "velocity, rates stay"),
        rows,
        f"{len(logs)} logs, open loop",
    )
