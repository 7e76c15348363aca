"""Checks of what users hand to an environment; every message names the thing and what is allowed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.simulation.state import BODY_RATES, POSITION, QUATERNION, TARGET, VELOCITY
from sb3_quad.vehicles.vehicle import Vehicle

FloatArray = npt.NDArray[np.float64]
_START = {"position": POSITION, "quaternion": QUATERNION, "velocity": VELOCITY, "body_rates": BODY_RATES}
MAX_SIZE = 2048  # of a picture, pixels


def check_options(options: Mapping[str, Any] | None, vehicle: Vehicle) -> list[tuple[slice, FloatArray]]:
    """The rows of the state that ``options`` of reset fix, and their values."""
    options = options or {}
    for key in options:
        if key not in ("target", "state"):
            raise ConfigError(f"options: {unknown('key', key, ('target', 'state'))}")
    start = options.get("state") or {}
    if not isinstance(start, Mapping):
        raise ConfigError(f"options: state must map names to values (valid names: {', '.join(_START)})")
    fixed = [(TARGET, vector("target", options["target"], 3))] if options.get("target") is not None else []
    for key, value in start.items():
        if key not in _START:
            raise ConfigError(f"options: {unknown('state key', key, _START)}")
        values = vector(key, value, 4 if key == "quaternion" else 3)
        if key == "quaternion":
            norm = np.linalg.norm(values)
            if norm < 1e-6:
                raise ConfigError("quaternion: must not be zero")
            values = values / norm
        if key == "position" and values[2] <= vehicle.collision_radius:
            raise ConfigError(f"position {values.tolist()}: touches the ground; z must exceed {vehicle.collision_radius} m")
        fixed.append((_START[key], values))
    return fixed


def vector(name: str, value: npt.ArrayLike, size: int) -> FloatArray:
    """``value`` as finite numbers of shape (size,)."""
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise ConfigError(f"{name} {value!r}: must be {size} numbers") from None
    if array.shape != (size,):
        raise ConfigError(f"{name} of shape {array.shape}: must be ({size},)")
    if not np.isfinite(array).all():
        raise ConfigError(f"{name} {array.tolist()}: every number must be finite")
    return array


def check_size(width: int, height: int) -> None:
    """Refuse what is no size of a picture.

    :raises ConfigError: names the argument.
    """
    for name, value in (("render_width", width), ("render_height", height)):
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not 16 <= value <= MAX_SIZE:
            raise ConfigError(f"{name} {value!r}: must be a whole number of 16 to {MAX_SIZE} pixels")
