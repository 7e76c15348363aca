"""Validated data: one base class for records and settings, and errors of one line."""

import json
import typing
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic.fields import FieldInfo

from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.base.files import read_text

Model = TypeVar("Model", bound=BaseModel)


class Frozen(BaseModel):
    """A record: frozen, with finite numbers and no unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def validate(model: type[Model], data: Any, where: str | Callable[[str], str]) -> Model:
    """``data`` as a ``model``.

    :param where: what the message calls the data, such as the name of its file; or gives that for a
        key.
    :raises ConfigError: something does not fit; one line names each key, what is wrong, and the
        nearest valid key. Where all that is wrong is an error of a kind of its own, such as
        :class:`CannotHover`, that kind is raised.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        kinds = {type(item.get("ctx", {}).get("error")) for item in error.errors()}
        kind = next(
            (each for each in kinds if len(kinds) == 1 and issubclass(each, ConfigError)),
            ConfigError,
        )
        place = (
            where if isinstance(where, str) else where(str((error.errors()[0]["loc"] or ("",))[0]))
        )
        raise kind(f"{place}: {explain(error, model)}") from None


def read_record(path: Path, model: type[Model]) -> Model:
    """The record in a JSON file.

    :raises ConfigError: the file is missing, holds no JSON, or no such record.
    """
    text = read_text(path)
    try:
        return validate(model, json.loads(text), "damaged, or of another version")
    except (ValueError, RecursionError) as error:  # no JSON, or no such record
        raise ConfigError(f"{path}: {error}; name another folder, or remove it") from None


def explain(error: ValidationError, model: type[BaseModel]) -> str:
    """What is wrong, in one line: each key with what is wrong about it, what it means, and the
    nearest valid key.
    """
    found: dict[str, str] = {}
    for item in error.errors():
        inside, names, meaning = _walk(model, item["loc"])
        key = ".".join(names)
        if item["type"] == "extra_forbidden":
            text = unknown("key", item["loc"][-1], _fields(inside))
        else:
            text = _message(item) + (f" ({meaning})" if meaning else "")
        found.setdefault(
            key, text if text.startswith(key) else f"{key}: {text}"
        )  # of a union only the first alternative
    return "; ".join(found.values())


def _message(item: Mapping[str, Any]) -> str:
    given = item["input"]
    if str(item["type"]).startswith(("float_", "int_")) and isinstance(given, str):
        return f"{given!r} must be a number alone, its unit left out"
    if item["type"] == "missing":
        return "is missing"
    return str(item["msg"]).removeprefix("Value error, ")


def _walk(
    model: type[BaseModel], location: tuple[int | str, ...]
) -> tuple[type[BaseModel], list[str], str]:
    """The innermost model a location leads to, its keys (names of a union's alternatives left out),
    the last one's meaning.
    """
    names: list[str] = []
    meaning = ""
    for part in location:
        if isinstance(part, int):
            names.append(str(part))
        elif part in _fields(model):
            field = _fields(model)[part]
            names.append(part)
            meaning = field.description or ""
            model = _model_in(field.annotation) or model
    return model, names, meaning


def _fields(model: type[BaseModel]) -> dict[str, FieldInfo]:
    """The fields of a model by the keys that its data have."""
    return {
        str(field.validation_alias or name): field for name, field in model.model_fields.items()
    }


def _model_in(annotation: Any) -> type[BaseModel] | None:
    if typing.get_origin(annotation) is None:
        return (
            annotation
            if isinstance(annotation, type) and issubclass(annotation, BaseModel)
            else None
        )
    return next(
        (found for entry in typing.get_args(annotation) if (found := _model_in(entry)) is not None),
        None,
    )
