"""Motions: positions as functions of time, from curves, points in a file, or waypoints."""

import io
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_quad.base.errors import ConfigError, raised_as
from sb3_quad.base.files import read_bytes
from sb3_quad.base.types import FloatArray

if TYPE_CHECKING:
    import pandas as pd

Motion = Callable[[FloatArray], FloatArray]
"""The position at given times (t,), s: (t, 3) or with a heading (t, 4); m and rad."""
HARMONICS = np.arange(1, 7)
# bytes
LARGEST_TABLE = 20_000_000
LONGEST_ROW = 20_000
MAX_SECONDS = 600.0  # of a round or of all; a table must not fill the memory
_COLUMNS = ["t", "x", "y", "z", "heading"]
# Number of coefficients of a segment of a polynomial with the least snap
_COEFFICIENTS = 8
# Curves of sines, as functions of the angle ωt and the sizes A, B and C
SINES: Mapping[str, Callable[..., Any]] = {
    "hover": lambda p, a, b, c: (0.0 * p, 0.0 * p, 0.0 * p),
    "circle": lambda p, a, b, c: (a * np.cos(p), a * np.sin(p), 0.0 * p),
    "figure_eight": lambda p, a, b, c: (a * np.sin(p), b * np.sin(2.0 * p), c * np.sin(p)),
    "helix": lambda p, a, b, c: (a * np.cos(p), a * np.sin(p), c * p / (2.0 * math.pi)),
    "lissajous": lambda p, a, b, c: (a * np.sin(p), b * np.sin(2.0 * p), c * np.sin(3.0 * p)),
}


def sum_of_sines(
    rate: float, phases: FloatArray, amplitudes: FloatArray, times: FloatArray
) -> FloatArray:
    """Return sums of sines, (t, 3); amplitudes and phases are (3, harmonics)."""
    angles = np.multiply.outer(rate * times, HARMONICS)[:, None, :] + phases
    return np.asarray((amplitudes * np.sin(angles)).sum(axis=2))


def read_points(path: Path) -> tuple[FloatArray, FloatArray]:
    """Return the times (t,), from 0 on, and positions (t, 3), or (t, 4) with headings, of a CSV
    file.

    Its first line names the columns: t, x, y, z and maybe heading; s, m, rad.

    :raises ConfigError: a file that cannot be read, or whose times do not rise; the message names
        the row, counted from 1 after the header.
    """
    times, points = read_series(path, _COLUMNS[:4], _COLUMNS)
    # Headings may be wrapped to [-π, π]: take the shorter way between two of them.
    points[:, 3:] = np.unwrap(points[:, 3:], axis=0)
    return times, points


def read_series(path: Path, least: list[str], most: list[str]) -> tuple[FloatArray, FloatArray]:
    """Return the times (t,), from 0 on, and the numbers (t, columns) of a CSV file.

    :param least: the columns that its first line must name, t first; ``most``: or these.
    :raises ConfigError: see :func:`read_points`.
    """
    frame = read_table(path)
    names = [*frame.columns]
    if names not in (least, most):
        columns = " or ".join(",".join(valid) for valid in (least, most))
        raise ConfigError(
            f"{path}: its first line names {','.join(names)}; the columns must be {columns}"
        )
    if len(frame) < 2:
        raise ConfigError(f"{path}: needs two or more rows after its header")
    refuse_gaps(path, frame)
    numbers = frame.to_numpy()
    times = numbers[:, 0] - numbers[0, 0]
    refuse_falling_times(path, frame["t"])
    return times, numbers[:, 1:]


def read_table(path: Path, most: int = LARGEST_TABLE, skipped: int | None = None) -> "pd.DataFrame":
    """Return the numbers of a CSV file by the names of the columns in its first line.

    :param most: the largest size, in bytes.
    :param skipped: lines above that line. If they are given, columns may hold other things than
        numbers, which become NaN.
    :raises ConfigError: a file that cannot be read, or holds something else; a column given twice.
    """
    # Other references do not wait for it.
    import pandas as pd

    content = b"".join(read_bytes(path, most).splitlines(True)[skipped or 0 :])
    # Pandas takes a kilobyte for each column.
    ends = np.flatnonzero(np.frombuffer(content, np.uint8) == ord("\n"))
    longest = np.diff(ends, prepend=-1, append=len(content)).max()
    if longest > LONGEST_ROW:
        raise ConfigError(f"{path}: has a row of more than {LONGEST_ROW:,} bytes")
    with raised_as(ConfigError, f"{path}: not a table of numbers"):
        names = content.partition(b"\n")[0].decode("utf-8-sig").split(",")
        frame = pd.read_csv(
            io.BytesIO(content),
            dtype=np.float64 if skipped is None else None,
            skipinitialspace=True,
            low_memory=False,
        )
        for name in frame.select_dtypes(exclude="number"):
            frame[name] = pd.to_numeric(frame[name], errors="coerce")
    # Pandas would take surplus numbers in the rows for an index, and shift all columns.
    if not isinstance(frame.index, pd.RangeIndex):
        raise ConfigError(f"{path}: its rows have more numbers than its first line has names")
    frame.columns = frame.columns.str.strip()
    if len({*map(str.strip, names)}) < len(names):
        raise ConfigError(f"{path}: its first line names a column twice")
    return frame


