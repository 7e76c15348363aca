"""Checks of a user's arguments to an environment. Every message names the argument and the values
that are allowed.

:raises ConfigError: by every function.
"""

import math
from typing import Any

import numpy as np

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.types import FloatArray, IntArray

MAX_SIZE = 2048  # of a picture, pixels


def per_row(name: str, value: Any, rows: int, *size: int) -> FloatArray:
    """Return ``value`` of shape (size,) or (rows, size) as (size, rows); without a size, () or
    (rows,) as (1, rows).
    """
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise ConfigError(f"{name} {value!r}: must be numbers") from None
    if not np.isfinite(array).all():
        raise ConfigError(f"{name} {array.tolist()}: every number must be finite")
    shape = (rows, *size)
    if array.shape not in (size, shape):
        raise ConfigError(
            f"{name} of shape {array.shape}: must be {size}, or {shape} for {rows} rows"
        )
    # Not -1: with zero rows it would be undetermined how many columns there are.
    columns = math.prod(size)
    return np.ascontiguousarray(np.broadcast_to(array, shape).T).reshape(columns, rows)


def whole_number(name: str, value: Any, least: int, most: int) -> int:
    """Return ``value``, a whole number from ``least`` to ``most``."""
    whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if not whole or not least <= value <= most:
        raise ConfigError(f"{name} {value!r}: must be a whole number from {least} to {most}")
    return int(value)


def repeated(name: str, values: int, n: int) -> IntArray:
    """Return which of some values each of n rows has: row i has the i-th; fewer values than rows
    repeat.
    """
    if not 0 < values <= n:
        raise ConfigError(f"{name}: {values} values for {n} environments; give from one to as many")
    return np.arange(n) % values


def check_size(width: int, height: int) -> None:
    """Check the size of a picture, in pixels."""
    for name, value in (("render_width", width), ("render_height", height)):
        whole_number(name, value, 16, MAX_SIZE)
