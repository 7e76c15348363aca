"""Suites of scenarios from YAML files: those of the package by name, your own by path.

With ``vary``, one scenario in the file becomes a grid of scenarios. Their names begin with its own
and a dot.
"""

import copy
import itertools
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.literals import put_key
from sb3_quad.base.types import StrDict, StrMapping, StrPath
from sb3_quad.base.validate import check, validate
from sb3_quad.base.yaml_files import YamlFolder, parse_keys
from sb3_quad.envs.vehicles.vehicle import VEHICLES
from sb3_quad.evaluation.scenarios.scenario import Scenario, Suite

SUITES = YamlFolder("suite", "sb3_quad.evaluation.scenarios.suites")
Values = Annotated[list[int | float], Field(min_length=1)]
Axes = Annotated[dict[str, Values], Field(min_length=1)]


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
    :param folder: what the paths of files are relative to.
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
        for key in entry.keys() & {"vehicle", "vehicles", "reference", "wrench", "wind"}:
            entry[key] = _beside(folder, entry[key])
        # A cell of a grid is a scenario like any other.
        scenarios += [validate(Scenario, cell, place) for cell in grid(entry, place)]
    return validate(Suite, {**data, "scenarios": scenarios}, where)


def _beside(folder: Path, value: Any) -> Any:
    """Return the value of a key, with paths of files relative to the folder."""
    if isinstance(value, dict):
        return {key: _beside(folder, part) for key, part in value.items()}
    if isinstance(value, str) and (VEHICLES.is_path(value) or value.endswith(".csv")):
        return str(folder / value)
    return value


def grid(entry: StrMapping, where: str) -> list[StrDict]:
    """Return the scenarios of one entry: a cell for each combination of the values in ``vary``.

    :param entry: as read from YAML; ``vary`` maps keys such as ``start.tilt`` to lists of
        numbers.
    :raises ConfigError: ``vary`` is not such a mapping, or a key of it is not in the entry.
    """
    if "vary" not in entry:
        return [dict(entry)]
    plain = dict(entry)
    axes = check(Axes, plain.pop("vary"), f"{where}: vary", strict=True)
    cells = []
    for values in itertools.product(*axes.values()):
        # Keys may lead into nested parts, which the cells must not share.
        cell = copy.deepcopy(plain)
        for key, value in zip(axes, values, strict=True):
            put_key(cell, key, value, f"{where}: vary.{key}")
        cell["name"] = f"{plain.get('name')}.{'_'.join(map('{:g}'.format, values))}"
        cells.append(cell)
    return cells
