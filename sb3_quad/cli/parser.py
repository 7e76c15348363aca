"""Argument parsing with one-line errors, types of arguments, and flags of several commands."""

import random
import typing
from argparse import (
    Action,
    ArgumentParser,
    ArgumentTypeError,
    BooleanOptionalAction,
    Namespace,
)
from collections.abc import Callable, Mapping
from typing import Any, NoReturn, TypeAlias

from pydantic import BaseModel
from rich_argparse import RawDescriptionRichHelpFormatter

from sb3_quad.base.errors import ConfigError, did_you_mean
from sb3_quad.base.literals import parse_number, parse_value
from sb3_quad.base.types import StrDict
from sb3_quad.base.validate import check

SHORT_FLAGS = {
    "n_timesteps": "-n",
    "initial_policy": "-i",
    "log_folder": "-f",
    "tensorboard_log": "-tb",
    "progress": "-P",
}
"""rl-zoo's short names of some flags."""
ELSEWHERE = {
    "-optimize": "the command sb3-quad tune does that",
    "--optimize-hyperparameters": "the command sb3-quad tune does that",
    "--trained-agent": "the flag is --initial-policy",
}
"""Where flags of rl_zoo3 are found here, for the error message."""


class HelpFormatter(RawDescriptionRichHelpFormatter):
    """Keeps the line breaks of examples, and writes in colour on a terminal."""

    # Brackets in our texts are not markup.
    help_markup = text_markup = False


class Parser(ArgumentParser):
    """An ArgumentParser that raises ConfigError and gives advice on unknown options."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(allow_abbrev=False, formatter_class=HelpFormatter, **kwargs)

    def error(self, message: str) -> NoReturn:
        """Raise the error instead of exiting.

        :raises ConfigError: Always.
        """
        raise ConfigError(message)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        """Parse the arguments of a command, and refuse unknown ones here, where its options are
        known.

        :raises ConfigError: An unknown option, or a missing or bad value.
        """
        options, rest = super().parse_known_args(args, namespace)
        if rest:
            option = rest[0].partition("=")[0]
            raise ConfigError(f"unknown argument {option!r}: {self._advice(option)}")
        return options, rest

    def _advice(self, option: str) -> str:
        """Say what the user may want instead of an unknown option."""
        valid = self._option_string_actions
        if option in ELSEWHERE:
            return ELSEWHERE[option]
        guess = did_you_mean(option, valid)
        if guess:
            return guess.strip()
        if "--hyperparams" in valid and option.startswith("--"):
            return (
                "hyperparameters are given as --hyperparams KEY:VALUE, "
                "keywords of the environment as --env-kwargs KEY:VALUE"
            )
        return "see --help, and docs/zoo.md for flags of rl_zoo3"


class Pairs(Action):
    """Stores ``k:v`` entries as a mapping."""

    def __call__(
        self, parser: Any, namespace: Namespace, values: Any, option: str | None = None
    ) -> None:
        """Add the entries of one flag to those of the flags before it.

        :raises ConfigError: An entry without a colon, or a key that is given twice.
        """
        pairs = dict(getattr(namespace, self.dest) or {})
        for entry in values:
            key, colon, value = entry.partition(":")
            name = key.strip()
            if not colon or not name or name in pairs:
                raise ConfigError(
                    f"{option} {entry!r}: must be key:value, such as n_steps:500, each key once"
                )
            pairs[name] = parse_value(value)
        setattr(namespace, self.dest, pairs)


PAIRS = {"action": Pairs, "nargs": "+", "metavar": "K:V"}
YES_OR_NO = {"action": BooleanOptionalAction}
SWITCH = {"action": "store_true"}
SEVERAL = {"nargs": "+"}


def typed(kind: Any) -> Callable[[str], Any]:
    """Return a function that reads a text such as ``1e6`` as a pydantic type."""

    def read(text: str) -> Any:
        try:
            return check(kind, parse_number(text), "it")
        except ConfigError as error:
            raise ArgumentTypeError(str(error)) from None

    return read


def seed(text: str) -> int:
    """Return a whole number of at least 0, a random one for a negative number."""
    number: int = typed(int)(text)
    if number < 0:
        number = random.SystemRandom().randrange(2**31)
    return number


KINDS = {bool: SWITCH, StrDict: PAIRS, str: str}
"""The types (or keywords of ``add_argument``) of flags by those of their fields.

Others are numbers, which the field's model checks.
"""
Flags: TypeAlias = "Mapping[str, str | tuple[Any, ...] | Flags]"
"""A table of arguments by names and metavar: the type (of pydantic, a function, or keywords of
``add_argument``), the default if there is one, and the help; the help alone for a text without a
default. A table in it holds flags that exclude each other.
"""


def add_flags(parser: Any, flags: Flags) -> None:
    """Add the arguments of a table to a parser or a group of one."""
    for words, entry in flags.items():
        if isinstance(entry, Mapping):
            add_flags(parser.add_mutually_exclusive_group(), entry)
            continue
        kind, *default, text = (str, entry) if isinstance(entry, str) else entry
        # A type of pydantic, such as PositiveInt
        if hasattr(kind, "__metadata__"):
            kind = typed(kind)
        arguments = kind if isinstance(kind, dict) else {"type": kind}
        names = words.split()
        if len(names) > 1 and not names[-1].startswith("-"):
            arguments = {**arguments, "metavar": names.pop()}
        argument = parser.add_argument(*names, help=text, **arguments)
        if default:
            (argument.default,) = default


def field_flags(model: type[BaseModel], *names: str) -> StrDict:
    """Return a table with a flag for each field of a model.

    The flag follows from the field's name, type, docstring and default. A flag that is not given is
    None.

    :param names: the fields; without any, all of them.
    """
    flags = {}
    for name in names or model.model_fields:
        field = model.model_fields[name]
        kind: Any = parse_number
        # The type itself, and the alternatives of a union such as `int | None`.
        for part in (field.annotation, *typing.get_args(field.annotation)):
            kind = KINDS.get(part, kind)
        text = str(field.description)
        if field.default not in (None, False):
            text += f" ({field.default})"
        words = f"{SHORT_FLAGS.get(name, '')} --{name.replace('_', '-')}".strip()
        if kind is parse_number:
            words += " N"
        flags[words] = (kind, text)
    return flags


TRUST = {
    "--trust": (
        SWITCH,
        "let zips run code that is pickled in them; only for files you trust (docs/security.md)",
    )
}
TRACEBACK = {"--traceback": (SWITCH, "print the traceback of an error, too")}
OVERWRITE = {"--overwrite": (SWITCH, "replace existing files")}
PROGRESS = {"-P --progress": (YES_OR_NO, "show a progress bar (yes in a terminal)")}


def given(options: Namespace, *names: str) -> StrDict:
    """Return those of some options that the command has and that were given."""
    values = vars(options)
    return {name: values[name] for name in names if values.get(name) is not None}
