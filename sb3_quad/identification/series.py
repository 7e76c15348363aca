"""Operations on a time series: times, s, and values, (samples, 1 + columns)."""

import numpy as np
from scipy.ndimage import uniform_filter1d

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.types import BoolArray, FloatArray

# Longer gaps between rows are not filled, s
LONGEST_GAP = 0.05


def cleaned(name: str, table: FloatArray, largest: float, notes: list[str]) -> FloatArray:
    """Return a series without rows that hold no numbers, or glitches, or are of the same time.

    :param name: of the series, for messages.
    :param largest: number that is no glitch.
    :param notes: gets a line on rows that are skipped.
    :raises ConfigError: hardly a row is left, times fall or are no seconds.
    """
    time, *columns = np.abs(table).T
    known = np.isfinite(time) & (np.max(columns, axis=0) <= largest)
    rows: FloatArray = table[known]
    missing = len(table) - len(rows)
    unknown = f"no number up to {largest:g}"
    if len(rows) < max(2, missing):
        raise ConfigError(f"{name}: {missing} of {len(table)} rows hold {unknown}; check its unit")
    if missing:
        notes.append(f"{name}: {missing} of {len(table)} rows hold {unknown}, and are skipped")
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
    return rows[steps > 0.0]


def interpolated(series: FloatArray, grid: FloatArray) -> FloatArray:
    """Return values at the times of a grid, (n, columns)."""
    time, *columns = series.T
    values = [np.interp(grid, time, column) for column in columns]
    return np.array(values).T


def averaged(series: FloatArray, step: float) -> FloatArray:
    """Return running means over about a step."""
    apart = np.median(np.diff(series[:, 0]))
    half = int(step / apart / 2.0 + 1e-6)
    means: FloatArray = uniform_filter1d(series, 2 * half + 1, axis=0)
    return means


def without_gaps(series: FloatArray, grid: FloatArray) -> BoolArray:
    """Whether each row of a grid lies between two samples that are close, (n,)."""
    time = series[:, 0]
    gaps = np.diff(time, prepend=-np.inf, append=np.inf)
    after = np.searchsorted(time, grid, "right")
    near: BoolArray = gaps[after] < LONGEST_GAP
    return near


def means_of_steps(commands: FloatArray, begins: FloatArray, step: float) -> FloatArray:
    """Return the mean of each step of commands that are held until the next one, (n, columns).

    :param begins: of the steps, at regular times, (n,), s.
    """
    held = np.diff(commands[:, :1], axis=0)
    areas = commands.copy()
    areas[0, 1:] = 0.0
    areas[1:, 1:] = np.cumsum(held * commands[:-1, 1:], axis=0)
    edges = np.append(begins, begins[-1] + step)
    return np.diff(interpolated(areas, edges), axis=0) / step
