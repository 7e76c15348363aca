"""Suites of scenarios from YAML files: those of the package by name, one's own by path.

With ``vary``, one scenario is written down and a grid of them is flown, for heat maps and sweeps.
"""

import copy
import itertools
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.literals import put_key
from sb3_quad.base.validate import validate
from sb3_quad.base.yaml_files import YamlFolder, parse_yaml
from sb3_quad.evaluation.scenarios.scenario import Scenario, Suite
from sb3_quad.vehicles.vehicle import VEHICLES

SUITES = YamlFolder("suite", "sb3_quad.evaluation.scenarios.suites")
UNITS = dict(
    {
        "tilt": "deg",
        "velocity": "m/s",
        "body_rates": "rad/s",
        "force": "N",
        "torque": "N m",
        "distance": "m",
        "start": "s",
    },
    **dict.fromkeys(("mass", "inertia", "motor_gain"), "× the vehicle's own"),
    delay="control steps",
    thrust_to_weight="greatest thrust by weight",
    torque_to_inertia="rad/s²",
    motor_time_constant="s",
    noise="relative std",
    factor="× the wrench",
    gusts="std, N",
    wind="m/s",
    wind_gusts="std, m/s",
    duration="s",
)
WEIGHTS = {
    "force": "weights",
    "torque": "weights × arm length",
}  # units of wrenches whose unit is weight
_SILENT = {"magnitude", "std", "value"}


def load_suite(source: str | Path) -> Suite:
    """A suite by name (``"thesis"``) or by the path of a YAML file.

    :raises ConfigError: an unknown name, a missing or unreadable file, an unknown key (the nearest
        valid one is named), or a value that is impossible: a target below ground, say.
    """
    text, where = SUITES.text(source)
    return parse_suite(text, where, Path(source).parent if SUITES.is_path(source) else Path())


def parse_suite(content: str, where: str, folder: Path = Path()) -> Suite:
    """A suite from YAML text.

    :param where: what messages call the text.
    :param folder: what the paths of vehicle files are relative to.
    :raises ConfigError: see :func:`load_suite`.
    """
    data = parse_yaml(content, where)
    entries = data.get("scenarios") if isinstance(data, dict) else None
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise ConfigError(
            f"{where}: must hold 'name' and a list 'scenarios', each with keys and values"
        )
    scenarios: list[Scenario] = []
    for number, entry in enumerate(entries):
        place, vehicle = f"{where}: scenario {entry.get('name', number)}", entry.get("vehicle")
        if isinstance(vehicle, str) and VEHICLES.is_path(vehicle):
            entry = {**entry, "vehicle": str(folder / vehicle)}
        scenarios += [validate(Scenario, cell, place) for cell in expand(entry, place)]
    return validate(Suite, {**data, "scenarios": scenarios}, where)


def expand(entry: Mapping[str, Any], where: str) -> list[dict[str, Any]]:
    """The scenarios that one entry of a suite stands for: itself, or a cell for each combination of
    ``vary``'s values.

    :param entry: as YAML gives it; ``vary`` maps keys such as ``start.attitude.tilt`` to lists of
        numbers.
    :raises ConfigError: ``vary`` is no such mapping, or names no place in the entry.
    """
    plain = {key: value for key, value in entry.items() if key != "vary"}
    if "vary" not in entry:
        return [plain]
    if not isinstance(entry["vary"], Mapping) or not entry["vary"]:
        raise ConfigError(
            f"{where}: vary must map keys to lists of numbers, such as 'noise: [0, 0.05, 0.1]'"
        )
    axes = {str(key): values for key, values in entry["vary"].items()}
    for key, values in axes.items():
        numbers = isinstance(values, list) and all(
            type(each) in (int, float) and math.isfinite(each) for each in values
        )
        if not numbers or not values or len(set(values)) != len(values):
            raise ConfigError(
                f"{where}: vary.{key} must be a list of different numbers, not {values!r}"
            )
    cells = []
    for values in itertools.product(*axes.values()):
        cell, varied = copy.deepcopy(plain), dict(zip(axes, values, strict=True))
        for key, value in varied.items():
            put_key(cell, key, value, f"{where}: vary.{key}")
        title = ", ".join(f"{axis_name(key)} {value:g}" for key, value in varied.items())
        cell["title"] = f"{plain.get('title') or plain.get('name')}: {title}"
        cell["group"] = plain.get("name")
        cell["name"] = f"{plain.get('name')}.{'_'.join(f'{value:g}' for value in values)}"
        cell["cell"] = varied
        cells.append(cell)
    return cells


def axis_name(key: str) -> str:
    """The short name of a varied key: ``start.body_rates.magnitude`` is ``body_rates``."""
    parts = [part for part in key.split(".") if part not in _SILENT and not part.isdigit()]
    return parts[-1]


def axis_label(key: str, scenario: Scenario | None = None) -> str:
    """The name of a varied key with its unit, as the axes of plots carry it.

    :param scenario: one of those that vary, which says the unit of its wrenches; None: they are in
        SI units.
    """
    name = axis_name(key)
    words, unit = name.replace("_", " "), UNITS.get(name)
    if (
        name in WEIGHTS
        and scenario is not None
        and scenario.wrenches[int(key.split(".")[1])].unit == "weight"
    ):
        unit = WEIGHTS[name]
    return f"{words} ({unit})" if unit else words
