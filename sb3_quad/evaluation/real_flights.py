"""How far a vehicle departs from real flights when it flies the commands that their motors got.

A log is a CSV file with the columns of NanoBench (Ullah and Baca 2026, arXiv 2603.09908), which
docs/vehicles.md lists. It is resampled to the vehicle's control step. Three things are calibrated
by the whole flight: the clock of the vehicle's own columns, by the shift at which gyro and attitude
agree best; how the markers of the motion capture are mounted, so that the mean specific force lies
along z; and the motors against each other, so that the mean commands give no moment.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.types import Arrays, BoolArray, FloatArray, StrPath
from sb3_quad.evaluation.tables import Table, text_table
from sb3_quad.simulation.batch import QuadcopterBatch
from sb3_quad.simulation.physics import quaternion_product
from sb3_quad.simulation.settings import FlightSettings
from sb3_quad.simulation.state import rotation_matrices
from sb3_quad.vehicles.vehicle import Vehicle, first_vehicle

HORIZONS = (0.1, 0.2, 0.5)  # s
# Commands before a window that turn the rotors, s.
WARM_UP = 0.5
# Below it rows do not count, since the ground changes the thrust, m.
LEAST_HEIGHT = 0.3
# Longer gaps between rows are not filled, s.
LONGEST_GAP = 0.05
# Differences of clocks that are tried, s.
OFFSETS = np.arange(-0.1, 0.1005, 0.001)
# Thrust of a motor, N, by powers of its voltage from the 0th: crazyflie-firmware 2025.12,
# platform_defaults_cf2.h, CONFIG_CRAZYFLIE_21_PLUS. The voltage is PWM / 65,535 of the battery's.
THRUST_BY_VOLTAGE = (-0.0247653792, 0.0652379353, -0.0267925050, 0.0067767893)
FULL_PWM = 65_535.0
SEEN = "px py pz vx vy vz qw qx qy qz".split()
FELT = "imu_gyro_x imu_gyro_y imu_gyro_z".split()
THRUSTS = "thrust_m1 thrust_m2 thrust_m3 thrust_m4".split()
PWM = "motor_motor_m1 motor_motor_m2 motor_motor_m3 motor_motor_m4 pwr_pm_vbat".split()
NEEDED = (
    f"a log is a CSV file with the columns t, {', '.join(SEEN + FELT)}, and thrusts in N "
    f"({', '.join(THRUSTS)}) or {', '.join(PWM)}"
)
QUANTITIES = ("position, m", "velocity, m/s", "attitude, °", "body rates, rad/s")
HEADS = ("root mean square of the error", "simulated", "nothing changes", "velocity, rates stay")


@dataclass(frozen=True, eq=False)
class Log:
    """A flight of n rows, one for each control step, in SI units."""

    name: str  #: of its file
    #: position (n, 3), quaternion (n, 4), velocity (n, 3), body_rates (n, 3) and commanded thrusts
    #: (n, 4), M1 to M4; and all columns of the file, (n,), at the time of the vehicle's clock
    columns: Arrays
    flying: BoolArray  #: (n,), in the air
    offset: float  #: s, by which the vehicle's clock was behind that of the motion capture


def read_logs(folder: StrPath, step: float) -> list[Log]:
    """Read the logs of a folder, with rows ``step`` s apart.

    :raises ConfigError: no CSV file there, or one that cannot be read or lacks columns.
    """
    paths = sorted(Path(folder).glob("*.csv"))
    if not paths:
        raise ConfigError(f"{folder}: no CSV file there; {NEEDED}")
    return [read_log(path, step) for path in paths]


def read_log(path: Path, step: float) -> Log:
    """Read one log, see :func:`read_logs`."""
    try:
        table = pd.read_csv(path).astype(float)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: not a table of numbers: {error}") from error
    commands = THRUSTS if THRUSTS[0] in table else PWM
    missing = {"t", *SEEN, *FELT, *commands} - {*table}
    if missing:
        raise ConfigError(f"{path}: lacks {', '.join(sorted(missing))}; {NEEDED}")
    time = table["t"]
    grid = np.arange(time.iloc[0], time.iloc[-1], step)

    def at(names: Sequence[str], behind: float = 0.0) -> FloatArray:
        return np.stack([np.interp(grid + behind, time, table[name]) for name in names], axis=1)

    position, velocity, quaternion = np.split(at(SEEN), [3, 6], axis=1)
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    rotation = rotation_matrices(quaternion)
    flying = position[:, 2] > LEAST_HEIGHT
    flying &= np.interp(grid, time, np.gradient(time)) < LONGEST_GAP
    rates = np.zeros_like(position)
    rates[1:-1] = turn_between(rotation[:-2], rotation[2:]) / (2.0 * step)
    rates *= flying[:, None]
    offset = float(max(OFFSETS, key=lambda behind: np.vdot(rates, at(FELT, behind))))

    thrusts = at(commands, offset)
    if commands is PWM:
        thrusts = motor_thrusts(thrusts[:, :4], thrusts[:, 4:])
    # Some logs are extrapolated after the radio was lost.
    flying &= np.isfinite(thrusts).all(axis=1)
    if flying.any():
        force = np.gradient(velocity, step, axis=0) + [0.0, 0.0, 9.81]
        x, y, z = np.einsum("nji,nj->ni", rotation, force)[flying].mean(axis=0)
        quaternion = turned_on(quaternion, np.array([[-y / z, x / z, 0.0]]))
        mean = thrusts[flying].mean(axis=0)
        thrusts *= mean.mean() / mean
    columns: Arrays = dict(zip(table, at([*table], offset).T, strict=True))
    columns.update(position=position, quaternion=quaternion, velocity=velocity)
    columns.update(body_rates=at(FELT, offset), thrusts=thrusts)
    return Log(path.stem, columns, flying, offset)


def motor_thrusts(pwm: FloatArray, battery: FloatArray) -> FloatArray:
    """Return the thrusts, N, that the Crazyflie's firmware expects of its commands.

    :param pwm: (n, 4), 0 to 65,535; others and motors that stand become NaN.
    :param battery: (n, 1), V.
    """
    thrusts = np.polynomial.polynomial.polyval(pwm / FULL_PWM * battery, THRUST_BY_VOLTAGE)
    return np.where((pwm > 0.0) & (pwm <= FULL_PWM), thrusts, np.nan)


def turn_between(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return small rotations from attitudes to others, (n, 3, 3), as vectors in body axes, rad."""
    between = np.einsum("nji,njk->nik", first, second)
    rows = [2, 0, 1]
    columns = [1, 2, 0]
    return np.asarray(between[:, rows, columns] - between[:, columns, rows]) / 2.0


