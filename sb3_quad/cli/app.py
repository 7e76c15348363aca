"""The commands, their errors and exit codes."""

import importlib
import io
import os
import pkgutil
import sys
import traceback
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path

import argcomplete

from sb3_quad.agents.pretrained import agent_path
from sb3_quad.base import __version__
from sb3_quad.base.errors import ConfigError, SB3QuadError, refuse_unknown
from sb3_quad.base.files import one_line
from sb3_quad.base.process import interrupts_leave, trusting
from sb3_quad.cli import commands
from sb3_quad.cli.parser import TRACEBACK, Parser, add_flags

EPILOG = """examples:
  # imitation, then the model's gradient, with domain randomization
  sb3-quad train
  # a single training
  sb3-quad train --algo ppo_bc --env QuadStateRecovery-v0 -n 1e6
  # search for hyperparameters
  sb3-quad tune --algo dagger -n 250000 --n-trials 30
  # compare an agent and an expert in one table
  sb3-quad evaluate pid agent.zip --suite quick
  # watch the agent's flights in a window, or as a film
  sb3-quad enjoy logs/ppo_bc/QuadStateRecovery-v0_1
  sb3-quad enjoy logs/ppo_bc/QuadStateRecovery-v0_1 -o film.mp4
  # make a page where anyone can throw the quadcopter
  sb3-quad demo
  # show all options of a command, with examples
  sb3-quad train --help

exit codes:
  0    done
  1    some controllers of an evaluation or runs of a sweep failed (each has a
       line on stderr), a vehicle cannot hover, or a training ended below the
       agent that it started from, which it hands over
  2    bad input, a training that cannot continue, or any other error; one line
       on stderr says what (--traceback after the command shows where)
  129  the terminal was closed (SIGHUP), after saving
  130  interrupted by Ctrl-C, after saving
  141  nobody reads the output any more, as in sb3-quad sweep ... | head -1
  143  interrupted by SIGTERM, after saving
"""
COMMANDS = {
    module.name.replace("_", "-"): importlib.import_module(f"{commands.__name__}.{module.name}")
    for module in pkgutil.iter_modules(commands.__path__)
}
"""The module of each command by its name: ``--help`` as its docstring, ``FLAGS`` and ``run``."""


def make_parser() -> Parser:
    """Return the parser of all commands."""
    parser = Parser(prog="sb3-quad", description="Fly and train quadcopters.", epilog=EPILOG)
    parser.add_argument("--version", action="version", version=f"sb3_quad {__version__}")
    subparsers = parser.add_subparsers(title="commands", dest="command", metavar="COMMAND")
    for name, command in COMMANDS.items():
        text, heading, rest = str(command.__doc__).partition("examples:\n")
        subparser = subparsers.add_parser(
            name, help=text.partition("\n\n")[0], description=text, epilog=heading + rest
        )
        add_flags(subparser, {**command.FLAGS, **TRACEBACK})
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line. Returns the exit code."""
    # A shell that completes asks by a variable, and gets words instead of a run.
    if "_ARGCOMPLETE" in os.environ:
        argcomplete.autocomplete(make_parser())
    arguments = list(sys.argv[1:] if argv is None else argv)
    # A closed stream, as after `>&-`, is None. Its number must not go to a file that opens next.
    for name in ("stdout", "stderr"):
        if not getattr(sys, name):
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115
    # Lines appear at once, also in a pipe. Letters that the console lacks become question marks.
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(line_buffering=True, errors="replace")
    try:
        _refuse_removed_folder()
        options = _parse(arguments)
        if options is None:
            return 0
        # Ctrl-C ends the imports at once. All commands need these, which take seconds.
        with interrupts_leave():
            importlib.import_module("sb3_quad.agents.zips")
        with trusting(getattr(options, "trust", False)):
            return int(COMMANDS[options.command].run(options))
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # The reader has ended, as in `sb3-quad train --help | head`.
        sys.stderr.close()
        return 141
    except (Exception, SystemExit) as error:
        # A user's environment or callback, or a fault of this package, may raise anything.
        if "--traceback" in arguments:
            traceback.print_exc()
        message = str(error) if isinstance(error, SB3QuadError) else _unexpected(error)
        print(f"error: {' '.join(message.split())}", file=sys.stderr)
        return 2


def _refuse_removed_folder() -> None:
    """:raises ConfigError: the current folder no longer exists, and relative paths mean nothing."""
    try:
        os.getcwd()
    except FileNotFoundError:
        raise ConfigError("the current folder was removed; go to another one with cd") from None


def _parse(arguments: list[str]) -> Namespace | None:
    """Return the options of a command, or None after printing help.

    :raises ConfigError: An unknown command or option, or a bad value.
    """
    parser = make_parser()
    # Python represents bytes that are not text as lone surrogates.
    if any("\ud800" <= letter <= "\udfff" for letter in "".join(arguments)):
        raise ConfigError(f"arguments {' '.join(arguments)!r}: not valid UTF-8")
    if arguments and not arguments[0].startswith("-"):
        refuse_unknown("command", arguments[:1], COMMANDS)
    try:
        options = parser.parse_args(arguments or ["--help"])
    except SystemExit:
        # argparse has printed the help or the version.
        return None
    # A missing file is refused at once, since the imports of a command take seconds.
    agent = getattr(options, "initial_policy", None)
    if agent:
        options.initial_policy = agent_path(agent)
        if not Path(options.initial_policy).is_file():
            raise ConfigError(f"-i {agent}: no such file, and no folder of a run with an agent")
    return options


def _unexpected(error: BaseException) -> str:
    """Return the message of an exception that no check foresaw, with the place that raised it."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename or 'a file'}: {error.strerror}"
    if isinstance(error, MemoryError):
        return "there is not enough memory; take fewer environments or episodes"
    message = f"{type(error).__name__}: {one_line(error)}"
    text = "; ".join([message, *getattr(error, "__notes__", ())])
    last = traceback.extract_tb(error.__traceback__)[-1]
    return f"{text} ({Path(last.filename).name}, line {last.lineno}; add --traceback for all of it)"
