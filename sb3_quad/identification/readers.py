"""Logs of flight controllers, as they come, as time series in SI units.

The content of a file decides what it is: PX4's ULog, Betaflight's blackbox, the log that a
Crazyflie writes to its µSD card, or a CSV file of these, of NanoBench or with the plain columns.
``formats.yaml`` names their columns. Everything becomes SI units, the body frame x forward, y left,
z up, and a world frame with z up.
"""

import struct
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from sb3_quad.base.errors import ConfigError, raised_as
from sb3_quad.base.files import read_bytes
from sb3_quad.base.imports import require
from sb3_quad.base.types import FloatArray, StrDict, StrPath
from sb3_quad.base.yaml_files import read_yaml
from sb3_quad.envs.simulation.motions import read_table
from sb3_quad.identification.series import interpolated

LARGEST_LOG = 300_000_000  # bytes
LONGEST_NAME = 100  # bytes
LONGEST_HEADERS = 100_000  # bytes
FORMATS = read_yaml(Path(__file__).with_name("formats.yaml"))
UNITS = FORMATS.pop("units")
ORDERS_OF = FORMATS.pop("orders")
DOWN = FORMATS.pop("down")
MARKS = FORMATS.pop("marks")
COMMANDS = ("thrust", "rotor_speed", "share")
NEEDED = {"time": ["time"], "motor commands": COMMANDS, "gyro": ["gyro"]}
WAY_OUT = (
    "a log has motor commands, gyro, and an accelerometer or attitude and velocity; "
    "docs/your_vehicle.md lists the columns of each format"
)

# Thrust of a motor, N, as coefficients of the powers of its voltage, from the 0th:
# crazyflie-firmware 2025.12, platform_defaults_cf2.h, CONFIG_CRAZYFLIE_21_PLUS. The voltage is PWM
# / 65,535 of the battery's.
THRUST_BY_VOLTAGE = (-0.0247653792, 0.0652379353, -0.0267925050, 0.0067767893)

Part = Mapping[str, Any]
"""Columns that were recorded at the same times, (n,) each, by name."""


class Recording(NamedTuple):
    """The time series of a log."""

    path: Path  #: of its file
    order: str  #: of the motors, a key of ``ORDERS``; empty: that of the vehicle
    #: by the quantities of ``formats.yaml``: time, s, and values, (n, 1 + columns)
    series: dict[str, FloatArray]


def read_recording(source: StrPath) -> Recording:
    """Read a log of any format.

    :raises ConfigError: a file that cannot be read, is damaged, or lacks what a log needs.
    :raises MissingExtra: the package that reads this format is not installed.
    """
    path = Path(source)
    data = read_bytes(path, LARGEST_LOG)
    with raised_as(ConfigError, f"{path}: not a log that can be read"):
        for magic, (name, read) in READERS.items():
            if data.startswith(magic):
                parts, headers = read(path, data)
                return _recording(path, name, parts, headers)
        table, headers = _csv(path, data)
        kinds = (name for name, mark in MARKS.items() if mark in table)
        return _recording(path, next(kinds, "plain CSV"), [table], headers)


def _recording(path: Path, name: str, parts: Sequence[Part], headers: StrDict) -> Recording:
    """Find the quantities of a format among the columns of a log."""
    units = UNITS | _units(headers)
    ((clock, clock_unit),) = FORMATS[name]["time"].items()
    _, seconds = units[clock_unit]
    series: dict[str, FloatArray] = {}
    for quantity, options in FORMATS[name].items():
        for columns, unit in options.items():
            names = columns.split()
            zero, scale = units[unit]
            for part in parts:
                if quantity in series or not {clock, *names} <= part.keys():
                    continue
                time = np.array(part[clock], float)
                values = np.array([part[name] for name in names], float)
                rows = [seconds * time, *(scale * (values - zero))]
                series[quantity] = np.array(rows).T
    for what, some in NEEDED.items():
        if series.keys().isdisjoint(some):
            raise ConfigError(f"{path}: lacks {what}; {WAY_OUT}")
    del series["time"]
    if name in DOWN:
        # Of vectors and quaternions, the last two elements are those of y and z.
        for quantity in series.keys() - COMMANDS:
            series[quantity][:, -2:] *= -1.0
    return Recording(path, ORDERS_OF.get(name, ""), series)


def _units(headers: StrDict) -> StrDict:
    """Return the units that the headers of a blackbox say."""
    units: StrDict = {}
    with suppress(KeyError):
        one = float(headers["acc_1G"])
        _, gravity = UNITS["g"]
        units["acc_1G"] = 0.0, gravity / one
    # Before Betaflight 3 the gyro had its own unit.
    scale = headers.get("gyro_scale")
    if isinstance(scale, float) and scale != 1.0:
        _, degree = UNITS["deg/s"]
        units["gyro_scale"] = 0.0, scale * degree
    # The commands for a motor that rests and one at full throttle
    output = str(headers.get("motorOutput")).strip("[]")
    limits = output.split(",")
    if len(limits) == 2 and float(limits[1]) <= 2000.0:
        units["DShot"] = UNITS["PWM"]
    return units


