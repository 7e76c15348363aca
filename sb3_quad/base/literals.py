"""Values from YAML and the command line: literals and a few named classes, never code."""

import ast
import pkgutil
import re
from contextlib import suppress
from typing import Any

from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.base.files import one_line
from sb3_quad.base.types import StrDict

CLASSES = """
    nn.ELU
    nn.GELU
    nn.Hardtanh
    nn.LeakyReLU
    nn.Mish
    nn.ReLU
    nn.ReLU6
    nn.SELU
    nn.Sigmoid
    nn.SiLU
    nn.Softplus
    nn.Tanh
    optim.Adam
    optim.AdamW
    optim.Adamax
    optim.RMSprop
    optim.SGD
    """
"""The classes of PyTorch that settings may name."""
_CLASS_NAME = re.compile(r"(?:torch\.|th\.)?((?:nn|optim)\..*)")


def parse_number(value: Any) -> Any:
    """Return a number for a text such as ``"1e-3"``, which PyYAML reads as a string.

    Anything else is returned unchanged.

    >>> parse_number("1e-3"), parse_number("2_000"), parse_number("mse"), parse_number(3)
    (0.001, 2000, 'mse', 3)
    """
    if isinstance(value, str):
        for kind in (int, float):
            with suppress(ValueError):
                return kind(value)
    return value


def parse_value(text: str, key: str = "") -> Any:
    """Return the value of ``v`` in ``--hyperparams k:v``: a literal or ``dict(…)``, otherwise the
    text.

    >>> parse_value("[64, 64]"), parse_value("dict(a=1)"), parse_value("lin_1e-3")
    ([64, 64], {'a': 1}, 'lin_1e-3')

    :param key: The key that an error message names.
    :raises ConfigError: There is a ``key``, and the text is not a literal.
    """
    try:
        return ast.literal_eval(_AsLiterals().visit(ast.parse(text.strip(), mode="eval")))
    except (SyntaxError, TypeError, ValueError, RecursionError, MemoryError) as error:
        if key:
            raise ConfigError(
                f"{key}: {text!r} cannot be read ({one_line(error)}); write dict(name=literal, …)"
            ) from None
        return parse_number(text)


def parse_mapping(value: Any, key: str) -> StrDict:
    """Return a mapping, given as one, as None, or as rl_zoo3's ``"dict(net_arch=[64, 64])"``.

    Names such as ``nn.Tanh`` become classes.

    :param key: The key that an error message names.
    :raises ConfigError: The value is anything else.
    """
    if isinstance(value, str):
        value = parse_value(value, key)
    elif value is None:
        value = {}
    if not isinstance(value, dict) or not all(isinstance(name, str) for name in value):
        raise ConfigError(f"{key}: must be a mapping of names to values, not {value!r}")
    mapping: StrDict = _resolve(value, key)
    return mapping


def put_key(data: StrDict, key: str, value: Any, where: str) -> None:
    """Set a value at a dotted key, in place. Numbers are positions in a list.

    :raises ConfigError: Something on the way has no keys.
    """
    *path, last = key.split(".")
    place: Any = data
    try:
        for part in path:
            if isinstance(place, list):
                place = place[int(part)]
            else:
                # A key without a value in a file is None.
                if place.get(part) is None:
                    place[part] = {}
                place = place[part]
        place[last] = value
    except (AttributeError, IndexError, TypeError, ValueError):
        raise ConfigError(f"{where}: {'.'.join(path)} holds no keys here") from None


def _resolve(value: Any, key: str) -> Any:
    """Replace names of classes and texts of numbers, at any depth."""
    if isinstance(value, dict):
        return {name: _resolve(entry, f"{key}.{name}") for name, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(_resolve(entry, key) for entry in value)
    if not isinstance(value, str):
        return value
    match = _CLASS_NAME.fullmatch(value)
    if match is None:
        return parse_number(value)
    valid = CLASSES.split()
    if match[1] not in valid:
        raise ConfigError(f"{key}: {unknown('class', value, valid)}")
    return pkgutil.resolve_name(f"torch.{match[1]}")


class _AsLiterals(ast.NodeTransformer):
    """Turns ``dict(…)`` calls into literals, and names such as ``nn.Tanh`` into strings."""

    def visit_Call(self, node: ast.Call) -> ast.AST:
        self.generic_visit(node)
        if ast.unparse(node.func) != "dict" or node.args:
            return node
        # The name of **mapping is None, which parse_mapping refuses.
        names: list[ast.expr | None] = [ast.Constant(keyword.arg) for keyword in node.keywords]
        return ast.Dict(names, [keyword.value for keyword in node.keywords])

    def visit_Attribute(self, node: ast.Attribute) -> ast.AST:
        text = ast.unparse(node)
        if _CLASS_NAME.match(text):
            return ast.Constant(text)
        return node