def refuse_gaps(path: Path, frame: "pd.DataFrame") -> None:
    """Refuse a table in which a number is missing or not finite.

    :raises ConfigError: the message names the row, counted from 1 after the header, and the column.
    """
    unfit = np.argwhere(~np.isfinite(frame.to_numpy()))
    if len(unfit):
        row, column = unfit[0]
        raise ConfigError(
            f"{path}: row {row + 1}: {frame.columns[column]} is missing, or is not a finite number"
        )


def refuse_falling_times(path: Path, times: "pd.Series[float]") -> None:
    """Refuse times that do not rise from row to row.

    :raises ConfigError: the message names the row, counted from 1 after the header.
    """
    falling = np.flatnonzero(times.diff() <= 0.0)
    if falling.size:
        row = falling[0]
        raise ConfigError(
            f"{path}: row {row + 1}: t is {times[row]:g} after {times[row - 1]:g};"
            " it must rise from row to row"
        )


def interpolated(times: FloatArray, points: FloatArray) -> Motion:
    """Return cubic Hermite splines through points, as a function of time."""
    slopes = np.gradient(points, times, axis=0)

    def motion(t: FloatArray) -> FloatArray:
        after = np.clip(np.searchsorted(times, t, side="right"), 1, len(times) - 1)
        before = after - 1
        width = (times[after] - times[before])[:, None]
        u = (t - times[before])[:, None] / width
        mean = points[before] + u * u * (3.0 - 2.0 * u) * (points[after] - points[before])
        bend = u * (1.0 - u) * width * ((1.0 - u) * slopes[before] - u * slopes[after])
        return np.asarray(mean + bend)

    return motion


def least_snap(points: FloatArray, seconds: FloatArray) -> Motion:
    """Return the motion along polynomials of degree 7 with the least integral of the squared snap.

    :param points: (m + 1, 3), with rest at both ends.
    :param seconds: (m,), from each point to the next.
    """
    m = len(seconds)
    size = _COEFFICIENTS * m
    # Linear equations; each has, for some segments, the factors of their coefficients.
    equations = []
    for k in range(m):
        equations += [{k: _powers(0.0, 0)}, {k: _powers(seconds[k], 0)}]
    # At inner points, the optimum is continuous up to the sixth derivative.
    for k in range(1, m):
        for derivative in range(1, 7):
            ends = {k - 1: _powers(seconds[k - 1], derivative), k: -_powers(0.0, derivative)}
            equations.append(ends)
    for derivative in (1, 2, 3):
        equations += [{0: _powers(0.0, derivative)}, {m - 1: _powers(seconds[-1], derivative)}]
    factors = np.zeros((size, m, _COEFFICIENTS))
    for row, equation in enumerate(equations):
        for segment, powers in equation.items():
            factors[row, segment] = powers
    # Each segment begins at a point and ends at the next; the right-hand sides of the other
    # equations are zero.
    right = np.zeros((size, 3))
    right[: 2 * m] = np.repeat(points, 2, axis=0)[1:-1]
    solution = np.linalg.solve(factors.reshape(size, size), right)
    coefficients = solution.reshape(m, _COEFFICIENTS, 3)
    starts = np.concatenate([[0.0], np.cumsum(seconds)])

    def motion(t: FloatArray) -> FloatArray:
        segment = np.clip(np.searchsorted(starts, t, side="right") - 1, 0, m - 1)
        powers = np.vander(t - starts[segment], _COEFFICIENTS, increasing=True)
        return np.asarray(np.einsum("tk,tka->ta", powers, coefficients[segment]))

    return motion


def _powers(time: float, derivative: int) -> FloatArray:
    """Return the derivative of 1, t, t², … at a time."""
    powers = range(_COEFFICIENTS)
    # The factor is 0 if nothing is left of the power.
    return np.array([math.perm(k, derivative) * time ** max(k - derivative, 0) for k in powers])
