"""A log of a flight on the time grid of the simulation, calibrated by what it says itself.

From the whole flight follow: the clock of the vehicle's own sensors, by the shift at which gyro and
attitude agree best; and how the markers of a motion capture are mounted, so that the mean specific
force lies along z.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.types import BoolArray, FloatArray, StrPath
from sb3_quad.base.validate import LARGEST
from sb3_quad.envs.simulation.physics import quaternion_product
from sb3_quad.envs.simulation.state import (
    BODY_RATES,
    POSITION,
    QUATERNION,
    VELOCITY,
    rotation_matrices,
)
from sb3_quad.envs.vehicles.layout import ORDERS
from sb3_quad.envs.vehicles.vehicle import GRAVITY, Vehicle
from sb3_quad.identification.formats import COMMANDS, PWM
from sb3_quad.identification.readers import WAY_OUT, Recording, Series, read_recording

# Rows below this height do not count, since the ground changes the thrust, m
LEAST_HEIGHT = 0.3
# Where the height is unknown, a vehicle flies while its motors get this share of their command in
# the middle of the flight, and not within this time of a start or landing, s.
FLYING_SHARE = 0.6
NEAR_GROUND = 0.5
# Longer gaps between rows are not filled, s
LONGEST_GAP = 0.05
# Below this, m/s or rad/s, velocities and rates are noise
LEAST_MOTION = 0.2
# Products of what is measured and what it should be, by the squares of the larger one
LEAST_AGREEMENT = 0.1
WORTH_A_SHIFT = 0.998
AVERAGED = 0.1  # s
# Clock offsets that are tried, s
OFFSETS = np.arange(-0.1, 0.1005, 0.001)
# The least that a log needs: rotors that spin up, and the longest horizon, s
LEAST_DURATION = 1.0
MOTION_SIZE = 13
# Thrust of a motor, N, as coefficients of the powers of its voltage, from the 0th:
# crazyflie-firmware 2025.12, platform_defaults_cf2.h, CONFIG_CRAZYFLIE_21_PLUS. The voltage is PWM
# / 65,535 of the battery's.
THRUST_BY_VOLTAGE = (-0.0247653792, 0.0652379353, -0.0267925050, 0.0067767893)


@dataclass(frozen=True, eq=False)
class Log:
    """A flight of n rows, one for each step of the time grid, in SI units."""

    path: Path  #: of its file
    order: str  #: of the motors, a key of ``ORDERS``; empty: that of the vehicle
    kind: str  #: of the commands: thrust (N), rotor_speed (rad/s) or share (0 to 1)
    step: float  #: from row to row, s
    begin: float  #: time of the first row, s
    commands: Series  #: as recorded
    #: (n, 13): position, quaternion, velocity and body rates, as the rows of the state have them
    motion: FloatArray
    force: FloatArray | None  #: (n,), specific force along z, m/s²
    has_motion: bool  #: whether attitude and velocity are known, not the body rates alone
    flying: BoolArray  #: (n,), in the air
    offset: float  #: how far the vehicle's clock was behind that of the motion capture, s
    notes: tuple[str, ...] = ()  #: on rows without numbers

    def mean_commands(self, delay: float = 0.0) -> FloatArray:
        """Return the mean command of each step, (n, 4), NaN where one is missing.

        A row's command acts from the row on.

        :param delay: how much later commands act, s.
        """
        rows = np.arange(len(self.flying) + 1, dtype=np.float64)
        edges = self.begin + self.offset - delay + self.step * rows
        return _held_means(self.commands, edges)

    @cached_property
    def mean_velocity(self) -> FloatArray:
        """Mean velocity in the air, (3,), body axes, m/s."""
        motion = self.motion[self.flying]
        rotation = rotation_matrices(motion[:, QUATERNION])
        return np.asarray(np.einsum("nji,nj->i", rotation, motion[:, VELOCITY]) / len(motion))

    def part(self, rows: slice) -> "Log":
        """Return a log with some rows that count alone."""
        flying = np.zeros_like(self.flying)
        flying[rows] = self.flying[rows]
        return replace(self, flying=flying)


def rotor_columns(log: Log, vehicle: Vehicle) -> list[int]:
    """Return for each rotor of a vehicle the column of a log's commands.

    :raises ConfigError: the rotors form no X, and the log numbers those of one.
    """
    if not log.order:
        return [0, 1, 2, 3]
    middle = np.mean(vehicle.rotor_positions, axis=0)
    places = np.array(vehicle.rotor_positions) - middle
    signs = [tuple(place) for place in np.sign(places).astype(int).tolist()]
    columns = [ORDERS[log.order].index(sign) for sign in signs if sign in ORDERS[log.order]]
    arms = np.abs(places)
    if sorted(columns) != [0, 1, 2, 3] or arms.min() < 0.2 * arms.max():
        raise ConfigError(
            f"{vehicle.name}: logs are of an X with the motors of {log.order}; the rotors of this "
            "vehicle form none; write a plain CSV file, whose motors are those of the vehicle file"
        )
    return columns


def read_logs(paths: Iterable[StrPath] | StrPath, step: float | None = None) -> list[Log]:
    """Read logs.

    :param paths: files; of a folder, all files but YAML in it.
    :param step: from row to row, s; None: 0.01, or 0.005 if all are sampled faster than 150 Hz.
    :return: those that fly at all.
    :raises ConfigError: no log there that flies, or one that cannot be read, lacks what it needs,
        or contradicts itself.
    """
    files: list[Path] = []
    for path in [paths] if isinstance(paths, (str, Path)) else paths:
        folder = Path(path)
        if folder.is_dir():
            found = [file for file in sorted(folder.iterdir()) if file.is_file()]
            files += [file for file in found if file.suffix not in (".yaml", ".yml", ".md")]
        else:
            files.append(folder)
    if not files:
        raise ConfigError(f"{paths}: no logs there; {WAY_OUT}")
    recordings = [read_recording(file) for file in files]
    if step is None:
        sampled = [np.median(np.diff(record.series["gyro"][0])) for record in recordings]
        step = 0.005 if max(sampled) < 1.0 / 150.0 else 0.01
    logs = [on_grid(recording, step) for recording in recordings]
    airborne = [log for log in logs if log.flying.any()]
    if not airborne:
        raise ConfigError(
            f"{files[0]}: no log flies for {LEAST_DURATION:g} s above {LEAST_HEIGHT:g} m with "
            "commands for all motors; does z point up, and is it in the air?"
        )
    return airborne


def on_grid(recording: Recording, step: float) -> Log:
    """Return a log with rows ``step`` s apart, see :func:`read_logs`."""
    path = recording.path
    notes: list[str] = []
    series = {}
    for name, one in recording.series.items():
        series[name] = _cleaned(path, name, one, notes)
    kind = next(name for name in COMMANDS if name in series)
    commands = series.pop(kind)
    if kind == "pwm_battery":
        kind = "thrust"
        commands = commands[0], motor_thrusts(commands[1][:, :4], commands[1][:, 4:])
    has_motion = {"attitude", "velocity"} <= series.keys()
    if not has_motion and "accelerometer" not in series:
        raise ConfigError(f"{path}: lacks an accelerometer; {WAY_OUT}")
    known = [name for name in series if has_motion or name in ("gyro", "accelerometer")]
    begin = max(series[name][0][0] for name in known)
    end = min(series[name][0][-1] for name in known)
    grid = np.arange(begin, end, step)
    if len(grid) * step < LEAST_DURATION:
        raise ConfigError(f"{path}: is shorter than {LEAST_DURATION:g} s, or cut")

    motion = np.zeros((len(grid), MOTION_SIZE))
    motion[:, POSITION.stop] = 1.0
    offset = 0.0
    # Some logs are extrapolated after the radio was lost.
    means = _held_means(commands, np.append(grid, grid[-1] + step))
    flying: BoolArray = np.asarray(np.isfinite(means).all(axis=1))
    if has_motion:
        offset = _fill_motion(path, series, grid, motion, flying)
    motion[:, BODY_RATES] = _resampled(series["gyro"], grid + offset, step)
    force = None
    if "accelerometer" in series:
        force = _resampled(series["accelerometer"], grid + offset, step)[:, 2]
    for name in known:
        flying &= _without_gaps(
            series[name][0], grid + offset * (name in ("gyro", "accelerometer"))
        )
    log = Log(
        path,
        recording.format.order,
        kind,
        step,
        begin,
        commands,
        motion,
        force,
        has_motion,
        flying,
        offset,
        tuple(notes),
    )
    return _in_the_air(log, "position" in series)


def _cleaned(path: Path, name: str, one: Series, notes: list[str]) -> Series:
    """Return a series without rows that are not finite.

    :raises ConfigError: hardly a row is left, times fall or are no seconds, numbers are too large.
    """
    time, values = one
    good = np.isfinite(time) & np.isfinite(values).all(axis=1)
    # Missing commands of some logs say that the radio was lost.
    if good.sum() < max(2, 0.5 * len(time)):
        raise ConfigError(f"{path}: {name}: {good.sum()} of {len(time)} rows hold numbers")
    if not good.all():
        notes.append(
            f"{name}: {(~good).sum()} of {len(time)} rows hold no number, and are left out"
        )
    time = time[good]
    values = values[good]
    falling = np.flatnonzero(np.diff(time) < 0.0)
    if falling.size:
        row = falling[0]
        raise ConfigError(
            f"{path}: {name}: the time runs back from {time[row]:g} to {time[row + 1]:g} s"
        )
    fresh = np.diff(time, prepend=-np.inf) > 0.0
    time = time[fresh]
    values = values[fresh]
    apart = np.ptp(time) / len(time)
    if not 1e-5 < apart < LONGEST_GAP:
        raise ConfigError(
            f"{path}: {name}: rows are {apart:.3g} s apart on average, where {LONGEST_GAP:g} s is "
            "the longest gap; is the time in the unit of its format?"
        )
    # Rows with PWM that no motor can get do not count, see below.
    if name != "pwm_battery" and np.abs(values).max() > LARGEST:
        raise ConfigError(f"{path}: {name}: {np.abs(values).max():.3g} is too large")
    return time, values


def _resampled(series: Series, grid: FloatArray, step: float = 0.0) -> FloatArray:
    """Return values at the times of a grid, (n, columns): interpolated, or means over a step around
    them if the samples are closer than half of it.
    """
    time, values = series
    if np.median(np.diff(time)) > 0.5 * step:
        return np.stack([np.interp(grid, time, column) for column in values.T], axis=1)
    areas = np.diff(time)[:, None] * 0.5 * (values[1:] + values[:-1])
    sums = np.vstack([np.zeros((1, values.shape[1])), np.cumsum(areas, axis=0)])
    low = np.clip(grid - 0.5 * step, time[0], time[-1])
    high = np.clip(grid + 0.5 * step, time[0], time[-1])
    columns = [np.interp(high, time, c) - np.interp(low, time, c) for c in sums.T]
    return np.stack(columns, axis=1) / np.maximum(high - low, 1e-9)[:, None]


def _held_means(commands: Series, edges: FloatArray) -> FloatArray:
    """Return the means of commands between times, (n, 4); NaN where one is missing.

    Each command is held until the next one.
    """
    time, values = commands
    areas = np.diff(time)[:, None] * np.hstack([np.nan_to_num(values), np.isnan(values)])[:-1]
    sums = np.vstack([np.zeros((1, 8)), np.cumsum(areas, axis=0)])
    means = np.diff([np.interp(edges, time, column) for column in sums.T]).T
    means /= np.diff(edges)[:, None]
    return np.where(means[:, 4:] > 1e-6, np.nan, means[:, :4])


def _without_gaps(time: FloatArray, grid: FloatArray) -> BoolArray:
    """Whether each row of a grid lies between two samples that are close."""
    gaps = np.diff(time, append=time[-1])
    return np.asarray(gaps[np.searchsorted(time, grid, side="right") - 1] < LONGEST_GAP)


def _fill_motion(
    path: Path,
    series: Mapping[str, Series],
    grid: FloatArray,
    motion: FloatArray,
    flying: BoolArray,
) -> float:
    """Write position, attitude and velocity, and where the vehicle is above the ground.

    :return: how far the gyro's clock is behind that of the attitude, s.
    """
    step = grid[1] - grid[0]
    time, attitude = series["attitude"]
    norms = np.linalg.norm(attitude, axis=1)
    worst = np.abs(norms - 1.0).argmax()
    if not 0.9 < norms[worst] < 1.1:
        raise ConfigError(f"{path}: row {worst + 1}: qw, qx, qy, qz have length {norms[worst]:.3g}")
    # q and -q are the same attitude, but interpolation between them would pass through others.
    cosines = (attitude[1:] * attitude[:-1]).sum(axis=1)
    signs = np.cumprod(np.where(np.append(1.0, cosines) < 0.0, -1.0, 1.0))
    attitude = _resampled((time, attitude * signs[:, None]), grid)
    attitude /= np.linalg.norm(attitude, axis=1, keepdims=True)
    velocity = _resampled(series["velocity"], grid)
    motion[:, VELOCITY] = velocity
    # Three elements of Rᵀ dR/dt are the body rates.
    rotation = rotation_matrices(attitude)
    turning = np.einsum("nji,njk->nik", rotation, np.gradient(rotation, step, axis=0))
    rates = turning[:, [2, 0, 1], [1, 2, 0]]
    if "position" in series:
        motion[:, POSITION] = _resampled(series["position"], grid)
        flying &= motion[:, 2] > LEAST_HEIGHT
        speeds = np.gradient(motion[:, POSITION], step, axis=0)
        _refuse_unlike(path, "velocity", velocity[flying], speeds[flying], step)
    else:
        motion[:, POSITION] = np.cumsum(velocity, axis=0) * step

    def gap(behind: float) -> FloatArray:
        return np.asarray(_resampled(series["gyro"], grid + behind)[flying] - rates[flying])

    costs = np.array([np.square(gap(behind)).sum() for behind in OFFSETS])
    # Noise alone must not move the clock.
    unmoved = np.square(gap(0.0)).sum()
    offset = float(OFFSETS[costs.argmin()]) if costs.min() < WORTH_A_SHIFT * unmoved else 0.0

    _refuse_unlike(path, "gyro", gap(offset) + rates[flying], rates[flying], step)
    force = np.gradient(velocity, step, axis=0)
    force[:, 2] += GRAVITY
    if flying.any():
        x, y, z = np.einsum("nji,nj->ni", rotation, force)[flying].mean(axis=0)
        attitude = rotated_by(attitude, np.array([[-y / z, x / z, 0.0]]))
    motion[:, QUATERNION] = attitude
    return offset


def _in_the_air(log: Log, knows_height: bool) -> Log:
    """Return a log whose rows count only in the air, with commands.

    :raises ConfigError: a motor gets nothing; its accelerometer shows other than gravity.
    """
    commands = log.mean_commands()
    time, _ = log.commands
    flying = log.flying & np.isfinite(commands).all(axis=1)
    rows = np.arange(len(flying), dtype=np.float64)
    flying &= _without_gaps(time, log.begin + log.offset + log.step * rows)
    mean = commands.mean(axis=1)
    if not knows_height:
        on = mean[mean > 0.2 * np.nanmax(mean)]
        low = ~(mean > FLYING_SHARE * np.median(on)) if on.size else np.ones(len(mean), bool)
        near = round(NEAR_GROUND / log.step)
        flying &= np.convolve(low, np.ones(2 * near + 1), "same") < 0.5
    if flying.sum() * log.step < LEAST_DURATION:
        return replace(log, flying=np.zeros_like(flying))
    least = commands[flying].mean(axis=0)
    if least.min() <= 0.0:
        raise ConfigError(
            f"{log.path}: motor M{least.argmin() + 1} gets {least.min():.3g} on average"
        )
    if log.force is not None:
        mean_force = log.force[flying].mean()
        if not 0.6 * GRAVITY < mean_force < 1.6 * GRAVITY:
            raise ConfigError(
                f"{log.path}: the accelerometer shows {mean_force:.3g} m/s² along z in flight, "
                f"where {GRAVITY:g} is likely; check its unit, axes and sign"
            )
    return replace(log, flying=flying)


def _refuse_unlike(
    path: Path, what: str, measured: FloatArray, other: FloatArray, step: float
) -> None:
    """Refuse columns (n, 3) that have another unit, sign or axis than what others say.

    :raises ConfigError: the message names the column.
    """
    # Means over blocks: what follows from positions and attitudes is noisy.
    block = round(AVERAGED / step)
    count = len(measured) // block
    pair = np.stack([measured, other])[:, : count * block]
    means = pair.reshape(2, count, block, 3).mean(axis=2)
    for axis, own, expected in zip("xyz", means[0].T, means[1].T, strict=True):
        larger = max(own @ own, expected @ expected)
        if own @ expected < LEAST_AGREEMENT * larger and larger > count * LEAST_MOTION**2:
            raise ConfigError(
                f"{path}: {what} {axis} contradicts the motion; check units, axes and the order of "
                "columns"
            )


def motor_thrusts(pwm: FloatArray, battery: FloatArray) -> FloatArray:
    """Return the thrusts, N, that the Crazyflie's firmware expects from its commands.

    :param pwm: (n, 4), 0 to 65,535; other values and motors at rest become NaN.
    :param battery: (n, 1), V.
    """
    thrusts = np.polynomial.Polynomial(THRUST_BY_VOLTAGE)(pwm / PWM * battery)
    return np.where((pwm > 0.0) & (pwm <= PWM), thrusts, np.nan)


def rotated_by(quaternion: FloatArray, rotation: FloatArray) -> FloatArray:
    """Return attitudes, (n, 4), after rotations in body axes, (n, 3), rad."""
    half = 0.5 * np.linalg.norm(rotation, axis=1)
    axis = 0.5 * np.sinc(half / np.pi) * rotation.T
    return np.stack(quaternion_product.py_func(quaternion.T, (np.cos(half), *axis)), axis=1)


def flown(logs: Sequence[Log]) -> float:
    """Return how long logs fly, s."""
    return float(sum(log.step * log.flying.sum() for log in logs))
