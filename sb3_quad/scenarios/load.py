"""Suites of scenarios from YAML files: those of the package by name, one's own by path."""

from __future__ import annotations

import typing
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ValidationError

from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.scenarios.scenario import Scenario, Suite
from sb3_quad.scenarios.vary import expand


def suite_names() -> list[str]:
    """The suites that come with the package."""
    folder = resources.files("sb3_quad.scenarios.suites")
    return sorted(entry.name.removesuffix(".yaml") for entry in folder.iterdir() if entry.name.endswith(".yaml"))


def load_suite(source: str | Path) -> Suite:
    """A suite by name (``"thesis"``) or by the path of a YAML file.

    :raises ConfigError: an unknown name, a missing or unreadable file, an unknown key (the nearest valid one is named), or
        a value that is impossible: a target below ground, say, or beyond reach within the duration.
    """
    text = str(source)
    if isinstance(source, Path) or text.endswith((".yaml", ".yml")) or "/" in text:
        path = Path(text)
        if not path.is_file():
            raise ConfigError(f"suite {text}: no such file")
        try:
            content = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"suite {text}: cannot be read ({error})") from None
        return parse_suite(content, text, path.parent)
    if text not in suite_names():
        raise ConfigError(unknown("suite", text, suite_names()) + ", or the path of a .yaml file")
    content = resources.files("sb3_quad.scenarios.suites").joinpath(f"{text}.yaml").read_text(encoding="utf-8")
    return parse_suite(content, f"{text}.yaml")


def parse_suite(content: str, where: str, folder: Path | None = None) -> Suite:
    """A suite from YAML text.

    :param where: what messages call the text.
    :param folder: what the paths of vehicle files are relative to.
    :raises ConfigError: see :func:`load_suite`.
    """
    try:
        data = yaml.safe_load(content)
    except yaml.YAMLError as error:
        raise ConfigError(f"{where}: not valid YAML ({' '.join(str(error).split())})") from None
    if not isinstance(data, dict) or not isinstance(data.get("scenarios"), list):
        raise ConfigError(f"{where}: must hold 'name' and a list 'scenarios'")
    scenarios = []
    for number, entry in enumerate(data["scenarios"]):
        if not isinstance(entry, dict):
            raise ConfigError(f"{where}: scenarios.{number}: must hold keys and values, such as 'name: hover'")
        place = f"{where}: scenario {entry.get('name', number)}"
        scenarios += [_scenario(cell, place, folder) for cell in expand(entry, place)]
    try:
        return Suite.model_validate({**data, "scenarios": scenarios})
    except ValidationError as error:
        raise ConfigError(f"{where}: {explain(error, Suite)}") from None


def _scenario(entry: dict[str, Any], where: str, folder: Path | None) -> Scenario:
    vehicle = entry.get("vehicle")
    if isinstance(vehicle, str) and folder is not None and vehicle.endswith((".yaml", ".yml")):
        entry = {**entry, "vehicle": str(folder / vehicle)}
    try:
        return Scenario.model_validate(entry)
    except ValidationError as error:
        raise ConfigError(f"{where}: {explain(error, Scenario)}") from None


def explain(error: ValidationError, model: type[BaseModel]) -> str:
    """What is wrong, in one line: each key with what is wrong about it, what it means, and the nearest valid key."""
    found: dict[str, str] = {}
    for item in error.errors():
        inside, names, meaning = _walk(model, item["loc"])
        key = ".".join(names)
        if item["type"] == "extra_forbidden":
            message = (f"{key}: " if key else "") + unknown("key", item["loc"][-1], inside.model_fields)
        else:
            message = (f"{key}: " if key else "") + _message(item) + (f" ({meaning})" if meaning else "")
        found.setdefault(key, message)  # of a union only the first alternative
    return "; ".join(found.values())


def _message(item: Mapping[str, Any]) -> str:
    given = item["input"]
    if str(item["type"]).startswith(("float_", "int_")) and isinstance(given, str):
        return f"{given!r} must be a number alone, its unit left out"
    if item["type"] == "missing":
        return "is missing"
    return str(item["msg"]).removeprefix("Value error, ")


def _walk(model: type[BaseModel], location: tuple[int | str, ...]) -> tuple[type[BaseModel], list[str], str]:
    """The innermost model a location leads to, its keys (names of a union's alternatives left out), the last one's meaning."""
    names: list[str] = []
    meaning = ""
    for part in location:
        if isinstance(part, int):
            names.append(str(part))
        elif part in model.model_fields:
            field = model.model_fields[part]
            names.append(part)
            meaning = field.description or ""
            model = _model_in(field.annotation) or model
    return model, names, meaning


def _model_in(annotation: Any) -> type[BaseModel] | None:
    if typing.get_origin(annotation) is None:
        return annotation if isinstance(annotation, type) and issubclass(annotation, BaseModel) else None
    return next((found for entry in typing.get_args(annotation) if (found := _model_in(entry)) is not None), None)
