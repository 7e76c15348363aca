"""Values from YAML and the command line: literals and a few named classes, never evaluated as code."""

from __future__ import annotations

import ast
import importlib
import re
from typing import Any

from sb3_quad.base.errors import ConfigError, unknown

_NUMBER = re.compile(r"[+-]?(\d[\d_]*\.?\d*|\.\d+)([eE][+-]?\d+)?")
_ACTIVATIONS = ("ELU", "GELU", "Hardtanh", "LeakyReLU", "Mish", "ReLU", "ReLU6", "SELU", "Sigmoid", "SiLU", "Softplus", "Tanh")
_OPTIMIZERS = ("Adam", "AdamW", "Adamax", "RMSprop", "SGD")
CLASSES = {
    **{f"nn.{name}": ("torch.nn", name) for name in _ACTIVATIONS},
    **{f"optim.{name}": ("torch.optim", name) for name in _OPTIMIZERS},
}
_PREFIXES = ("torch.", "th.")
_CLASS_NAME = re.compile(r"((torch|th)\.)?(nn|optim)\.")


class _NotLiteral(ValueError):
    """An expression that is more than literals and known classes."""


def parse_number(value: Any) -> Any:
    """``"1e-3"`` (a string to PyYAML) as a number; anything else as it is.

    >>> parse_number("1e-3"), parse_number("2_000"), parse_number("mse"), parse_number(3)
    (0.001, 2000, 'mse', 3)
    """
    if not isinstance(value, str) or not _NUMBER.fullmatch(value.strip()):
        return value
    text = value.strip()
    return int(text) if re.fullmatch(r"[+-]?\d[\d_]*", text) else float(text)


def parse_value(text: str) -> Any:
    """The value of ``v`` in ``--hyperparams k:v``: a literal or ``dict(…)``, else the string itself.

    >>> parse_value("[64, 64]"), parse_value("dict(a=1)"), parse_value("mse"), parse_value("lin_1e-3")
    ([64, 64], {'a': 1}, 'mse', 'lin_1e-3')
    """
    number = parse_number(text)
    if not isinstance(number, str):
        return number
    try:
        return _evaluate(ast.parse(text.strip(), mode="eval").body)
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return text


def parse_mapping(value: Any, key: str) -> dict[str, Any]:
    """A mapping given as one, as None, or as rl-zoo's string ``"dict(net_arch=[64, 64], activation_fn=nn.Tanh)"``.

    Strings that name a known class, such as ``nn.Tanh``, become the class.

    :raises ConfigError: anything else; the message names ``key``.
    """
    if value is None:
        return {}
    if isinstance(value, str):
        try:
            value = _evaluate(ast.parse(value.strip(), mode="eval").body)
        except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
            reason = str(error) if isinstance(error, _NotLiteral) else "not an expression"
            raise ConfigError(f"{key}: {value!r} cannot be read ({reason}); write dict(name=literal, …)") from None
    if not isinstance(value, dict) or not all(isinstance(name, str) for name in value):
        raise ConfigError(f"{key}: must be a mapping of names to values, not {value!r}")
    return {name: _named(entry, f"{key}.{name}") for name, entry in value.items()}


def find_class(name: str) -> type | None:
    """The class of a name such as ``nn.Tanh``, ``torch.nn.Tanh`` or ``th.optim.Adam``; None for other strings."""
    for prefix in _PREFIXES:
        name = name.removeprefix(prefix)
    if name not in CLASSES:
        return None
    module, attribute = CLASSES[name]
    found = getattr(importlib.import_module(module), attribute)
    return found if isinstance(found, type) else None


def _named(value: Any, key: str) -> Any:
    if isinstance(value, dict):
        return {name: _named(entry, f"{key}.{name}") for name, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(_named(entry, key) for entry in value)
    if not isinstance(value, str):
        return value
    found = find_class(value)
    if found is None and _CLASS_NAME.match(value):
        raise ConfigError(f"{key}: {unknown('class', value, CLASSES)}")
    return found if found is not None else parse_number(value)


def _evaluate(node: ast.expr) -> Any:
    """The value of a syntax tree of literals, containers, ``dict(…)`` calls; names such as ``nn.Tanh`` as strings."""
    match node:
        case ast.Constant(value=value) if value is None or isinstance(value, (bool, int, float, str)):
            return value
        case ast.UnaryOp(op=ast.USub() | ast.UAdd() as sign, operand=ast.Constant(value=int() | float() as number)):
            return -number if isinstance(sign, ast.USub) else number
        case ast.List(elts=items):
            return [_evaluate(item) for item in items]
        case ast.Tuple(elts=items):
            return tuple(_evaluate(item) for item in items)
        case ast.Dict(keys=keys, values=values) if None not in keys:
            return {_evaluate(key): _evaluate(value) for key, value in zip(keys, values, strict=True) if key is not None}
        case ast.Call(func=ast.Name(id="dict"), args=[], keywords=keywords) if all(entry.arg for entry in keywords):
            return {str(entry.arg): _evaluate(entry.value) for entry in keywords}
        case ast.Attribute() if _CLASS_NAME.match(ast.unparse(node)):
            return ast.unparse(node)
    raise _NotLiteral(f"{ast.unparse(node)!r} is not a literal")
