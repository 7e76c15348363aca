"""``vary``: one scenario written down, a grid of them flown; for heat maps and sweeps."""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Mapping
from typing import Any

from sb3_quad.base.errors import ConfigError

MAX_CELLS = 1000
_UNITS = dict(
    {"tilt": "deg", "velocity": "m/s", "body_rates": "rad/s", "force": "N", "torque": "N m", "distance": "m", "start": "s"},
    **dict.fromkeys(("mass", "inertia", "motor_gain"), "× the vehicle's own"),
    delay="control steps",
    noise="relative std",
    duration="s",
)
_SILENT = {"magnitude", "std", "value"}


def axis_name(key: str) -> str:
    """The short name of a varied key: ``start.body_rates.magnitude`` is ``body_rates``."""
    parts = [part for part in key.split(".") if part not in _SILENT and not part.isdigit()]
    return parts[-1]


def axis_label(key: str) -> str:
    """The name of a varied key with its unit, as the axes of plots carry it."""
    name = axis_name(key)
    return f"{name} ({_UNITS[name]})" if name in _UNITS else name


def expand(entry: Mapping[str, Any], where: str) -> list[dict[str, Any]]:
    """The scenarios that one entry of a suite stands for: itself, or a cell for each combination of ``vary``'s values.

    :param entry: as YAML gives it; ``vary`` maps keys such as ``start.attitude.tilt`` to lists of numbers.
    :raises ConfigError: ``vary`` is no such mapping, names no place in the entry, or has too many combinations.
    """
    plain = {key: value for key, value in entry.items() if key != "vary"}
    if "vary" not in entry:
        return [plain]
    axes = entry["vary"]
    if not isinstance(axes, Mapping) or not axes:
        raise ConfigError(f"{where}: vary must map keys to lists of numbers, such as 'noise: [0, 0.05, 0.1]'")
    for key, values in axes.items():
        numbers = isinstance(values, list) and all(type(each) in (int, float) and math.isfinite(each) for each in values)
        if not numbers or not values or len(set(values)) != len(values):
            raise ConfigError(f"{where}: vary.{key} must be a list of different numbers, not {values!r}")
    count = math.prod(len(values) for values in axes.values())
    if count > MAX_CELLS:
        raise ConfigError(f"{where}: vary has {count} combinations, at most {MAX_CELLS} are allowed")
    cells = []
    for values in itertools.product(*axes.values()):
        cell = copy.deepcopy(plain)
        for key, value in zip(axes, values, strict=True):
            _put(cell, str(key), value, where)
        names = [f"{axis_name(str(key))} {value:g}" for key, value in zip(axes, values, strict=True)]
        cell["title"] = f"{plain.get('title') or plain.get('name')}: {', '.join(names)}"
        cell["group"] = plain.get("name")
        cell["name"] = f"{plain.get('name')}.{'_'.join(f'{value:g}' for value in values)}"
        cell["cell"] = {str(key): float(value) for key, value in zip(axes, values, strict=True)}
        cells.append(cell)
    return cells


def _put(entry: dict[str, Any], key: str, value: Any, where: str) -> None:
    *path, last = key.split(".")
    place: Any = entry
    for part in path:
        if isinstance(place, list) and part.isdigit() and int(part) < len(place):
            place = place[int(part)]
        else:
            place = place.setdefault(part, {}) if isinstance(place, dict) else None
    if not isinstance(place, dict):
        raise ConfigError(f"{where}: vary.{key}: {'.'.join(path)} holds no keys here")
    place[last] = value
