"""The exceptions this package raises on bad input.

Each message is one line that names the thing and the way out; the command line prints it and leaves with code 2.
"""

import difflib
from collections.abc import Iterable


class SB3QuadError(Exception):
    """Base of every error that a user's input can cause."""


class ConfigError(SB3QuadError, ValueError):
    """A file, key or value that does not fit: says which one, what is wrong and what is allowed."""


class MissingExtra(ConfigError, ImportError):
    """A package that is not installed: says what needs it, and which extra brings it."""


class CannotHover(ConfigError):
    """A vehicle whose rotors cannot give hover thrust: too weak, or unable to give as little."""


class ExpertError(SB3QuadError, ValueError):
    """An expert that cannot label this environment, or whose labels are not finite actions of the right shape."""


class TrainingError(SB3QuadError, RuntimeError):
    """Training that cannot go on, for example a loss that is no longer finite."""


class ControllerError(SB3QuadError, RuntimeError):
    """A controller that fails in flight: says when, and what it raised or gave."""


class WorkerDied(SB3QuadError, RuntimeError):
    """A worker process that ended before its task was done: killed, crashed, or out of memory."""


class ExportError(SB3QuadError, RuntimeError):
    """An exported policy that does not compute what the trained one does, or cannot be checked."""


def unknown(kind: str, name: object, valid: Iterable[str]) -> str:
    """The message for an unknown ``name``: the nearest valid one and the whole list.

    >>> unknown("task", "state_recovry", ["target_tracking", "state_recovery"])
    "unknown task 'state_recovry': did you mean 'state_recovery'? (valid: state_recovery, target_tracking)"
    """
    names = sorted(str(option) for option in valid)
    close = difflib.get_close_matches(str(name), names, n=1, cutoff=0.4)
    hint = f"did you mean {close[0]!r}? " if close else ""
    return f"unknown {kind} {str(name)!r}: {hint}(valid: {', '.join(names)})"
