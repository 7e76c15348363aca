"""Suites of scenarios from YAML files: those of the package by name, one's own by path."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.validate import validate
from sb3_quad.base.yaml_files import YamlFolder, parse_yaml
from sb3_quad.scenarios.scenario import Scenario, Suite
from sb3_quad.scenarios.vary import expand
from sb3_quad.vehicles.vehicle import is_vehicle_file

SUITES = YamlFolder("suite", "sb3_quad.scenarios.suites")


def load_suite(source: str | Path) -> Suite:
    """A suite by name (``"thesis"``) or by the path of a YAML file.

    :raises ConfigError: an unknown name, a missing or unreadable file, an unknown key (the nearest valid one is named), or
        a value that is impossible: a target below ground, say, or beyond reach within the duration.
    """
    text, where = SUITES.text(source)
    return parse_suite(text, where, Path(source).parent if SUITES.is_path(source) else None)


def parse_suite(content: str, where: str, folder: Path | None = None) -> Suite:
    """A suite from YAML text.

    :param where: what messages call the text.
    :param folder: what the paths of vehicle files are relative to.
    :raises ConfigError: see :func:`load_suite`.
    """
    data = parse_yaml(content, where)
    if not isinstance(data, dict) or not isinstance(data.get("scenarios"), list):
        raise ConfigError(f"{where}: must hold 'name' and a list 'scenarios'")
    scenarios: list[Scenario] = []
    for number, entry in enumerate(data["scenarios"]):
        if not isinstance(entry, dict):
            raise ConfigError(f"{where}: scenarios.{number}: must hold keys and values, such as 'name: hover'")
        place = f"{where}: scenario {entry.get('name', number)}"
        scenarios += [validate(Scenario, _with_vehicle_path(cell, folder), place) for cell in expand(entry, place)]
    return validate(Suite, {**data, "scenarios": scenarios}, where)


def _with_vehicle_path(entry: dict[str, Any], folder: Path | None) -> dict[str, Any]:
    vehicle = entry.get("vehicle")
    if folder is None or not isinstance(vehicle, str) or not is_vehicle_file(vehicle):
        return entry
    return {**entry, "vehicle": str(folder / vehicle)}
