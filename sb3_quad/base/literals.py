"""Values from YAML and the command line: literals and a few named classes, never evaluated as code."""

import ast
import pkgutil
import re
from contextlib import suppress
from typing import Any

from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.base.files import one_line

_ACTIVATIONS = (
    "ELU",
    "GELU",
    "Hardtanh",
    "LeakyReLU",
    "Mish",
    "ReLU",
    "ReLU6",
    "SELU",
    "Sigmoid",
    "SiLU",
    "Softplus",
    "Tanh",
)
_OPTIMIZERS = ("Adam", "AdamW", "Adamax", "RMSprop", "SGD")
CLASSES = (*(f"nn.{name}" for name in _ACTIVATIONS), *(f"optim.{name}" for name in _OPTIMIZERS))
_CLASS_NAME = re.compile(r"(?:torch\.|th\.)?((?:nn|optim)\..*)")


def parse_number(value: Any) -> Any:
    """``"1e-3"`` (a string to PyYAML) as a number; anything else as it is.

    >>> parse_number("1e-3"), parse_number("2_000"), parse_number("mse"), parse_number(3)
    (0.001, 2000, 'mse', 3)
    """
    if isinstance(value, str):
        for kind in (int, float):
            with suppress(ValueError):
                return kind(value)
    return value


def parse_value(text: str, key: str = "") -> Any:
    """The value of ``v`` in ``--hyperparams k:v``: a literal or ``dict(…)``, else the string
    itself.

    >>> parse_value("[64, 64]"), parse_value("dict(a=1)"), parse_value("mse"), parse_value("lin_1e-3")
    ([64, 64], {'a': 1}, 'mse', 'lin_1e-3')

    :raises ConfigError: there is a ``key``, which the message names, and the text is no literal.
    """
    try:
        return ast.literal_eval(_AsLiterals().visit(ast.parse(text.strip(), mode="eval")))
    except (SyntaxError, TypeError, ValueError, RecursionError, MemoryError) as error:
        if key:
            raise ConfigError(
                f"{key}: {text!r} cannot be read ({one_line(error)}); write dict(name=literal, …)"
            ) from None
        return parse_number(text)


def parse_mapping(value: Any, key: str) -> dict[str, Any]:
    """A mapping given as one, as None, or as rl-zoo's string ``"dict(net_arch=[64, 64],
    activation_fn=nn.Tanh)"``.

    :raises ConfigError: anything else; the message names ``key``. Names such as ``nn.Tanh`` become
        classes.
    """
    given = parse_value(value, key) if isinstance(value, str) else {} if value is None else value
    if not isinstance(given, dict) or not all(isinstance(name, str) for name in given):
        raise ConfigError(f"{key}: must be a mapping of names to values, not {value!r}")
    return {name: _named(entry, f"{key}.{name}") for name, entry in given.items()}


def put_key(data: dict[str, Any], key: str, value: Any, where: str) -> None:
    """Set a value at a dotted key, in place; numbers count the entries of a list.

    :raises ConfigError: what the key leads through holds no keys.
    """
    *path, last = key.split(".")
    place: Any = data
    for part in path:
        if isinstance(place, list) and part.isdigit() and int(part) < len(place):
            place = place[int(part)]
        else:
            place = place.setdefault(part, {}) if isinstance(place, dict) else None
    if not isinstance(place, dict):
        raise ConfigError(f"{where}: {'.'.join(path)} holds no keys here")
    place[last] = value


def _named(value: Any, key: str) -> Any:
    if isinstance(value, dict):
        return {name: _named(entry, f"{key}.{name}") for name, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(_named(entry, key) for entry in value)
    if not isinstance(value, str):
        return value
    if (match := _CLASS_NAME.fullmatch(value)) is None:
        return parse_number(value)
    if match[1] not in CLASSES:
        raise ConfigError(f"{key}: {unknown('class', value, CLASSES)}")
    return pkgutil.resolve_name(f"torch.{match[1]}")


class _AsLiterals(ast.NodeTransformer):
    """Makes literals of ``dict(…)`` calls, and strings of names such as ``nn.Tanh``."""

    def visit_Call(self, node: ast.Call) -> ast.AST:
        self.generic_visit(node)
        names = [entry.arg for entry in node.keywords]
        if ast.unparse(node.func) != "dict" or node.args or None in names:
            return node
        return ast.Dict(
            [ast.Constant(name) for name in names], [entry.value for entry in node.keywords]
        )

    def visit_Attribute(self, node: ast.Attribute) -> ast.AST:
        text = ast.unparse(node)
        return ast.Constant(text) if _CLASS_NAME.match(text) else node
