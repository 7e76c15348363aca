"""One value of the settings at a time: checked against the type it is for, and converted."""

import inspect
import math
from contextlib import suppress
from typing import Any

import gymnasium
from pydantic import ConfigDict, PydanticUserError, TypeAdapter, ValidationError
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnvWrapper

from sb3_quad.base.errors import ConfigError, SB3QuadError
from sb3_quad.base.imports import import_name
from sb3_quad.base.literals import parse_mapping, parse_number, parse_value

BASES: dict[str, type] = {
    "callback": BaseCallback,
    "env_wrapper": gymnasium.Wrapper,
    "vec_env_wrapper": VecEnvWrapper,
}
"""By the key of the settings that names classes, what these must be subclasses of."""


def check(kind: Any, value: Any, where: str) -> Any:
    """``value`` as the type ``kind``, by pydantic.

    :raises ConfigError: it is none; the message says what it must be.
    """
    if isinstance(value, float) and not math.isfinite(value):
        raise ConfigError(f"{where} is {value}, must be finite")
    try:
        adapter = TypeAdapter(
            kind, config=ConfigDict(arbitrary_types_allowed=True, allow_inf_nan=False)
        )
        return adapter.validate_python(value, strict=isinstance(value, bool))  # True is not 1
    except PydanticUserError:  # a type that pydantic does not know how to check
        return value
    except ValidationError as error:
        found = {
            item["type"].partition("_")[0]: item["msg"] for item in error.errors()
        }  # one for each type of a union
    if isinstance(value, str) and "is" in found:
        return value  # the name of a class, which rl_zoo3 imports
    number = "a number or lin_<number>" if "callable" in found else "a number"
    expected = {"greater": "at least 1", "float": number, "int": "a whole number"}
    others = [message.removeprefix("Input should be ") for message in found.values()]
    must_be = next((text for kind, text in expected.items() if kind in found), others[0])
    raise ConfigError(f"{where} is {value!r}, must be {must_be}")


def convert(
    value: Any,
    parameter: inspect.Parameter,
    where: str,
    least: float = -math.inf,
    most: float = math.inf,
) -> Any:
    """``value`` as the constructor's ``parameter`` takes it, whose annotation is a type.

    Strings become literals or, as ``lin_x``, SB3's ``LinearSchedule(x, 0, 1)``, which every SB3 can
    unpickle.

    :param least: the least number that is allowed, also at the start of a schedule; ``most``: the
        greatest.
    :raises ConfigError: text where a number belongs, a fraction where a whole number does, another
        type; NaN or infinity; a number out of range.
    """
    falls = isinstance(value, str) and value.startswith("lin_")
    if falls:
        found = parse_number(value.removeprefix("lin_"))
        if isinstance(found, str) or not math.isfinite(found):
            raise ConfigError(f"{where} is {value!r}, must be lin_ and a number, such as lin_1e-3")
    else:
        found = check(
            parameter.annotation, parse_value(value) if isinstance(value, str) else value, where
        )
    if isinstance(found, (int, float)) and not least <= found <= most:
        limit = f"at least {least:g}" if found < least else f"at most {most:g}"
        raise ConfigError(f"{where} is {value!r}, must be {limit}")
    if not falls:
        return found
    schedule = LinearSchedule(float(found), 0.0, 1.0)
    if not _takes(parameter.annotation, schedule):
        raise ConfigError(f"{where} is {value!r}, but it takes no schedule")
    return schedule


def takes_whole(parameter: inspect.Parameter) -> bool:
    """Whether a constructor's parameter takes whole numbers and no other."""
    return _takes(parameter.annotation, 2) and not _takes(parameter.annotation, 0.5)


def as_list(value: Any) -> Any:
    """A list or tuple as it is, None as an empty list, anything else as the only entry of one."""
    return [] if value is None else value if isinstance(value, (list, tuple)) else [value]


def qualified_classes(value: Any, where: str) -> list[tuple[str, dict[str, Any]]]:
    """``package.module.Class`` and keywords, of rl-zoo's three forms: a name, ``{name: keywords}``,
    or a list of both.

    :raises ConfigError: another form.
    """
    found = []
    for entry in as_list(value):
        form = {entry: None} if isinstance(entry, str) else entry
        if not isinstance(form, dict) or len(form) != 1:
            raise ConfigError(
                f"{where}: {entry!r} must be package.module.Class, or {{package.module.Class: {{…}}}}"
            )
        found += [
            (str(name), parse_mapping(kwargs, f"{where}.{name}")) for name, kwargs in form.items()
        ]
    return found


def import_class(path: str, where: str) -> Any:
    """The class at ``package.module.Class``.

    :param where: the key that names it, one of ``BASES``.
    :raises ConfigError: a module or a name that is not there, or anything but a class of the kind
        that the key is for.
    """
    try:
        found = import_name(path)
    except (Exception, SystemExit) as error:  # whatever the module does when it is imported
        raise ConfigError(
            f"{where}: {path} cannot be imported ({type(error).__name__}: {error})"
        ) from None
    base = BASES[where]
    if not (isinstance(found, type) and issubclass(found, base)):
        raise ConfigError(
            f"{where}: {path} is no {base.__name__}; name a subclass of {base.__module__}.{base.__name__}"
        )
    return found


def instance(path: str, where: str, *arguments: Any, **keywords: Any) -> Any:
    """An instance of the class at ``package.module.Class``.

    :raises ConfigError: as :func:`import_class`; or it does not take these keywords.
    """
    try:
        return import_class(path, where)(*arguments, **keywords)
    except SB3QuadError:
        raise
    except Exception as error:  # a class of the user's may raise anything
        raise ConfigError(
            f"{where}: {path} cannot be made with {keywords} ({type(error).__name__}: {error})"
        ) from error


def _takes(kind: Any, value: Any) -> bool:
    with suppress(ConfigError):
        check(kind, value, "")
        return True
    return False
