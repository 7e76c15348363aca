"""Logs of flight controllers, as they come, as time series in SI units.

The content of a file decides what it is: PX4's ULog, Betaflight's blackbox, the log that a
Crazyflie writes to its µSD card, or a CSV file of these, of NanoBench or with the plain columns.
"""

import struct
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sb3_quad.base.errors import ConfigError, raised_as
from sb3_quad.base.files import read_bytes
from sb3_quad.base.imports import require
from sb3_quad.base.types import FloatArray, StrPath
from sb3_quad.envs.simulation.motions import read_table
from sb3_quad.identification.formats import (
    BETAFLIGHT,
    COMMANDS,
    CRAZYFLIE,
    DEGREE,
    PX4,
    TABLES,
    Columns,
    Format,
)

LARGEST_LOG = 300_000_000  # bytes
BLACKBOX = b"H Product:Blackbox"
ULOG = b"ULog\x01\x12\x35"
USD = b"\xbc"
# Sizes of a Crazyflie's types are those of Python's struct.
_TYPES = set("?bBhHiIqQefd")
WAY_OUT = (
    "a log has motor commands, gyro, and an accelerometer or attitude and velocity; "
    "docs/your_vehicle.md lists the columns of each format"
)


@dataclass(frozen=True, eq=False)
class Part:
    """Columns that were recorded at the same times."""

    time: FloatArray  #: (n,), s
    columns: Mapping[str, Any]  #: (n,) each, by name

    def take(self, columns: Columns) -> FloatArray:
        """Return columns in the unit of their quantity, (n, columns)."""
        values = np.stack([np.asarray(self.columns[name], float) for name in columns.names], axis=1)
        return np.asarray((values - columns.zero) * columns.scale)


Series = tuple[FloatArray, FloatArray]
"""Times (n,), s, and values (n, columns)."""


@dataclass(frozen=True, eq=False)
class Recording:
    """The time series of a log, as :class:`~sb3_quad.identification.formats.Format` names them."""

    path: Path  #: of its file
    format: Format
    series: Mapping[str, Series]


def read_recording(source: StrPath) -> Recording:
    """Read a log of any format.

    :raises ConfigError: a file that cannot be read, is damaged, or lacks what a log needs.
    :raises MissingExtra: the package that reads this format is not installed.
    """
    path = Path(source)
    start = read_bytes(path, LARGEST_LOG)[: len(BLACKBOX)]
    if start.startswith(ULOG):
        return _recording(path, PX4, _ulog(path))
    if start.startswith(BLACKBOX):
        return _recording(path, *_blackbox(path))
    if start.startswith(USD):
        return _recording(path, CRAZYFLIE, _usd(path))
    return _recording(path, *_table(path))


def _recording(path: Path, log_format: Format, parts: Sequence[Part]) -> Recording:
    series = {}
    for name, alternatives in log_format.series.items():
        for columns in alternatives:
            for part in parts:
                if name not in series and {*columns.names} <= {*part.columns}:
                    series[name] = (part.time, part.take(columns))
    if not series.keys() & {*COMMANDS} or "gyro" not in series:
        missing = "motor commands" if "gyro" in series else "a gyro"
        raise ConfigError(f"{path}: lacks {missing}; {WAY_OUT}")
    if log_format.is_down:
        for name, (_, values) in series.items():
            # Of vectors and quaternions, the last two elements are those of y and z.
            if name not in COMMANDS:
                values[:, -2:] *= -1.0
    return Recording(path, log_format, series)


def _ulog(path: Path) -> list[Part]:
    pyulog = require("pyulog", "fit", f"{path}: reading a ULog")
    with raised_as(ConfigError, f"{path}: not a ULog that can be read"):
        log = pyulog.ULog(str(path), disable_str_exceptions=True)
    parts = []
    for data in log.data_list:
        # What a sensor measured was true when it was sampled, what a motor gets when it is sent.
        sampled = "" if data.name.startswith("actuator") else "timestamp_sample"
        time = data.data.get(sampled, data.data["timestamp"]) * 1e-6
        names = {f"{data.name}.{name}": values for name, values in data.data.items()}
        parts.append(Part(time, names))
    return parts


def _blackbox(path: Path) -> tuple[Format, list[Part]]:
    orangebox = require("orangebox", "fit", f"{path}: reading a blackbox log")
    with raised_as(ConfigError, f"{path}: not a blackbox log that can be read"):
        parser = orangebox.Parser.load(str(path))
        names = parser.field_names
        rows: list[Any] = []
        # A log that was cut ends within a frame, where the parser fails.
        with suppress(Exception):
            # A frame of another kind is shorter.
            rows += (frame.data for frame in parser.frames() if len(frame.data) == len(names))
        # What a field lacks is no number.
        table = np.array(rows, dtype=object).reshape(len(rows), len(names))
        columns = {}
        for name, values in zip(names, table.T, strict=True):
            columns[name] = [x if isinstance(x, (int, float)) else np.nan for x in values]
        return _betaflight(parser.headers), [_part(BETAFLIGHT, columns)]


