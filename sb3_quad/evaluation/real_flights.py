"""How far a simulated vehicle departs from real flights when it flies the recorded motor commands.

A log is a CSV file with the columns of NanoBench (Ullah and Baca 2026, arXiv 2603.09908), which
docs/vehicles.md lists. It is resampled to the vehicle's control step. Three things are calibrated
from the whole flight: the clock of the vehicle's own columns, by the shift at which gyro and
attitude agree best; how the markers of the motion capture are mounted, so that the mean specific
force lies along z; and the motors against each other, so that the mean commands yield no moment.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.types import BoolArray, FloatArray, StrPath
from sb3_quad.base.validate import LARGEST
from sb3_quad.envs.simulation.batch import QuadcopterBatch
from sb3_quad.envs.simulation.motions import read_table, refuse_falling_times, refuse_gaps
from sb3_quad.envs.simulation.physics import quaternion_product
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.simulation.state import (
    BODY_RATES,
    POSITION,
    QUATERNION,
    VELOCITY,
    rotation_matrices,
)
from sb3_quad.envs.vehicles.layout import find_turn
from sb3_quad.envs.vehicles.vehicle import GRAVITY, Vehicle, first_vehicle
from sb3_quad.evaluation.tables import Table

HORIZONS = (0.1, 0.2, 0.5)  # s
# Time before a window whose commands spin up the rotors, s
WARM_UP = 0.5
# Rows below this height do not count, since the ground changes the thrust, m
LEAST_HEIGHT = 0.3
# Longer gaps between rows are not filled, s
LONGEST_GAP = 0.05
# Below this, m/s or rad/s, velocities and rates are noise
LEAST_MOTION = 0.2
# Products of what is measured and what it should be, by the squares of the larger one
LEAST_AGREEMENT = 0.1
# Clock offsets that are tried, s
OFFSETS = np.arange(-0.1, 0.1005, 0.001)
# Thrust of a motor, N, as coefficients of the powers of its voltage, from the 0th:
# crazyflie-firmware 2025.12, platform_defaults_cf2.h, CONFIG_CRAZYFLIE_21_PLUS. The voltage is PWM
# / 65,535 of the battery's.
THRUST_BY_VOLTAGE = (-0.0247653792, 0.0652379353, -0.0267925050, 0.0067767893)
FULL_PWM = 65_535.0
# Columns of the motion capture, in the order of the state's first rows
CAPTURE_COLUMNS = ["px", "py", "pz", "qw", "qx", "qy", "qz", "vx", "vy", "vz"]
GYRO_COLUMNS = ["imu_gyro_x", "imu_gyro_y", "imu_gyro_z"]
THRUSTS = ["thrust_m1", "thrust_m2", "thrust_m3", "thrust_m4"]
PWM = ["motor_motor_m1", "motor_motor_m2", "motor_motor_m3", "motor_motor_m4"]
BATTERY = "pwr_pm_vbat"
NEEDED = (
    f"a log is a CSV file with the columns t, {', '.join(CAPTURE_COLUMNS + GYRO_COLUMNS)}, "
    f"and thrusts in N ({', '.join(THRUSTS)}) or {', '.join(PWM)}, {BATTERY}"
)
QUANTITIES = ("position, m", "velocity, m/s", "attitude, °", "body rates, rad/s")
HEADINGS = ("root mean square of the error", "simulated", "nothing changes", "velocity, rates stay")


@dataclass(frozen=True, eq=False)
class Log:
    """A flight of n rows, one for each control step, in SI units."""

    path: Path  #: of its file
    #: (n, 13): position, quaternion, velocity and body rates, as the rows of the state have them
    motion: FloatArray
    thrusts: FloatArray  #: (n, 4), commanded, M1 to M4, N
    flying: BoolArray  #: (n,), in the air
    offset: float  #: how far the vehicle's clock was behind that of the motion capture, s


def read_logs(folder: StrPath, step: float) -> list[Log]:
    """Read the logs of a folder, with rows ``step`` s apart.

    :raises ConfigError: no CSV file there, or one that cannot be read or lacks columns, or whose
        times do not rise.
    """
    paths = sorted(Path(folder).glob("*.csv"))
    if not paths:
        raise ConfigError(f"{folder}: no CSV file there; {NEEDED}")
    return [read_log(path, step) for path in paths]


def read_log(path: Path, step: float) -> Log:
    """Read one log, see :func:`read_logs`."""
    measured = ["t", *CAPTURE_COLUMNS, *GYRO_COLUMNS]
    table = read_table(path)
    commands = THRUSTS if THRUSTS[0] in table else [*PWM, BATTERY]
    missing = {*measured, *commands} - {*table}
    if missing:
        raise ConfigError(f"{path}: lacks {', '.join(sorted(missing))}; {NEEDED}")
    if len(table) < 2:
        raise ConfigError(f"{path}: fewer than two rows")
    # Commands may be missing; such rows do not count.
    refuse_gaps(path, table[measured])
    time = table["t"]
    refuse_falling_times(path, time)
    _refuse_unlikely(path, table[measured])
    if commands is not THRUSTS:
        table[THRUSTS] = motor_thrusts(table[PWM].to_numpy(), table[[BATTERY]].to_numpy())
    numbers = table[[*measured[1:], *THRUSTS]]
    for row, column in np.argwhere(numbers.abs().to_numpy() > LARGEST):
        raise ConfigError(f"{path}: row {row + 1}: {numbers.columns[column]} is too large")
    # q and -q are the same attitude, but interpolation between them would pass through others.
    quaternions = table[CAPTURE_COLUMNS[QUATERNION]]
    cosines = (quaternions * quaternions.shift()).sum(axis=1)
    signs = np.where(cosines < 0.0, -1.0, 1.0).cumprod()
    table[CAPTURE_COLUMNS[QUATERNION]] = quaternions.mul(signs, axis=0)
    grid = np.arange(time.iloc[0], time.iloc[-1], step)
    if len(grid) * step < WARM_UP + HORIZONS[-1]:
        raise ConfigError(f"{path}: is shorter than {WARM_UP + HORIZONS[-1]:g} s")

    def resampled(names: list[str], behind: float = 0.0) -> FloatArray:
        return np.stack([np.interp(grid + behind, time, table[name]) for name in names], axis=1)

    motion = resampled(CAPTURE_COLUMNS + GYRO_COLUMNS)
    attitude = motion[:, QUATERNION]
    attitude /= np.linalg.norm(attitude, axis=1, keepdims=True)
    flying = motion[:, 2] > LEAST_HEIGHT
    # Gaps from each row to the next; the last one has none.
    gaps = np.diff(time, append=time.iloc[-1])
    flying &= gaps[np.searchsorted(time, grid, side="right") - 1] < LONGEST_GAP
    # Some logs are extrapolated after the radio was lost.
    flying &= np.isfinite(resampled(THRUSTS)).all(axis=1)
    # Three elements of Rᵀ dR/dt are the body rates.
    rotation = rotation_matrices(attitude)
    turning = np.einsum("nji,njk->nik", rotation, np.gradient(rotation, step, axis=0))
    rates = turning[flying][:, [2, 0, 1], [1, 2, 0]]

    def disagreement(behind: float) -> float:
        gap = rates - resampled(GYRO_COLUMNS, behind)[flying]
        return float(np.square(gap).sum())

    offset = float(min(OFFSETS, key=disagreement))
    motion[:, BODY_RATES] = resampled(GYRO_COLUMNS, offset)
    _refuse_unlike(path, GYRO_COLUMNS, motion[flying, BODY_RATES], rates)
    speeds = np.gradient(motion[:, POSITION], step, axis=0)[flying]
    names = CAPTURE_COLUMNS[VELOCITY]
    _refuse_unlike(path, names, motion[flying, VELOCITY], speeds)

    thrusts = resampled(THRUSTS, offset)
    flying &= np.isfinite(thrusts).all(axis=1)
    if flying.any():
        force = np.gradient(motion[:, VELOCITY], step, axis=0)
        force[:, 2] += GRAVITY
        x, y, z = np.einsum("nji,nj->ni", rotation, force)[flying].mean(axis=0)
        motion[:, QUATERNION] = rotated_by(attitude, np.array([[-y / z, x / z, 0.0]]))
        mean = thrusts[flying].mean(axis=0)
        if mean.min() <= 0.0:
            raise ConfigError(f"{path}: motor M{mean.argmin() + 1} pushes with {mean.min():.3g} N")
        thrusts *= mean.mean() / mean
    return Log(path, motion, thrusts, flying, offset)


def _refuse_unlikely(path: Path, table: pd.DataFrame) -> None:
    """Refuse a log whose times or attitudes cannot be those of a flight in SI units.

    :raises ConfigError: the message names the column.
    """
    apart = np.ptp(table["t"]) / len(table)
    if apart > LONGEST_GAP:
        raise ConfigError(
            f"{path}: rows are {apart:.3g} s apart on average, where {LONGEST_GAP:g} s is the "
            "longest gap; is t in s?"
        )
    norms = np.linalg.norm(table[CAPTURE_COLUMNS[QUATERNION]], axis=1)
    worst = np.abs(norms - 1.0).argmax()
    if not 0.9 < norms[worst] < 1.1:
        raise ConfigError(f"{path}: row {worst + 1}: qw, qx, qy, qz have length {norms[worst]:.3g}")


def _refuse_unlike(path: Path, names: list[str], measured: FloatArray, other: FloatArray) -> None:
    """Refuse columns (n, 3) that have another unit, sign or axis than what others say.

    :raises ConfigError: the message names the column.
    """
    for name, own, expected in zip(names, measured.T, other.T, strict=True):
        larger = max(own @ own, expected @ expected)
        # What follows from an attitude is noisy.
        if own @ expected < LEAST_AGREEMENT * larger and larger > len(own) * LEAST_MOTION**2:
            raise ConfigError(
                f"{path}: {name} contradicts the motion; check units, axes and the order of columns"
            )


def motor_thrusts(pwm: FloatArray, battery: FloatArray) -> FloatArray:
    """Return the thrusts, N, that the Crazyflie's firmware expects from its commands.

    :param pwm: (n, 4), 0 to 65,535; other values and motors at rest become NaN.
    :param battery: (n, 1), V.
    """
    thrusts = np.polynomial.Polynomial(THRUST_BY_VOLTAGE)(pwm / FULL_PWM * battery)
    return np.where((pwm > 0.0) & (pwm <= FULL_PWM), thrusts, np.nan)


def rotated_by(quaternion: FloatArray, rotation: FloatArray) -> FloatArray:
    """Return attitudes, (n, 4), after rotations in body axes, (n, 3), rad."""
    half = 0.5 * np.linalg.norm(rotation, axis=1)
    axis = 0.5 * np.sinc(half / np.pi) * rotation.T
    return np.stack(quaternion_product.py_func(quaternion.T, (np.cos(half), *axis)), axis=1)


def open_loop(
    logs: Sequence[Log],
    vehicle: Vehicle,
    stride: int = 1,
) -> Iterator[tuple[float, list[FloatArray], FloatArray]]:
    """Fly recorded commands from recorded states.

    Each row from which a log flies on for long enough begins a window. Its rotors begin with the
    speeds that the commands of the preceding ``WARM_UP`` lead to.

    :param logs: logs with rows at the vehicle's control step.
    :param stride: rows from one window to the next.
    :return: for each horizon: its time, s; the predictions in the order of ``HEADINGS``; and the
        recorded motion, each (windows, 13) as in ``Log.motion``.
    :raises ConfigError: no log flies for long enough, or the rotors are not placed as M1 to M4.
    """
    crazyflie = first_vehicle("crazyflie")
    # A log is in the axes of its vehicle, which cannot be turned.
    if find_turn(vehicle, crazyflie).angle != 0.0:
        raise ConfigError(
            f"{vehicle.name}: logs are of an X whose rotors turn as those of the Crazyflie do,"
            " front right anticlockwise; this vehicle's rotors turn the other way or form a plus"
        )
    vehicle = vehicle.in_layout_of(crazyflie)
    step = vehicle.control_step
    before = round(WARM_UP / step)
    ends = [round(horizon / step) for horizon in HORIZONS]
    length = before + ends[-1]
    # A window is valid only if all of its rows fly.
    flights = [pd.Series(log.flying).rolling(length).sum().shift(-ends[-1]) for log in logs]
    rows = np.flatnonzero(np.concatenate(flights) == length)[::stride]
    if rows.size == 0:
        raise ConfigError(
            f"no log flies above {LEAST_HEIGHT:g} m for {WARM_UP + HORIZONS[-1]:g} s with commands "
            "for all motors; does pz point up?"
        )
    record = np.concatenate([log.motion for log in logs])
    thrusts = np.concatenate([log.thrusts for log in logs])
    actions = vehicle.thrust_to_action(np.nan_to_num(thrusts))
    start = record[rows]
    rows -= before

    settings = FlightSettings(vehicle=vehicle, noise=0.0)
    batch = QuadcopterBatch(rows.size, settings, seed=0, autoreset=False)
    batch.reset()
    motion = batch.state[: start.shape[1]]
    for now in range(-before, ends[-1]):
        if now == 0:
            motion[:] = start.T
        batch.step(actions[rows])
        rows += 1
        if now + 1 in ends:
            time = (now + 1) * step
            extrapolated = start.copy()
            extrapolated[:, POSITION] += start[:, VELOCITY] * time
            extrapolated[:, QUATERNION] = rotated_by(
                start[:, QUATERNION], start[:, BODY_RATES] * time
            )
            yield time, [motion.T.copy(), start, extrapolated], record[rows]


def errors(prediction: FloatArray, end: FloatArray) -> FloatArray:
    """Return the root mean squares of the errors, in the order of ``QUANTITIES``, (4,)."""
    gap = prediction - end
    cosine = np.abs((prediction * end)[:, QUATERNION].sum(axis=1))
    position, velocity, rates = (
        np.linalg.norm(gap[:, part], axis=1) for part in (POSITION, VELOCITY, BODY_RATES)
    )
    angle = np.degrees(2.0 * np.arccos(np.minimum(cosine, 1.0)))
    return np.asarray(np.sqrt(np.square([position, velocity, angle, rates]).mean(axis=1)))


def error_table(logs: Sequence[Log], vehicle: Vehicle) -> Table:
    """Return the errors of a vehicle in open loop, over all windows of all logs."""
    rows = []
    for time, predictions, end in open_loop(logs, vehicle):
        values = [errors(prediction, end) for prediction in predictions]
        for number, quantity in enumerate(QUANTITIES):
            texts = [f"{value[number]:.3g}" for value in values]
            rows.append([f"{quantity}, after {time:g} s", *texts])
    title = f"{vehicle.name}: {len(end)} windows of {len(logs)} logs, open loop"
    thrusts = np.concatenate([log.thrusts[log.flying] for log in logs])
    clipped = (np.abs(vehicle.thrust_to_action(thrusts)) > 1.0).mean()
    caption = f"{clipped:.1%} of the commands are beyond the rotors' limits, and clipped"
    return Table(HEADINGS, rows, title, caption)