def _ulog(path: Path, _data: bytes) -> tuple[list[Part], StrDict]:
    pyulog = require("pyulog", "fit", f"{path}: reading a ULog")
    log = pyulog.ULog(str(path), disable_str_exceptions=True)
    parts: list[Part] = []
    for data in log.data_list:
        columns = data.data
        part = {f"{data.name}.{name}": values for name, values in columns.items()}
        part["time"] = columns["timestamp"]
        # What a sensor measured was true when it was sampled, what a motor gets when it is sent.
        if not data.name.startswith("actuator"):
            part["time"] = columns.get("timestamp_sample", part["time"])
        parts.append(part)
    return parts, {}


def _blackbox(path: Path, _data: bytes) -> tuple[list[Part], StrDict]:
    orangebox = require("orangebox", "fit", f"{path}: reading a blackbox log")
    parser = orangebox.Parser.load(str(path))
    rows: list[Any] = []
    # A log that was cut ends within a frame, where the parser fails.
    with suppress(Exception):
        rows.extend(frame.data for frame in parser.frames())
    names = parser.field_names
    # A frame of another kind is shorter, and what a field lacks is no number.
    whole = [row for row in rows if len(row) == len(names)]
    table = pd.DataFrame(whole, columns=names)
    numbers = table.apply(pd.to_numeric, errors="coerce")
    return [dict(numbers)], parser.headers


def _usd(_path: Path, data: bytes) -> tuple[list[Part], StrDict]:
    """Read what tools/usdlog of crazyflie-firmware reads."""
    version, kinds = struct.unpack_from("<HH", data, 1)
    # Version 1 counts milliseconds, version 2 microseconds.
    time, scale = {1: ("<I", 1.0), 2: ("<Q", 1e-3)}[version]
    place = 5
    # For each kind: how a row is packed, the names of its columns, and the rows
    tables: dict[int, tuple[struct.Struct, list[str], list[Any]]] = {}
    for _ in range(kinds):
        (kind,) = struct.unpack_from("<H", data, place)
        place = data.index(b"\0", place + 2) + 1
        (count,) = struct.unpack_from("<H", data, place)
        place += 2
        names = ["timestamp"]
        letters = time
        for _ in range(count):
            end = data.index(b"\0", place, place + LONGEST_NAME)
            name, letter = data[place:end].decode().split("(")
            names.append(name)
            # Its types are those of Python's struct.
            letters += letter[0]
            place = end + 1
        tables[kind] = struct.Struct(letters), names, []
    # The last four bytes are a checksum; a log that was cut ends anywhere.
    with suppress(struct.error, KeyError):
        while True:
            (kind,) = struct.unpack_from("<H", data, place)
            layout, _, rows = tables[kind]
            rows.append(layout.unpack_from(data, place + 2))
            place += 2 + layout.size
    parts: list[Part] = []
    for _, names, rows in tables.values():
        table = pd.DataFrame(rows, columns=names, dtype=float)
        table["timestamp"] *= scale
        parts.append(dict(table))
    return parts, {}


READERS: Mapping[bytes, tuple[str, Callable[[Path, bytes], tuple[list[Part], StrDict]]]] = {
    b"ULog\x01\x12\x35": ("PX4", _ulog),
    b"H Product:Blackbox": ("Betaflight", _blackbox),
    b"\xbc": ("Crazyflie", _usd),
}


def _csv(path: Path, data: bytes) -> tuple[Part, StrDict]:
    """Return the table of a CSV file, and the names and values above it."""
    # Betaflight's Explorer writes the headers of the log above the names of the columns.
    above, found, _ = data[:LONGEST_HEADERS].partition(b"loopIteration")
    if not found:
        above = b""
    *lines, _ = above.decode(errors="replace").split("\n")
    headers = {}
    for line in lines:
        name, _, value = line.partition(",")
        headers[name.strip('" ')] = value.strip('"\r ')
    table = read_table(path, LARGEST_LOG, len(lines))
    # Betaflight's blackbox_decode adds the unit of the time.
    named = table.rename(columns=lambda name: name.removesuffix(" (us)"))
    return dict(named), headers


def motor_thrusts(share: FloatArray, battery: FloatArray) -> FloatArray:
    """Return the thrusts that the Crazyflie's firmware expects from its commands, (n, 5), N.

    Rows in which a motor rests, or gets more than it can, are skipped.

    :param share: times, s, and commands of the motors, 0 to 1, (n, 5).
    :param battery: times, s, and V, (samples, 2).
    """
    commands = share[:, 1:]
    within = (commands > 0.0) & (commands <= 1.0)
    valid = share[within.all(axis=1)]
    time = valid[:, :1]
    voltages = valid[:, 1:] * interpolated(battery, time[:, 0])
    thrust = np.polynomial.Polynomial(THRUST_BY_VOLTAGE)
    return np.hstack([time, thrust(voltages)])
