"""Logs of one vehicle: read, and brought to the time grid of the simulation."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from scipy.signal import savgol_filter

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.types import BoolArray, FloatArray, StrPath
from sb3_quad.base.validate import LARGEST
from sb3_quad.envs.simulation.state import BODY_RATES, POSITION, QUATERNION, VELOCITY
from sb3_quad.identification.alignment import clock_offset, mounting, recorded_attitudes
from sb3_quad.identification.flight_log import MOTION_SIZE, UPWARD, Log, quaternions
from sb3_quad.identification.plausible import (
    LARGEST_COMMANDS,
    LEAST_DURATION,
    in_the_air,
    refuse_unlike,
)
from sb3_quad.identification.readers import (
    COMMANDS,
    WAY_OUT,
    Recording,
    motor_thrusts,
    read_recording,
)
from sb3_quad.identification.series import averaged, cleaned, interpolated, without_gaps

# s
USUAL_STEP = 0.005
LONGEST_STEP = 0.01
ON_BOARD = ("gyro", "accelerometer")
# Rows below this height do not count, since the ground changes the thrust, m
LEAST_HEIGHT = 0.3
# Accelerations that follow from velocities are those over this time, s
SMOOTHED = 0.05


def read_logs(paths: Iterable[StrPath] | StrPath, step: float | None = None) -> list[Log]:
    """Read logs.

    :param paths: files; of a folder, all files but YAML in it.
    :param step: from row to row, s; None: some samples of the gyro, about 0.005, at most 0.01.
    :return: those that fly at all.
    :raises ConfigError: no log there that flies, or one that cannot be read, lacks what it needs,
        or contradicts itself.
    """
    files: list[Path] = []
    for path in [paths] if isinstance(paths, (str, Path)) else paths:
        inside = sorted(Path(path).glob("*")) or [Path(path)]
        files += [file for file in inside if file.suffix not in (".yaml", ".yml", ".md")]
    recordings = [read_recording(file) for file in files if not file.is_dir()]
    if not recordings:
        raise ConfigError(f"{paths}: no logs there; {WAY_OUT}")
    if step is None:
        step = max(_step(recording.series["gyro"][:, 0]) for recording in recordings)
    logs = [on_grid(recording, step) for recording in recordings]
    airborne = [log for log in logs if log.flying.any()]
    if not airborne:
        raise ConfigError(
            f"{files[0]}: no log flies for {LEAST_DURATION:g} s above {LEAST_HEIGHT:g} m with "
            "commands for all motors; does z point up, and is it in the air?"
        )
    first = airborne[0]
    for log in airborne:
        if (log.kind, log.has_motion) != (first.kind, first.has_motion):
            raise ConfigError(
                f"{log.path}: holds other commands than {first.path}, or only one of both "
                "holds velocity; fit them one by one"
            )
    return airborne


def _step(times: FloatArray) -> float:
    """Return a step of whole samples, s, so that fast turns need no interpolation."""
    known = times[np.isfinite(times)]
    if len(known) < 2:
        return LONGEST_STEP
    apart = max(np.ptp(known) / (len(known) - 1), 1e-5)
    samples = max(round(USUAL_STEP / apart), 1)
    return round(min(samples * apart, LONGEST_STEP), 4)


def on_grid(recording: Recording, step: float) -> Log:
    """Return a log with rows ``step`` s apart, see :func:`read_logs`."""
    path, order, series = recording
    notes: list[str] = []
    for name, one in series.items():
        largest = LARGEST_COMMANDS.get(name, LARGEST)
        series[name] = cleaned(f"{path}: {name}", one, largest, notes)
    kind = next(name for name in COMMANDS if name in series)
    commands = series.pop(kind)
    if "battery" in series:
        kind = "thrust"
        commands = motor_thrusts(commands, series.pop("battery"))
    has_motion = {"attitude", "velocity"} <= series.keys()
    if not has_motion:
        if "accelerometer" not in series:
            raise ConfigError(f"{path}: lacks an accelerometer; {WAY_OUT}")
        series = {name: series[name] for name in ON_BOARD}
    begin = max(one[0, 0] for one in series.values())
    end = min(one[-1, 0] for one in series.values())
    if not end - begin > LEAST_DURATION:
        raise ConfigError(f"{path}: is shorter than {LEAST_DURATION:g} s, or cut")
    grid = np.arange(begin, end, step)

    flying = without_gaps(commands, grid)
    gyro = averaged(series["gyro"], step)
    motion = np.zeros((len(grid), MOTION_SIZE))
    motion[:, POSITION.stop] = 1.0
    offset = 0.0
    if has_motion:
        force, offset = _fill_motion(path, series, gyro, grid, motion, flying)
    times = grid + offset
    motion[:, BODY_RATES] = interpolated(gyro, times)
    if "accelerometer" in series:
        force = interpolated(averaged(series["accelerometer"], step), times)
    for name, one in series.items():
        flying &= without_gaps(one, times if name in ON_BOARD else grid)
    # A row's command must last to the next row.
    flying &= without_gaps(commands, times + step)
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
    return in_the_air(log, "position" in series)


def _fill_motion(
    path: Path,
    series: dict[str, FloatArray],
    gyro: FloatArray,
    grid: FloatArray,
    motion: FloatArray,
    flying: BoolArray,
) -> tuple[FloatArray, float]:
    """Write position, attitude and velocity, and where the vehicle is above the ground.

    :return: the specific force that follows, (n, 3), body axes, m/s², and how far the gyro's clock
        is behind that of the attitude, s.
    """
    step = grid[1] - grid[0]
    velocity = motion[:, VELOCITY] = interpolated(series["velocity"], grid)
    motion[:, POSITION] = np.cumsum(velocity, axis=0) * step
    if "position" in series:
        motion[:, POSITION] = interpolated(series["position"], grid)
        flying &= motion[:, 2] > LEAST_HEIGHT
    speeds = np.gradient(motion[:, POSITION], step, axis=0)
    refuse_unlike(path, "velocity", velocity[flying], speeds[flying], step)
    attitude = recorded_attitudes(path, series["attitude"], grid)
    offset = clock_offset(path, gyro, attitude, grid, flying)
    rows = round(SMOOTHED / step) // 2 * 2 + 1
    acceleration = savgol_filter(velocity, rows, 2, deriv=1, delta=step, axis=0)
    force = UPWARD + acceleration
    if flying.any():
        attitude *= mounting(attitude[flying], velocity[flying], force[flying])
    motion[:, QUATERNION] = quaternions(attitude)
    return attitude.inv().apply(force), offset
