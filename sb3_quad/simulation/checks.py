"""Checks of what users hand to an environment; every message names the thing and what is allowed.

:raises ConfigError: by every function.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sb3_quad.base.arrays import FloatArray, IntArray
from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.simulation.state import BODY_RATES, POSITION, QUATERNION, TARGET, VELOCITY
from sb3_quad.vehicles.vehicle import Vehicle, load_vehicle

START = {"position": POSITION, "quaternion": QUATERNION, "velocity": VELOCITY, "body_rates": BODY_RATES}
"""What a start can fix, and where it lies in a state."""
MAX_SIZE = 2048  # of a picture, pixels


def parse_options(options: Mapping[str, Any] | None, vehicle: Vehicle) -> list[tuple[slice, FloatArray]]:
    """The rows of the state that ``options`` of reset fix, and their values."""
    options = options or {}
    for key in options:
        if key not in ("target", "state"):
            raise ConfigError(f"options: {unknown('key', key, ('target', 'state'))}")
    start = options.get("state") or {}
    if not isinstance(start, Mapping):
        raise ConfigError(f"options: state must map names to values (valid names: {', '.join(START)})")
    fixed = [(TARGET, vector("target", options["target"], 3))] if options.get("target") is not None else []
    for key, value in start.items():
        if key not in START:
            raise ConfigError(f"options: {unknown('state key', key, START)}")
        values = vector(key, value, 4 if key == "quaternion" else 3)
        if key == "quaternion":
            norm = np.linalg.norm(values)
            if norm < 1e-6:
                raise ConfigError("quaternion: must not be zero")
            values = values / norm
        if key == "position" and values[2] <= vehicle.collision_radius:
            raise ConfigError(f"position {values.tolist()}: touches the ground; z must exceed {vehicle.collision_radius} m")
        fixed.append((START[key], values))
    return fixed


def vector(name: str, value: Any, size: int) -> FloatArray:
    """``value`` as finite numbers of shape (size,)."""
    array = _numbers(name, value, f"{size} numbers")
    if array.shape != (size,):
        raise ConfigError(f"{name} of shape {array.shape}: must be ({size},)")
    return array


def per_row(name: str, value: Any, rows: int, size: int | None) -> FloatArray:
    """``value`` of shape (size,) or (rows, size) as (size, rows); with no size, () or (rows,) as (1, rows)."""
    array = _numbers(name, value, "numbers")
    inner = () if size is None else (size,)
    if array.shape not in (inner, (rows, *inner)):
        raise ConfigError(f"{name} of shape {array.shape}: must be {inner}, or {(rows, *inner)} for {rows} rows")
    return np.ascontiguousarray(np.broadcast_to(array, (rows, *inner)).T).reshape(-1, rows)


def _numbers(name: str, value: Any, what: str) -> FloatArray:
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise ConfigError(f"{name} {value!r}: must be {what}") from None
    if not np.isfinite(array).all():
        raise ConfigError(f"{name} {array.tolist()}: every number must be finite")
    return array


def whole_number(name: str, value: Any, least: int = 1, most: int | None = None, unit: str = "") -> int:
    """``value``, a whole number of ``least`` to ``most``."""
    whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if not whole or value < least or (most is not None and value > most):
        limits = f"of at least {least}" if most is None else f"of {least} to {most}"
        raise ConfigError(f"{name} {value!r}: must be a whole number {limits}{unit}")
    return int(value)


def row_numbers(name: str, given: Any, n: int, most: int) -> IntArray:
    """Whole numbers from 1 to ``most`` for n rows, (n,): one for all, or several that are counted round."""
    several = [given] if np.ndim(given) == 0 else [*given]
    if not 0 < len(several) <= n:
        raise ConfigError(f"{name}: {len(several)} numbers for {n} environments; give from one to as many")
    return np.resize(np.array([whole_number(name, each, most=most) for each in several], dtype=np.int64), n)


def row_vehicles(given: Sequence[Any], n: int, layout: str | Vehicle | None = None) -> list[Vehicle]:
    """The vehicles of n rows, given round, whose time steps must agree; in the layout of another, if one is given."""
    if not 0 < len(given) <= n:
        raise ConfigError(f"vehicle: {len(given)} vehicles for {n} environments; give from one to as many")
    loaded = {key: load_vehicle(each) for key, each in {id(each): each for each in given}.items()}  # each file once
    if layout is not None:
        wanted = load_vehicle(layout)
        loaded = {key: each.in_layout_of(wanted) for key, each in loaded.items()}
    vehicles = [loaded[id(each)] for each in given]
    first = vehicles[0]
    for row, each in enumerate(vehicles):
        if (each.physics_step, each.substeps) != (first.physics_step, first.substeps):
            raise ConfigError(f"vehicle of row {row}: physics_step and control_step must be those of row 0")
    return [vehicles[row % len(vehicles)] for row in range(n)]


def check_size(width: int, height: int) -> None:
    """Refuse what is no size of a picture, in pixels."""
    for name, value in (("render_width", width), ("render_height", height)):
        whole_number(name, value, 16, MAX_SIZE, " pixels")