def _betaflight(headers: Mapping[str, Any]) -> Format:
    """Return Betaflight's format with the units that the headers of a log say."""
    series = dict(BETAFLIGHT.series)
    if "acc_1G" in headers:
        (columns,) = series["accelerometer"]
        one = 2048.0 / float(headers["acc_1G"])
        series["accelerometer"] = [columns._replace(scale=columns.scale * one)]
    # Before Betaflight 3 the gyro had its own unit.
    scale = headers.get("gyro_scale")
    if isinstance(scale, float) and scale != 1.0:
        (columns,) = series["gyro"]
        series["gyro"] = [columns._replace(scale=scale * DEGREE)]
    low, high = _motor_range(headers.get("motorOutput"))
    (columns,) = series["share"]
    series["share"] = [columns._replace(zero=low, scale=1.0 / (high - low))]
    return BETAFLIGHT._replace(series=series)


def _motor_range(given: Any) -> tuple[float, float]:
    """Return the commands for a motor that rests and one at full throttle."""
    numbers = given if isinstance(given, (list, tuple)) else str(given or "").split(",")
    if len(numbers) == 2 and float(numbers[1]) <= 2000.0:
        return 1000.0, 2000.0
    return 48.0, 2047.0


def _part(log_format: Format, columns: Mapping[str, Any]) -> Part:
    times = log_format.time
    return Part(np.asarray(columns[times.names[0]], float) * times.scale, columns)


def _usd(path: Path) -> list[Part]:
    """Read what tools/usdlog of crazyflie-firmware reads."""
    with raised_as(ConfigError, f"{path}: not a log of a Crazyflie that can be read"):
        data = read_bytes(path, LARGEST_LOG)
        version, kinds = struct.unpack_from("<HH", data, 1)
        if version not in (1, 2):
            raise ValueError(f"version {version}")
        # Version 1 counts milliseconds, version 2 microseconds.
        time, scale = ("<I", 1e-3) if version == 1 else ("<Q", 1e-6)
        place = 5
        layouts: dict[int, tuple[list[str], struct.Struct, list[Any]]] = {}
        for _ in range(kinds):
            (identifier,) = struct.unpack_from("<H", data, place)
            _, place = _text(data, place + 2)
            (count,) = struct.unpack_from("<H", data, place)
            place += 2
            fields = []
            for _ in range(count):
                field, place = _text(data, place)
                name, _, kind = field.partition("(")
                if kind[:1] not in _TYPES:
                    raise ValueError(f"{field}: unknown type")
                fields.append((name, kind[0]))
            row = struct.Struct(time + "".join(kind for _, kind in fields))
            layouts[identifier] = (["timestamp", *(name for name, _ in fields)], row, [])
        # The last four bytes are a checksum; a log that was cut ends anywhere.
        while place + 2 <= len(data):
            (identifier,) = struct.unpack_from("<H", data, place)
            if identifier not in layouts:
                break
            _, row, rows = layouts[identifier]
            if place + 2 + row.size > len(data):
                break
            rows.append(row.unpack_from(data, place + 2))
            place += 2 + row.size
    parts = []
    for names, _, rows in layouts.values():
        values = np.array(rows, float).reshape(len(rows), len(names)).T
        parts.append(Part(values[0] * scale, dict(zip(names, values, strict=True))))
    return parts


def _text(data: bytes, place: int) -> tuple[str, int]:
    """Return a text that ends with a zero, and the place after it."""
    end = data.index(b"\0", place)
    return data[place:end].decode(), end + 1


def _table(path: Path) -> tuple[Format, list[Part]]:
    """Read a CSV file.

    :raises ConfigError: it is of none of the formats.
    """
    headers, frame = _csv(path)
    # Betaflight's blackbox_decode adds the unit of the time.
    columns = {name.partition(" (us)")[0]: frame[name].to_numpy() for name in frame}
    fitting = []
    for log_format in TABLES:
        known: set[str] = set()
        for alternatives in log_format.series.values():
            known.update(*(option.names for option in alternatives))
        if log_format.time.names[0] in columns:
            fitting.append((len(known & columns.keys()), log_format))
    if not fitting:
        raise ConfigError(f"{path}: has no column for the time; {WAY_OUT}")
    _, log_format = max(fitting, key=lambda pair: pair[0])
    part = _part(log_format, columns)
    if log_format is BETAFLIGHT:
        log_format = _betaflight(headers)
    return log_format, [part]


def _csv(path: Path) -> tuple[dict[str, str], Any]:
    """Return the names and values above the table of a CSV file, and the table."""
    lines = read_bytes(path, LARGEST_LOG).split(b"\n", 400)
    # Betaflight's Explorer writes the headers of the log above the names of the columns.
    skipped = next((k for k, line in enumerate(lines[:-1]) if b"loopIteration" in line), 0)
    headers = {}
    for line in lines[:skipped]:
        name, _, value = line.decode(errors="replace").partition(",")
        headers[name.strip('" ')] = value.strip('"\r ')
    return headers, read_table(path, LARGEST_LOG, skipped)
