"""Subcommands, errors and exit codes."""

import importlib
import io
import pkgutil
import sys
import traceback
from collections.abc import Container, Sequence
from pathlib import Path

from sb3_quad.base import __version__
from sb3_quad.base.errors import ConfigError, SB3QuadError, unknown
from sb3_quad.base.process import interrupts_leave, trusting
from sb3_quad.cli import commands
from sb3_quad.cli.parser import Parser

EPILOG = """examples:
  sb3-quad train                                                          imitation, then PPO, in random worlds
  sb3-quad train --algo ppo_bc --env QuadStateRecovery-v0 -n 1e6          a single training
  sb3-quad tune --algo dagger -n 250000 --n-trials 30                     a search for its hyperparameters
  sb3-quad evaluate pid agent.zip --suite quick                           an agent and an expert in one table
  sb3-quad enjoy --algo ppo_bc --env QuadStateRecovery-v0 -f logs         its flights in a window
  sb3-quad enjoy --algo ppo_bc --env QuadStateRecovery-v0 -o film.mp4     or as a film
  sb3-quad demo                                                           a page in which anyone can throw the quadcopter
  sb3-quad train --help                                                   all options of a command, with examples

exit codes:
  0    done
  1    some controllers of an evaluation or runs of a sweep failed (one line each on stderr), or a vehicle cannot hover
  2    bad input, a training that cannot continue, or any other error: one line on stderr says what
  129  the terminal was closed (SIGHUP), after saving
  130  interrupted by Ctrl-C, after saving
  143  interrupted by SIGTERM, after saving
"""
COMMANDS = {
    module.name.replace("_", "-"): importlib.import_module(f"{commands.__name__}.{module.name}")
    for module in pkgutil.iter_modules(commands.__path__)
}
"""The module of each command by its name: ``--help`` as its docstring, ``add_arguments`` and
``run``.
"""


def make_parser() -> Parser:
    """The parser of all commands."""
    parser = Parser(prog="sb3-quad", description="Fly and train quadcopters.", epilog=EPILOG)
    parser.add_argument("--version", action="version", version=f"sb3_quad {__version__}")
    subparsers = parser.add_subparsers(dest="command", metavar="{" + ",".join(COMMANDS) + "}")
    siblings: dict[str, Container[str]] = {}
    for name, command in COMMANDS.items():
        summary, _, rest = (command.__doc__ or "").partition("\n\n")
        subparser = subparsers.add_parser(name, help=summary, description=summary, epilog=rest)
        command.add_arguments(subparser)
        subparser.siblings = siblings
        siblings[name] = subparser._option_string_actions
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    given = list(sys.argv[1:] if argv is None else argv)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(line_buffering=True)  # lines appear at once, also in a pipe
    try:
        parser = make_parser()
        if any(
            "\ud800" <= letter <= "\udfff" for letter in "".join(given)
        ):  # how Python shows bytes that are no text
            raise ConfigError(f"arguments {' '.join(given)!r}: not valid UTF-8")
        if given and not given[0].startswith("-") and given[0] not in COMMANDS:
            raise ConfigError(unknown("command", given[0], COMMANDS))
        try:
            options = parser.parse_args(given)
        except SystemExit as leaving:  # argparse, after --help
            return int(leaving.code or 0)
        if options.command is None:
            parser.print_help()
            return 0
        agent = getattr(options, "trained_agent", None)
        if agent is not None and not any(
            Path(f"{agent}{suffix}").is_file() for suffix in ("", ".zip")
        ):  # SB3 adds it
            raise ConfigError(
                f"-i {agent}: no such file"
            )  # at once: what the command imports takes seconds
        with interrupts_leave():  # torch and the like, which every command needs, take seconds
            importlib.import_module("sb3_quad.controllers.zips")
        with trusting(getattr(options, "trust", False)):
            return int(COMMANDS[options.command].run(options))
    except SB3QuadError as error:
        return _refuse(str(error))
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:  # as in `sb3-quad train --help | head`
        sys.stderr.close()
        return 0
    except (
        Exception,
        SystemExit,
    ) as error:  # of a user's wrapper, environment or callback, a full disk, or a fault of ours
        if sys.flags.dev_mode:
            raise
        return _refuse(_unexpected(error))


def _refuse(message: str) -> int:
    """Print what stops a command, in one line. Returns the exit code."""
    print(f"error: {' '.join(message.split())}", file=sys.stderr)
    return 2


def _unexpected(error: BaseException) -> str:
    """The message of an exception that no check foresaw, and where it was raised."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename or 'a file'}: {error.strerror}"
    told = "; ".join([f"{type(error).__name__}: {error}", *getattr(error, "__notes__", ())])
    last = traceback.extract_tb(error.__traceback__)[-1]
    return f"{told} ({Path(last.filename).name}, line {last.lineno}; all of it: python -X dev -m sb3_quad.cli …)"
