"""Suites of scenarios from YAML files: those of the package by name, your own by path.

With ``vary``, one scenario in the file becomes a grid of scenarios, for heat maps and sweeps.
"""

import copy
import itertools
import math
from collections.abc import Mapping
from pathlib import Path

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.literals import put_key
from sb3_quad.base.types import StrDict, StrMapping, StrPath
from sb3_quad.base.validate import validate
from sb3_quad.base.yaml_files import YamlFolder, parse_keys
from sb3_quad.envs.vehicles.vehicle import VEHICLES
from sb3_quad.evaluation.scenarios.scenario import Scenario, Suite

SUITES = YamlFolder("suite", "sb3_quad.evaluation.scenarios.suites")
OF_VEHICLE = "× the vehicle's own"
UNITS = {
    "tilt": "deg",
    "velocity": "m/s",
    "body_rates": "rad/s",
    "force": "N",
    "torque": "N m",
    "distance": "m",
    "start": "s",
    "duration": "s",
    "factor": "× the wrench",
    "mass": OF_VEHICLE,
    "inertia": OF_VEHICLE,
    "motor_gain": OF_VEHICLE,
    "delay": "control steps",
    "thrust_to_weight": "greatest thrust by weight",
    "torque_to_inertia": "rad/s²",
    "motor_time_constant": "s",
    "noise": "relative std",
    "speed": "m/s",
    "gusts": "std, N",
    "wind": "m/s",
    "wind_gusts": "std, m/s",
}
# The units of wrenches with `unit: weight`.
WEIGHTS = {"force": "weights", "torque": "weights × arm length"}
# The types that the values of an axis may have.
NUMBERS = ({int}, {float}, {int, float})
# Parts of a key that its short name does not need.
_SILENT = {"magnitude", "std", "value"}


def load_suite(source: StrPath) -> Suite:
    """Read a suite by name (``"thesis"``) or by the path of a YAML file.

    :raises ConfigError: an unknown name, a missing or unreadable file, an unknown key (the nearest
        valid one is named), or an impossible value, such as a target below ground.
    """
    text, where = SUITES.text(source)
    return parse_suite(text, where, Path(source).parent if SUITES.is_path(source) else Path())


def parse_suite(content: str, where: str, folder: Path = Path()) -> Suite:
    """Read a suite from YAML text.

    :param where: what messages call the text.
    :param folder: what the paths of vehicle files are relative to.
    :raises ConfigError: see :func:`load_suite`.
    """
    data = parse_keys(content, where)
    entries = data.get("scenarios")
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise ConfigError(
            f"{where}: must hold 'name' and a list 'scenarios', each with keys and values"
        )
    scenarios = []
    for number, entry in enumerate(entries):
        place = f"{where}: scenario {entry.get('name', number)}"
        if "vehicle" in entry:
            entry["vehicle"] = _beside(folder, entry["vehicle"])
        reference = entry.get("reference")
        if isinstance(reference, dict) and "file" in reference:
            entry["reference"] = {**reference, "file": folder / str(reference["file"])}
        elif str(reference).endswith(".csv"):
            entry["reference"] = folder / str(reference)
        vehicles = entry.get("vehicles")
        if isinstance(vehicles, dict) and "distribution" in vehicles:
            distribution = _beside(folder, vehicles["distribution"])
            entry["vehicles"] = {**vehicles, "distribution": distribution}
        elif vehicles is not None:
            entry["vehicles"] = _beside(folder, vehicles)
        # A cell of a grid is a scenario like any other.
        scenarios += [validate(Scenario, cell, place) for cell in grid(entry, place)]
    return validate(Suite, {**data, "scenarios": scenarios}, where)


def _beside(folder: Path, source: object) -> object:
    """Return the path of a file that is named relative to a folder; a name is returned as it is."""
    if isinstance(source, str) and VEHICLES.is_path(source):
        return str(folder / source)
    return source


def grid(entry: StrMapping, where: str) -> list[StrDict]:
    """Return the scenarios of one entry: a cell for each combination of the values in ``vary``.

    Without ``vary``, this is only the entry itself.

    :param entry: as read from YAML; ``vary`` maps keys such as ``start.attitude.tilt`` to lists of
        numbers.
    :raises ConfigError: ``vary`` is not such a mapping, or a key of it is not in the entry.
    """
    if "vary" not in entry:
        return [dict(entry)]
    plain = dict(entry)
    axes = plain.pop("vary")
    if not isinstance(axes, dict) or not axes:
        raise ConfigError(
            f"{where}: vary must map keys to lists of numbers, such as 'noise: [0, 0.05, 0.1]'"
        )
    for key, values in axes.items():
        # A bool is an int to Python, but not a number to a reader.
        numbers = isinstance(values, list) and {*map(type, values)} in NUMBERS
        if not numbers or len({*values}) < len(values) or not all(map(math.isfinite, values)):
            raise ConfigError(
                f"{where}: vary.{key} must be a list of different numbers, not {values!r}"
            )
    cells = []
    for values in itertools.product(*axes.values()):
        # Keys may lead into nested parts, which the cells must not share.
        cell = copy.deepcopy(plain)
        varied = dict(zip(map(str, axes), values, strict=True))
        for key, value in varied.items():
            put_key(cell, key, value, f"{where}: vary.{key}")
        name = plain.get("name")
        cell |= {
            "cell": varied,
            "group": name,
            "title": f"{plain.get('title') or name}: {', '.join(axis_values(varied))}",
            "name": f"{name}.{'_'.join(map('{:g}'.format, values))}",
        }
        cells.append(cell)
    return cells


def axis_name(key: str) -> str:
    """Return the short name of a varied key: ``start.body_rates.magnitude`` is ``body_rates``."""
    parts = [part for part in key.split(".") if part not in _SILENT and not part.isdigit()]
    return parts[-1] if parts else key


def axis_values(cell: Mapping[str, float]) -> list[str]:
    """Return the short names of varied keys, each with its value."""
    return [f"{axis_name(key)} {value:g}" for key, value in cell.items()]


def axis_label(key: str, scenario: Scenario | None = None) -> str:
    """Return the name of a varied key with its unit, for the axes of plots.

    :param scenario: one of the cells, whose wrenches decide about the unit; None: SI.
    """
    name = axis_name(key)
    unit = UNITS.get(name)
    # The unit of a wrench may differ from scenario to scenario.
    if scenario is not None and key.startswith("wrenches."):
        wrench = scenario.wrenches[int(key.split(".")[1])]
        if wrench.unit == "weight":
            unit = WEIGHTS.get(name, unit)
    label = name.replace("_", " ")
    return f"{label} ({unit})" if unit else label
