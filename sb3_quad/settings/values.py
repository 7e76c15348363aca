"""One value of the settings at a time: checked against what it is for, and converted."""

from __future__ import annotations

import importlib
import inspect
import math
import re
from typing import Any

from sb3_quad.base.errors import ConfigError
from sb3_quad.settings.literals import parse_mapping, parse_number

_LINEAR = re.compile(r"lin_(.+)")


def positive_whole(value: Any, where: str) -> int:
    """``value`` as a whole number of at least 1; ``1e6`` will do.

    :raises ConfigError: anything else.
    """
    number = parse_number(value)
    if isinstance(number, bool) or not isinstance(number, (int, float)) or not math.isfinite(number) or number != int(number):
        raise ConfigError(f"{where} is {value!r}, must be a whole number")
    if number < 1:
        raise ConfigError(f"{where} is {value!r}, must be at least 1")
    return int(number)


def convert(value: Any, parameter: inspect.Parameter, where: str) -> Any:
    """``value`` as the constructor's ``parameter`` takes it.

    Strings become numbers or, as ``lin_x``, SB3's ``LinearSchedule(x, 0, 1)``, which every SB3 can unpickle.

    :raises ConfigError: text where a number belongs, a fraction where a whole number does, NaN or infinity.
    """
    kinds = _kinds(parameter)
    value = parse_number(value)
    if isinstance(value, str) and (match := _LINEAR.fullmatch(value)):
        return _linear(match.group(1), kinds, where)
    numeric = kinds & {"int", "float"}
    if isinstance(value, str) and numeric and not kinds & {"str", "Any", "dict", "type"}:
        raise ConfigError(f"{where} is {value!r}, must be a number{' or lin_<number>' if 'Schedule' in kinds else ''}")
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return value
    if not math.isfinite(value):
        raise ConfigError(f"{where} is {value}, must be finite")
    if takes_whole(parameter):
        if value != int(value):
            raise ConfigError(f"{where} is {value}, must be a whole number")
        return int(value)
    return value


def takes_whole(parameter: inspect.Parameter) -> bool:
    """Whether a constructor's parameter takes whole numbers and no other."""
    kinds = _kinds(parameter)
    return kinds & {"int", "float"} == {"int"} and not kinds & {"Schedule", "Any"}


def qualified_classes(value: Any, where: str) -> list[tuple[str, dict[str, Any]]]:
    """``package.module.Class`` and keywords, of rl-zoo's three forms: a name, ``{name: keywords}``, or a list of both.

    :raises ConfigError: another form.
    """
    if value is None or value == []:
        return []
    found: list[tuple[str, dict[str, Any]]] = []
    for entry in value if isinstance(value, list) else [value]:
        if isinstance(entry, str):
            found.append((entry, {}))
        elif isinstance(entry, dict) and len(entry) == 1:
            (name, kwargs) = next(iter(entry.items()))
            found.append((str(name), parse_mapping(kwargs, f"{where}.{name}")))
        else:
            raise ConfigError(f"{where}: {entry!r} must be package.module.Class, or {{package.module.Class: {{…}}}}")
    return found


def import_class(path: str, where: str) -> Any:
    """The class at ``package.module.Class``.

    :raises ConfigError: a module or a name that is not there.
    """
    module, _, attribute = path.rpartition(".")
    try:
        return getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(f"{where}: {path} cannot be imported ({error})") from None


def _linear(text: str, kinds: set[str], where: str) -> Any:
    from stable_baselines3.common.utils import LinearSchedule

    start = parse_number(text)
    if isinstance(start, str) or not math.isfinite(start):
        raise ConfigError(f"{where} is 'lin_{text}', must be lin_ and a number, such as lin_1e-3")
    if "Schedule" not in kinds:
        raise ConfigError(f"{where} is 'lin_{text}', but it takes no schedule")
    return LinearSchedule(float(start), 0.0, 1.0)


def _kinds(parameter: inspect.Parameter) -> set[str]:
    """The type names in a parameter's annotation, however it is spelled; schedules as ``Schedule``."""
    annotation = parameter.annotation
    if annotation is inspect.Parameter.empty:
        return {"Any"}
    text = annotation.__name__ if isinstance(annotation, type) else str(annotation)
    kinds = set(re.findall(r"\w+", text))
    return kinds | {"Schedule"} if kinds & {"Callable", "FloatSchedule"} else kinds
