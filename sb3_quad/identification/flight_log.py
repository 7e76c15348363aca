"""A log of a flight on the time grid of the simulation, calibrated by what it says itself.

From the whole flight follow: the clock of the vehicle's own sensors, by the shift at which gyro and
attitude agree best; and how the markers of a motion capture are mounted, so that the mean specific
force lies along z.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.ndimage import binary_dilation, uniform_filter1d
from scipy.spatial.transform import Rotation, Slerp

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.types import BoolArray, FloatArray, StrPath
from sb3_quad.base.validate import LARGEST
from sb3_quad.envs.simulation.state import BODY_RATES, POSITION, QUATERNION, VELOCITY
from sb3_quad.envs.vehicles.layout import ORDERS
from sb3_quad.envs.vehicles.vehicle import GRAVITY, Vehicle
from sb3_quad.identification.readers import COMMANDS, WAY_OUT, Recording, read_recording

# Rows below this height do not count, since the ground changes the thrust, m
LEAST_HEIGHT = 0.3
# Where the height is unknown, a vehicle flies while its motors get this share of their usual
# command, and not within this time of a start or landing, s.
FLYING_SHARE = 0.55
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
OFFSETS = np.append(0.0, np.arange(-0.1, 0.1005, 0.001))
# The least that a log needs: rotors that spin up, and the longest horizon, s
LEAST_DURATION = 1.0
# Mean commands in flight: N, rad/s, and a part of the full command
LIKELY = {"thrust": (1e-3, 1e3), "rotor_speed": (50.0, 1e4), "share": (0.05, 1.0)}
MOST_RATE = 100.0  # rad/s, beyond what gyros measure
MOTION_SIZE = 13
UPWARD = np.array([0.0, 0.0, GRAVITY])
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
        areas = self.commands.copy()
        areas[1:, 1:] = np.cumsum(np.diff(areas[:, :1], axis=0) * areas[:-1, 1:], axis=0)
        areas[0, 1:] = 0.0
        edges = np.append(self.times, self.times[-1] + self.step) - delay
        return np.asarray(np.diff(_interpolated(areas, edges), axis=0) / self.step)

    @cached_property
    def mean_velocity(self) -> FloatArray:
        """Mean velocity in the air, (3,), body axes, m/s."""
        motion = self.motion[self.flying]
        inverse = attitudes(motion).inv()
        return np.asarray(inverse.apply(motion[:, VELOCITY]).mean(axis=0))

    def part(self, rows: slice) -> "Log":
        """Return a log with some rows that count alone."""
        flying = np.zeros_like(self.flying)
        flying[rows] = self.flying[rows]
        return replace(self, flying=flying)


def attitudes(motion: FloatArray) -> Rotation:
    """Return the rotations from body to world of motions, (n, 13)."""
    return Rotation.from_quat(motion[:, QUATERNION][:, [1, 2, 3, 0]])


def rotor_columns(log: Log, vehicle: Vehicle) -> list[int]:
    """Return for each rotor of a vehicle the column of a log's commands.

    :raises ConfigError: the rotors form no X, and the log numbers those of one.
    """
    if not log.order:
        return [0, 1, 2, 3]
    places = vehicle.rotor_positions - np.mean(vehicle.rotor_positions, axis=0)
    wanted = [tuple(place) for place in np.sign(places).tolist()]
    order = ORDERS[log.order]
    arms = np.abs(places)
    if sorted(wanted) != sorted(order) or arms.min() < 0.2 * arms.max():
        raise ConfigError(
            f"{vehicle.name}: logs are of an X with the motors of {log.order}; the rotors of this "
            "vehicle form none; write a plain CSV file, whose motors are those of the vehicle file"
        )
    return [order.index(place) for place in wanted]


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
        inside = sorted(Path(path).iterdir()) if Path(path).is_dir() else [Path(path)]
        files += [file for file in inside if file.suffix not in (".yaml", ".yml", ".md")]
    recordings = [read_recording(file) for file in files if not file.is_dir()]
    if not recordings:
        raise ConfigError(f"{paths}: no logs there; {WAY_OUT}")
    if step is None:
        gyros = [recording.series["gyro"] for recording in recordings]
        is_fast = all(np.ptp(gyro[:, 0]) / len(gyro) < 1.0 / 150.0 for gyro in gyros if len(gyro))
        step = 0.005 if is_fast else 0.01
    logs = [on_grid(recording, step) for recording in recordings]
    airborne = [log for log in logs if log.flying.any()]
    if not airborne:
        raise ConfigError(
            f"{files[0]}: no log flies for {LEAST_DURATION:g} s above {LEAST_HEIGHT:g} m with "
            "commands for all motors; does z point up, and is it in the air?"
        )
    for log in airborne:
        if (log.kind, log.has_motion) != (airborne[0].kind, airborne[0].has_motion):
            raise ConfigError(
                f"{log.path}: holds other commands than {airborne[0].path}, or only one of both "
                "holds velocity; fit them one by one"
            )
    return airborne


def on_grid(recording: Recording, step: float) -> Log:
    """Return a log with rows ``step`` s apart, see :func:`read_logs`."""
    path, order, series = recording
    notes: list[str] = []
    series = {name: _cleaned(f"{path}: {name}", one, notes) for name, one in series.items()}
    kind = next(name for name in COMMANDS if name in series)
    commands = series.pop(kind)
    if "battery" in series:
        kind = "thrust"
        commands = motor_thrusts(commands, series.pop("battery"))
    has_motion = {"attitude", "velocity"} <= series.keys()
    if not has_motion:
        if "accelerometer" not in series:
            raise ConfigError(f"{path}: lacks an accelerometer; {WAY_OUT}")
        series = {name: series[name] for name in ("gyro", "accelerometer")}
    begin = max(one[0, 0] for one in series.values())
    end = min(one[-1, 0] for one in series.values())
    if not end - begin > LEAST_DURATION:
        raise ConfigError(f"{path}: is shorter than {LEAST_DURATION:g} s, or cut")
    grid = np.arange(begin, end, step)

    motion = np.zeros((len(grid), MOTION_SIZE))
    motion[:, POSITION.stop] = 1.0
    flying = _without_gaps(commands, grid)
    offset = 0.0
    gyro = _averaged(series["gyro"], step)
    if has_motion:
        offset = _fill_motion(path, series, gyro, grid, motion, flying)
    times = grid + offset
    motion[:, BODY_RATES] = _interpolated(gyro, times)
    if "accelerometer" in series:
        force = _interpolated(_averaged(series["accelerometer"], step), times)
    else:
        force = np.gradient(motion[:, VELOCITY], step, axis=0) + UPWARD
        force = attitudes(motion).inv().apply(force)
    for name, one in series.items():
        flying &= _without_gaps(one, times if name in ("gyro", "accelerometer") else grid)
    # A row's command must last to the next row.
    flying &= _without_gaps(commands, times + step)
    log = Log(
        path=path,
        order=order,
        kind=kind,
        step=step,
        motion=motion,
        force=force,
        has_motion=has_motion,
        flying=flying,
        times=times,
        commands=commands,
        offset=offset,
        notes=tuple(notes),
    )
    return _in_the_air(log, "position" in series)


def _cleaned(name: str, table: FloatArray, notes: list[str]) -> FloatArray:
    """Return a series without rows that are not finite, or are of the same time.

    :param name: of the series, for messages.
    :raises ConfigError: hardly a row is left, times fall or are no seconds, numbers are too large.
    """
    rows = table[np.isfinite(table).all(axis=1)]
    missing = len(table) - len(rows)
    if len(rows) < max(2, missing):
        raise ConfigError(f"{name}: {len(rows)} of {len(table)} rows hold numbers")
    if missing:
        notes.append(f"{name}: {missing} of {len(table)} rows hold no number, and are skipped")
    time = rows[:, 0]
    steps = np.diff(time, prepend=-np.inf)
    if steps.min() < 0.0:
        row = steps.argmin()
        raise ConfigError(f"{name}: the time runs back from {time[row - 1]:g} to {time[row]:g} s")
    apart = np.ptp(time) / len(time)
    if not 1e-5 < apart < LONGEST_GAP:
        raise ConfigError(
            f"{name}: rows are {apart:.3g} s apart on average, where {LONGEST_GAP:g} s is "
            "the longest gap; is the time in the unit of its format?"
        )
    largest = np.abs(rows[:, 1:]).max()
    if largest > LARGEST:
        raise ConfigError(f"{name}: {largest:.3g} is too large")
    return rows[steps > 0.0]


def _interpolated(series: FloatArray, grid: FloatArray) -> FloatArray:
    """Return values at the times of a grid, (n, columns)."""
    time, *columns = series.T
    return np.stack([np.interp(grid, time, column) for column in columns], axis=1)


def _averaged(series: FloatArray, step: float) -> FloatArray:
    """Return running means over about a step."""
    samples = step // np.median(np.diff(series[:, 0])) // 2 * 2 + 1
    return np.asarray(uniform_filter1d(series, int(samples), axis=0))


def _without_gaps(series: FloatArray, grid: FloatArray) -> BoolArray:
    """Whether each row of a grid lies between two samples that are close."""
    time = series[:, 0]
    gaps = np.diff(time, prepend=-np.inf, append=np.inf)
    return np.asarray(gaps[np.searchsorted(time, grid, side="right")] < LONGEST_GAP)


def _fill_motion(
    path: Path,
    series: dict[str, FloatArray],
    gyro: FloatArray,
    grid: FloatArray,
    motion: FloatArray,
    flying: BoolArray,
) -> float:
    """Write position, attitude and velocity, and where the vehicle is above the ground.

    :return: how far the gyro's clock is behind that of the attitude, s.
    """
    step = grid[1] - grid[0]
    time, w, x, y, z = series["attitude"].T
    norms = np.linalg.norm([w, x, y, z], axis=0)
    worst = np.abs(norms - 1.0).argmax()
    if not 0.9 < norms[worst] < 1.1:
        raise ConfigError(f"{path}: row {worst + 1}: qw, qx, qy, qz have length {norms[worst]:.3g}")
    attitude = Slerp(time, Rotation.from_quat(np.stack([x, y, z, w], axis=1)))(grid)
    velocity = motion[:, VELOCITY] = _interpolated(series["velocity"], grid)
    motion[:, POSITION] = np.cumsum(velocity, axis=0) * step
    if "position" in series:
        motion[:, POSITION] = _interpolated(series["position"], grid)
        flying &= motion[:, 2] > LEAST_HEIGHT
    speeds = np.gradient(motion[:, POSITION], step, axis=0)
    _refuse_unlike(path, "velocity", velocity[flying], speeds[flying], step)

    turned = (attitude[:-2].inv() * attitude[2:]).as_rotvec() / (2.0 * step)
    rates = np.pad(turned, ((1, 1), (0, 0)), "edge")[flying]
    gyros = [_interpolated(gyro, grid[flying] + behind) for behind in OFFSETS]
    costs = np.square(np.array(gyros) - rates).sum(axis=(1, 2))
    # The first one is 0, and noise alone must not move the clock.
    best = costs.argmin() if costs.min() < WORTH_A_SHIFT * costs[0] else 0
    _refuse_unlike(path, "gyro", gyros[best], rates, step)

    if flying.any():
        force = np.gradient(velocity, step, axis=0) + UPWARD
        inverse = attitude[flying].inv()
        # Drag tilts the mean force of a flight whose mean velocity is not zero.
        causes = np.insert(inverse.apply(velocity[flying]), 0, 1.0, axis=1)
        x, y, z = np.linalg.lstsq(causes, inverse.apply(force[flying]), rcond=None)[0][0]
        attitude = attitude * Rotation.from_rotvec([-y / z, x / z, 0.0])
    quaternions = attitude.as_quat()[:, [3, 0, 1, 2]]
    # Of q and -q, which are the same attitude, the one nearer to the row before
    signs = np.sign((quaternions[1:] * quaternions[:-1]).sum(axis=1))
    quaternions[1:] *= np.cumprod(signs)[:, None]
    motion[:, QUATERNION] = quaternions
    return float(OFFSETS[best])


def _in_the_air(log: Log, knows_height: bool) -> Log:
    """Return a log whose rows count only in the air.

    :raises ConfigError: a motor gets nothing; its accelerometer shows other than gravity.
    """
    commands = log.mean_commands()
    flying = log.flying
    if not knows_height:
        mean = commands.mean(axis=1)
        top = mean.max()
        usual = np.quantile(mean[mean >= min(0.2 * top, top)], 0.7)
        is_low = mean <= FLYING_SHARE * usual
        flying &= ~binary_dilation(is_low, iterations=round(NEAR_GROUND / log.step))
    if flying.sum() * log.step < LEAST_DURATION:
        return replace(log, flying=np.zeros_like(flying))
    means = commands[flying].mean(axis=0)
    low, high = LIKELY[log.kind]
    for motor in np.flatnonzero((means < low) | (means > high)):
        raise ConfigError(
            f"{log.path}: motor M{motor + 1} gets {means[motor]:.3g} on average as {log.kind}, "
            f"where {low:g} to {high:g} is likely; check its unit"
        )
    mean_force = log.force[flying, 2].mean()
    if not 0.6 * GRAVITY < mean_force < 1.6 * GRAVITY:
        raise ConfigError(
            f"{log.path}: the accelerometer shows {mean_force:.3g} m/s² along z in flight, "
            f"where {GRAVITY:g} is likely; check its unit, axes and sign"
        )
    fastest = np.abs(log.motion[flying, BODY_RATES]).max()
    if fastest > MOST_RATE:
        raise ConfigError(f"{log.path}: the gyro shows {fastest:.3g} rad/s; check its unit")
    return log


def _refuse_unlike(
    path: Path, what: str, measured: FloatArray, other: FloatArray, step: float
) -> None:
    """Refuse columns (n, 3) that have another unit, sign or axis than what others say.

    :raises ConfigError: the message names the column.
    """
    # What follows from positions and attitudes is noisy.
    own = uniform_filter1d(measured, round(AVERAGED / step), axis=0)
    expected = uniform_filter1d(other, round(AVERAGED / step), axis=0)
    larger = np.maximum((own**2).sum(axis=0), (expected**2).sum(axis=0))
    agrees = (own * expected).sum(axis=0) >= LEAST_AGREEMENT * larger
    for axis in np.flatnonzero(~agrees & (larger > len(own) * LEAST_MOTION**2)):
        raise ConfigError(
            f"{path}: {what} {'xyz'[axis]} contradicts the motion; check units, axes and the order "
            "of columns"
        )


def motor_thrusts(share: FloatArray, battery: FloatArray) -> FloatArray:
    """Return the thrusts that the Crazyflie's firmware expects from its commands, (n, 5), N.

    Rows in which a motor rests, or gets more than it can, are skipped.

    :param share: times, s, and commands of the motors, 0 to 1, (n, 5).
    :param battery: times, s, and V, (samples, 2).
    """
    valid = share[((share[:, 1:] > 0.0) & (share[:, 1:] <= 1.0)).all(axis=1)]
    voltage = valid[:, 1:] * _interpolated(battery, valid[:, 0])
    return np.hstack([valid[:, :1], np.polynomial.Polynomial(THRUST_BY_VOLTAGE)(voltage)])