def turned_on(quaternion: FloatArray, rotation: FloatArray) -> FloatArray:
    """Return attitudes, (n, 4), after rotations in body axes, (n, 3), rad."""
    half = 0.5 * np.linalg.norm(rotation, axis=1)
    axis = 0.5 * np.sinc(half / np.pi) * rotation.T
    return np.stack(quaternion_product.py_func(*quaternion.T, np.cos(half), *axis), axis=1)


def open_loop(
    logs: Sequence[Log],
    vehicle: Vehicle,
    stride: int = 1,
    before_step: Callable[[QuadcopterBatch], object] = id,
) -> Iterator[tuple[float, list[Arrays], Arrays]]:
    """Fly recorded commands from recorded states.

    Each row from which a log flies on for long enough begins a window. Its rotors begin as the
    commands of the ``WARM_UP`` before have turned them.

    :param logs: with rows at the vehicle's control step.
    :param stride: rows from a window to the next.
    :param before_step: called with the batch before each control step; it may set a wrench.
    :return: horizon by horizon: its s, the predictions in the order of ``HEADS``, and the record,
        by quantity of the state, (windows, …).
    :raises ConfigError: no log flies for long enough, or the rotors do not lie as M1 to M4 do.
    """
    vehicle = first_vehicle(vehicle, "crazyflie")
    step = vehicle.control_step
    before = round(WARM_UP / step)
    last = round(HORIZONS[-1] / step)
    fit = []
    for log in logs:
        total = np.cumsum(log.flying)
        # Rows so many of whose neighbours fly that all do.
        whole = total[before + last :] - total[: -before - last] == before + last
        fit.append(np.pad(whole, (before, log.flying.size - whole.size - before)))
    rows = np.flatnonzero(np.concatenate(fit))[::stride]
    if rows.size == 0:
        raise ConfigError(f"no log flies above {LEAST_HEIGHT:g} m for {WARM_UP + HORIZONS[-1]:g} s")
    record = {}
    for name in ("position", "quaternion", "velocity", "body_rates", "thrusts"):
        record[name] = np.concatenate([log.columns[name] for log in logs])
    actions = vehicle.thrust_to_action(np.nan_to_num(record.pop("thrusts")))
    start = {name: values[rows] for name, values in record.items()}

    settings = FlightSettings(vehicle=vehicle, noise=0.0)
    batch = QuadcopterBatch(rows.size, settings, seed=0, autoreset=False)
    batch.reset()
    for now in range(-before, last):
        if now == 0:
            for name, values in start.items():
                batch.fix(name, values.T)
        before_step(batch)
        batch.step(actions[rows + now])
        time = (now + 1) * step
        if any(abs(time - horizon) < step / 2 for horizon in HORIZONS):
            state = batch.true_state()
            simulated = {name: getattr(state, name).copy() for name in start}
            stays = {"position": start["position"] + start["velocity"] * time}
            stays["quaternion"] = turned_on(start["quaternion"], start["body_rates"] * time)
            end = {name: values[rows + now + 1] for name, values in record.items()}
            yield time, [simulated, start, start | stays], end


def error_table(logs: Sequence[Log], vehicle: Vehicle) -> Table:
    """Return the errors of a vehicle in open loop, over all windows of all logs."""
    rows: dict[str, list[str]] = {}
    for time, predictions, end in open_loop(logs, vehicle):
        for prediction in predictions:
            for quantity, error in zip(QUANTITIES, errors(prediction, end), strict=True):
                rows.setdefault(f"{quantity}, after {time:g} s", []).append(f"{error:.3g}")
    title = f"{vehicle.name}: {len(end['position'])} windows of {len(logs)} logs, open loop"
    return text_table(title, HEADS, [[name, *rows[name]] for name in sorted(rows)])


def errors(prediction: Arrays, end: Arrays) -> Any:
    """Return the root mean squares of the errors, in the order of ``QUANTITIES``, (4,)."""
    one, other = (rotation_matrices(motion["quaternion"]) for motion in (prediction, end))
    cosine = (np.einsum("nij,nij->n", one, other) - 1.0) / 2.0
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    names = ("position", "velocity", "body_rates")
    norms = [np.linalg.norm(prediction[name] - end[name], axis=1) for name in names]
    norms.insert(2, angle)
    return np.sqrt(np.square(norms).mean(axis=1))
