"""Argument parsing with one-line errors, kinds of arguments, and the flags that several commands
have.
"""

import argparse
import math
import random
import typing
from collections.abc import Container, Mapping
from typing import Any, NoReturn

from pydantic import BaseModel

from sb3_quad.base.errors import ConfigError, did_you_mean
from sb3_quad.base.literals import parse_number, parse_value

ELSEWHERE = dict.fromkeys(
    ("-optimize", "--optimize", "--optimize-hyperparameters"), "the command sb3-quad tune does that"
)
"""Flags of rl_zoo3 that no command has, and what has their part."""


class Parser(argparse.ArgumentParser):
    """An ArgumentParser that raises ConfigError, and says what may be meant by an unknown option."""

    siblings: Mapping[str, Container[str]] = {}  # by command: its options

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(
            **{
                "allow_abbrev": False,
                "formatter_class": argparse.RawDescriptionHelpFormatter,
                **kwargs,
            }
        )

    def error(self, message: str) -> NoReturn:
        """:raises ConfigError: always."""
        raise ConfigError(message)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        """As argparse's, but an unknown option is an error here, where the options of the command
        are known.

        :raises ConfigError: an unknown option, a missing or bad value.
        """
        options, rest = super().parse_known_args(args, namespace)
        if rest:
            option, _, value = rest[0].partition("=")
            kind = "option" if option.startswith("-") else "argument"
            raise ConfigError(
                f"unknown {kind} {option!r}: {self._advice(option, value or [*rest, ''][1])}"
            )
        return options, rest

    def _advice(self, option: str, value: str) -> str:
        """What to give instead of an unknown option."""
        valid = self._option_string_actions
        owners = [
            f"sb3-quad {name}" for name, options in self.siblings.items() if option in options
        ]
        if option in ELSEWHERE:
            return ELSEWHERE[option]
        if hint := did_you_mean(option, valid):
            return hint.strip()
        if owners:
            return f"it belongs to {' and '.join(owners)}"
        if "--hyperparams" in valid and option.startswith("--"):
            pair = f"{option.strip('-').replace('-', '_')}:{'VALUE' if value[:1] in ('', '-') else value}"
            return f"a hyperparameter is given as --hyperparams {pair}, a keyword of the environment as --env-kwargs {pair}"
        return "see --help, and docs/zoo.md for flags of rl_zoo3"


class Pairs(argparse.Action):
    """Keeps ``k:v`` entries as a mapping."""

    def __call__(
        self, parser: Any, namespace: argparse.Namespace, values: Any, option: str | None = None
    ) -> None:
        """:raises ConfigError: an entry without a colon."""
        found = dict(getattr(namespace, self.dest) or {})
        for entry in values:
            key, colon, value = entry.partition(":")
            if not colon or not key:
                raise ConfigError(f"{option} {entry!r}: must be key:value, such as n_steps:500")
            if (name := key.strip()) in found:
                raise ConfigError(f"{option} {entry!r}: {name} is given twice")
            found[name] = parse_value(value)
        setattr(namespace, self.dest, found)


PAIRS: dict[str, Any] = {"action": Pairs, "nargs": "+", "metavar": "K:V"}
YES_OR_NO: dict[str, Any] = {"action": argparse.BooleanOptionalAction}


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


def add_fields(
    parser: argparse.ArgumentParser,
    model: type[BaseModel],
    *names: str,
    **changes: Mapping[str, Any],
) -> None:
    """Add a flag for each field of a model, made from its name, type, description and default; not
    given, it is None.

    :param model: with fields as of :func:`sb3_quad.training.options.option`.
    :param names: of the fields; all without any.
    :param changes: by field, arguments of ``add_argument`` over those made from it.
    """
    for name in names or model.model_fields:
        field = model.model_fields[name]
        metadata: Any = field.json_schema_extra
        default = "" if field.default is None or field.default is False else f" ({field.default})"
        own: dict[str, Any] = {
            "help": f"{field.description}{default}",
            "metavar": metadata["metavar"],
        }
        kinds = {field.annotation, *typing.get_args(field.annotation)}
        if bool in kinds:
            del own["metavar"]
            own |= YES_OR_NO if name == "progress" else {"action": "store_true", "default": None}
        elif dict[str, Any] in kinds:
            own |= PAIRS
        elif str not in kinds:
            own["type"] = float if float in kinds else whole
        parser.add_argument(
            *metadata["flags"], f"--{name.replace('_', '-')}", **{**own, **changes.get(name, {})}
        )


def add_common(parser: argparse.ArgumentParser, *names: str) -> None:
    """Add flags that several commands have: ``executor`` (with ``--address``), ``trust``,
    ``overwrite`` and ``progress``.
    """
    add = parser.add_argument
    if "executor" in names:
        add(
            "--executor",
            default="local",
            metavar="KIND",
            help="local (worker processes here, default) or ray: docs/sweeps.md",
        )
        add(
            "--address",
            metavar="WHERE",
            help="Ray cluster: auto, host:port or ray://host:port (one is started without it)",
        )
    if "trust" in names:
        add(
            "--trust",
            action="store_true",
            help="let zips run whatever is pickled in them, see docs/security.md",
        )
    if "overwrite" in names:
        add("--overwrite", action="store_true", help="replace existing files")
    if "progress" in names:
        add("-P", "--progress", help="progress bar (in a terminal: yes)", **YES_OR_NO)


def given(options: argparse.Namespace, *names: str) -> dict[str, Any]:
    """Those of some options that a command has and that are given."""
    return {name: value for name in names if (value := getattr(options, name, None)) is not None}
