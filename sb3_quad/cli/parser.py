"""Argument parsing with one-line errors, and the kinds of arguments rl-zoo has."""

import argparse
import math
import random
from collections.abc import Mapping
from typing import Any, NoReturn

from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.base.literals import parse_number, parse_value

TRUST = "let zips run whatever is pickled in them, see docs/security.md"
BRIDGE = "is of rl_zoo3 alone; the bridge takes it: python -m sb3_quad.zoo {}, docs/zoo.md"


class Parser(argparse.ArgumentParser):
    """An ArgumentParser that raises ConfigError, and names the nearest option to an unknown one."""

    elsewhere: Mapping[str, str] = {}
    """By options of rl-zoo that a command lacks: what else to call."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**{"allow_abbrev": False, "formatter_class": argparse.RawDescriptionHelpFormatter, **kwargs})

    def error(self, message: str) -> NoReturn:
        """:raises ConfigError: always."""
        raise ConfigError(message)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        """As argparse's, but nothing unknown is passed over: the options of a command are all that there are.

        :raises ConfigError: an unknown option, a missing or bad value.
        """
        options, rest = super().parse_known_args(args, namespace)
        for text in rest:
            if (name := text.split("=")[0]) in self.elsewhere:
                raise ConfigError(f"{name} {self.elsewhere[name]}")
            valid = [option for action in self._actions for option in action.option_strings]
            raise ConfigError(unknown("option", name, valid).split("(valid:")[0].rstrip(": ") + "; see --help")
        return options, rest


def pointers(flags: str, where: str) -> dict[str, str]:
    """:attr:`Parser.elsewhere` of some flags, which stand apart by spaces."""
    return dict.fromkeys(flags.split(), where)


def whole(text: str) -> int:
    """A whole number, also as ``1e6``."""
    number = parse_number(text)
    if isinstance(number, str) or not abs(number) < 2**63 or number != int(number):
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number below 2**63")
    return int(number)


def natural(text: str, least: int = 0) -> int:
    """A whole number of at least 0."""
    if whole(text) < least:
        raise argparse.ArgumentTypeError(f"{text}: must be at least {least}")
    return whole(text)


def positive(text: str) -> int:
    """A whole number of at least 1."""
    return natural(text, least=1)


def seed(text: str) -> int:
    """A whole number; a negative one asks for a random one."""
    number = whole(text)
    return number if number >= 0 else random.SystemRandom().randrange(2**31)


def above_zero(text: str) -> float:
    """A finite number above 0."""
    number = float(text)
    if not 0 < number < math.inf:
        raise argparse.ArgumentTypeError(f"{text}: must be above 0, and finite")
    return number


class Pairs(argparse.Action):
    """Keeps ``k:v`` entries as a mapping."""

    def __call__(self, parser: Any, namespace: argparse.Namespace, values: Any, option: str | None = None) -> None:
        """:raises ConfigError: an entry without a colon."""
        found = {}
        for entry in values:
            key, colon, value = entry.partition(":")
            if not colon or not key:
                raise ConfigError(f"{option} {entry!r}: must be key:value, such as n_steps:500")
            found[key.strip()] = parse_value(value)
        setattr(namespace, self.dest, found)


def add_executor(parser: argparse.ArgumentParser) -> None:
    """The flags that say where tasks are executed."""
    add = parser.add_argument
    add("--executor", default="local", metavar="KIND", help="local (worker processes here, default) or ray: docs/sweeps.md")
    add("--address", metavar="WHERE", help="Ray cluster: auto, host:port or ray://host:port (without it, one is started here)")


class OneOrMore(argparse.Action):
    """Keeps a single value as it is, several as a list."""

    def __call__(self, parser: Any, namespace: argparse.Namespace, values: Any, option: str | None = None) -> None:
        setattr(namespace, self.dest, values[0] if len(values) == 1 else values)


def given(options: argparse.Namespace, *names: str) -> dict[str, Any]:
    """Those of some options that a command has and that are given."""
    return {name: value for name in names if (value := getattr(options, name, None)) is not None}
