"""Operations on a time series: times, s, and values, (samples, 1 + columns)."""

import numpy as np
from scipy.ndimage import uniform_filter1d

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.types import BoolArray, FloatArray
from sb3_quad.base.validate import LARGEST

# Longer gaps between rows are not filled, s
LONGEST_GAP = 0.05


def cleaned(name: str, table: FloatArray, notes: list[str]) -> FloatArray:
    """Return a series without rows that are not finite, or are of the same time.

    :param name: of the series, for messages.
    :param notes: gets a line on rows without numbers.
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


def interpolated(series: FloatArray, grid: FloatArray) -> FloatArray:
    """Return values at the times of a grid, (n, columns)."""
    time, *columns = series.T
    return np.stack([np.interp(grid, time, column) for column in columns], axis=1)


def averaged(series: FloatArray, step: float) -> FloatArray:
    """Return running means over about a step."""
    apart = np.median(np.diff(series[:, 0]))
    samples = step // apart // 2 * 2 + 1
    return np.asarray(uniform_filter1d(series, int(samples), axis=0))


def without_gaps(series: FloatArray, grid: FloatArray) -> BoolArray:
    """Whether each row of a grid lies between two samples that are close, (n,)."""
    time = series[:, 0]
    gaps = np.diff(time, prepend=-np.inf, append=np.inf)
    after = np.searchsorted(time, grid, side="right")
    return np.asarray(gaps[after] < LONGEST_GAP)


def means_of_steps(commands: FloatArray, begins: FloatArray, step: float) -> FloatArray:
    """Return the mean of each step of commands that are held until the next one, (n, columns).

    :param begins: of the steps, at regular times, (n,), s.
    """
    lasting = np.diff(commands[:, :1], axis=0)
    areas = np.zeros_like(commands)
    areas[:, 0] = commands[:, 0]
    areas[1:, 1:] = np.cumsum(lasting * commands[:-1, 1:], axis=0)
    edges = np.append(begins, begins[-1] + step)
    return np.asarray(np.diff(interpolated(areas, edges), axis=0) / step)
