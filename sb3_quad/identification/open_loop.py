"""Recorded commands flown again from recorded states, and how far that is off."""

from collections.abc import Iterator, Sequence

import numpy as np

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.types import FloatArray, IntArray
from sb3_quad.envs.simulation.batch import QuadcopterBatch
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.simulation.state import (
    BODY_RATES,
    POSITION,
    QUATERNION,
    ROTOR_SPEEDS,
    VELOCITY,
    rotation_matrices,
)
from sb3_quad.envs.vehicles.vehicle import Vehicle
from sb3_quad.evaluation.tables import Table
from sb3_quad.identification.curve import Curve, fit_curve
from sb3_quad.identification.flight_log import MOTION_SIZE, Log, rotated_by, rotor_columns

HORIZONS = (0.1, 0.2, 0.5)  # s
# Time before a window whose commands spin up the rotors, s
WARM_UP = 0.5
QUANTITIES = ("position, m", "velocity, m/s", "attitude, °", "body rates, rad/s")
HEADINGS = ("root mean square of the error", "simulated", "nothing changes", "velocity, rates stay")


class Windows:
    """Pieces of logs that begin in recorded states.

    :param logs: with rows at the vehicle's control step.
    :param ends: control steps from the begin of a window to where it is compared, rising.
    :param stride: rows from one window to the next.
    :param warm_up: time before each window whose commands spin up the rotors, s.
    :raises ConfigError: no log flies for long enough.
    """

    def __init__(
        self,
        logs: Sequence[Log],
        vehicle: Vehicle,
        ends: Sequence[int],
        stride: int = 1,
        warm_up: float = WARM_UP,
    ) -> None:
        self.ends = ends
        self.before = round(warm_up / vehicle.control_step)
        length = self.before + ends[-1] + 1
        starts: list[IntArray] = []
        first = 0
        for log in logs:
            # A window is valid only if all of its rows fly.
            flying = np.concatenate([[0], np.cumsum(log.flying)])
            whole = np.flatnonzero(flying[length:] - flying[:-length] == length)
            starts.append(first + self.before + whole[::stride])
            first += len(log.flying)
        self.rows = np.concatenate(starts).astype(np.int64)
        #: (windows,), the log of each
        self.log = np.repeat(np.arange(len(logs)), [len(one) for one in starts])
        if self.rows.size == 0:
            seconds = length * vehicle.control_step
            raise ConfigError(f"no log flies for {seconds:.3g} s without a gap")
        self.record = np.concatenate([log.motion for log in logs])
        if not all(log.has_motion for log in logs):
            # Where gravity is unknown, it must not matter how high a vehicle flies.
            self.record[:, 2] = 100.0
        self.start = self.record[self.rows]
        # The compiled step leaves out the air's moments, unless a vehicle has some.
        in_air = vehicle.model_copy(update={"rate_damping": [1e-12] * 3})
        settings = FlightSettings(vehicle=in_air, noise=0.0)
        self.batch = QuadcopterBatch(self.rows.size, settings, seed=0, autoreset=False)

    def fly(self, vehicle: Vehicle, thrusts: FloatArray) -> Iterator[FloatArray]:
        """Fly all windows.

        :param vehicle: with the control step and delay of the one that the windows were made for.
        :param thrusts: of all rows of all logs, in the vehicle's order, (n, 4), N.
        :return: after each of ``ends`` the motion, (windows, 13), and the specific force along z,
            m/s², as the last column.
        """
        batch = self.batch
        batch.vehicles[:] = vehicle.parameters()[:, None]
        batch.reset()
        actions = vehicle.thrust_to_action(np.nan_to_num(thrusts))
        rows = self.rows - self.before
        held = np.clip(np.nan_to_num(thrusts[rows]), *vehicle.thrust_range)
        batch.state[ROTOR_SPEEDS] = np.sqrt(held / vehicle.lift).T
        motion = batch.state[:MOTION_SIZE]
        for now in range(-self.before, self.ends[-1]):
            if now == 0:
                motion[:] = self.start.T
            batch.step(actions[rows])
            rows += 1
            if now + 1 in self.ends:
                force = batch.true_state().specific_force[:, 2:]
                yield np.hstack([motion.T, force])


