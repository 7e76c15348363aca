"""Checks of a user's arguments to an environment. Every message names the argument and the values
that are allowed.

:raises ConfigError: by every function.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.types import FloatArray
from sb3_quad.vehicles.vehicle import Vehicle, load_vehicle

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
    # Not -1: without rows there would be no telling how many columns there are.
    columns = math.prod(size)
    return np.ascontiguousarray(np.broadcast_to(array, shape).T).reshape(columns, rows)


def whole_number(name: str, value: Any, least: int, most: int, unit: str = "") -> int:
    """Return ``value``, a whole number of ``least`` to ``most``."""
    whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if not whole or not least <= value <= most:
        raise ConfigError(f"{name} {value!r}: must be a whole number of {least} to {most}{unit}")
    return int(value)


def repeated(name: str, values: Sequence[Any], n: int) -> list[Any]:
    """Return the values of n rows: row i has the i-th, and fewer values than rows repeat."""
    if not 0 < len(values) <= n:
        raise ConfigError(
            f"{name}: {len(values)} values for {n} environments; give from one to as many"
        )
    return [values[row % len(values)] for row in range(n)]


def load_vehicles(
    sources: Sequence[Any], layout: str | Path | Vehicle | None = None
) -> list[Vehicle]:
    """Return vehicles with the same time steps, in the layout of another vehicle if one is
    named.
    """
    vehicles: list[Vehicle] = []
    for row, source in enumerate(sources):
        vehicle = load_vehicle(source)
        if layout is not None:
            vehicle = vehicle.in_layout_of(load_vehicle(layout))
        vehicles.append(vehicle)
        first = vehicles[0]
        if (vehicle.physics_step, vehicle.substeps) != (first.physics_step, first.substeps):
            raise ConfigError(
                f"vehicle of row {row}: physics_step and control_step must be those of row 0"
            )
    return vehicles


def check_size(width: int, height: int) -> None:
    """Check the size of a picture, in pixels."""
    for name, value in (("render_width", width), ("render_height", height)):
        whole_number(name, value, 16, MAX_SIZE, " pixels")