def log_thrusts(
    logs: Sequence[Log], vehicle: Vehicle, curve: Curve, delay: float = 0.0
) -> FloatArray:
    """Return the commanded thrusts of all logs in the order of a vehicle's rotors, (n, 4), N.

    The motors of each log are calibrated against each other, so that the mean moment of the
    commands balances that of the air.
    """
    found = []
    still = vehicle.model_copy(update={"thrust_factors": [1.0] * 4})
    for log in logs:
        thrusts = curve.thrust(log.mean_commands(delay))[:, rotor_columns(log, vehicle)]
        mean = thrusts[log.flying].mean(axis=0)
        x, y, _ = log.mean_velocity * 4.0 * vehicle.hover_rotor_speed
        roll, pitch = vehicle.airspeed_moment
        wanted = still.mixer_inverse @ [mean.sum(), -roll * y, pitch * x, 0.0]
        found.append(thrusts * wanted / mean)
    return np.concatenate(found)


def open_loop(
    logs: Sequence[Log], vehicle: Vehicle, curve: Curve | None = None, stride: int = 1
) -> Iterator[tuple[float, list[FloatArray], FloatArray]]:
    """Fly recorded commands from recorded states.

    Each row from which a log flies on for long enough begins a window. Its rotors begin with the
    speeds that the commands of the preceding ``WARM_UP`` lead to.

    :param logs: logs with rows at the vehicle's control step.
    :param curve: thrust of a motor over its command; None: fitted to these logs.
    :param stride: rows from one window to the next.
    :return: for each horizon: its time, s; the predictions in the order of ``HEADINGS``; and the
        recorded motion, each (windows, 13) as in ``Log.motion``.
    :raises ConfigError: no log flies for long enough, or the rotors are not placed as those of the
        log.
    """
    step = vehicle.control_step
    curve = curve or fit_curve(logs, vehicle)
    ends = [round(horizon / step) for horizon in HORIZONS]
    windows = Windows(logs, vehicle, ends, stride)
    start = windows.start
    thrusts = log_thrusts(logs, vehicle, curve)
    # They are calibrated already.
    vehicle = vehicle.model_copy(update={"thrust_factors": [1.0] * 4})
    for end, flown in zip(ends, windows.fly(vehicle, thrusts), strict=True):
        time = end * step
        stays = start.copy()
        stays[:, POSITION] += start[:, VELOCITY] * time
        stays[:, QUATERNION] = rotated_by(start[:, QUATERNION], start[:, BODY_RATES] * time)
        yield time, [flown[:, :MOTION_SIZE], start, stays], windows.record[windows.rows + end]


def errors(prediction: FloatArray, end: FloatArray) -> FloatArray:
    """Return the root mean squares of the errors, in the order of ``QUANTITIES``, (4,)."""
    gap = prediction - end
    angle = np.degrees(np.linalg.norm(turned(prediction, end), axis=1))
    position, velocity, rates = (
        np.linalg.norm(gap[:, part], axis=1) for part in (POSITION, VELOCITY, BODY_RATES)
    )
    return np.asarray(np.sqrt(np.square([position, velocity, angle, rates]).mean(axis=1)))


def turned(prediction: FloatArray, end: FloatArray) -> FloatArray:
    """Return the rotation vectors from recorded attitudes to predicted ones, (n, 3), rad, recorded
    body axes.
    """
    matrices = [rotation_matrices(motion[:, QUATERNION]) for motion in (end, prediction)]
    between = np.einsum("nji,njk->nik", *matrices)
    skew = 0.5 * (between - between.transpose(0, 2, 1))[:, [2, 0, 1], [1, 2, 0]]
    sine = np.linalg.norm(skew, axis=1)
    cosine = 0.5 * (np.trace(between, axis1=1, axis2=2) - 1.0)
    angle = np.arctan2(sine, cosine)
    return np.asarray(skew * (angle / np.maximum(sine, 1e-12))[:, None])


def error_table(logs: Sequence[Log], vehicle: Vehicle, curve: Curve | None = None) -> Table:
    """Return the errors of a vehicle in open loop, over all windows of all logs."""
    curve = curve or fit_curve(logs, vehicle)
    rows = []
    # Without motion, body rates are all that is known.
    known = 0 if all(log.has_motion for log in logs) else len(QUANTITIES) - 1
    for time, predictions, end in open_loop(logs, vehicle, curve):
        values = [errors(prediction, end) for prediction in predictions]
        for number, quantity in enumerate(QUANTITIES[known:], known):
            texts = [f"{value[number]:.3g}" for value in values]
            rows.append([f"{quantity}, after {time:g} s", *texts])
    title = f"{vehicle.name}: {len(end)} windows of {len(logs)} logs, open loop"
    thrusts = log_thrusts(logs, vehicle, curve)
    flying = np.concatenate([log.flying for log in logs])
    clipped = (np.abs(vehicle.thrust_to_action(thrusts[flying])) > 1.0).mean()
    caption = f"{clipped:.1%} of the commands are beyond the rotors' limits, and clipped"
    return Table(HEADINGS, rows, title, caption)
