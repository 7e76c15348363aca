"""The exceptions this package raises on bad input.

Each message is one line that names the thing and the way out; the command line prints it and leaves
with code 2.
"""

import re
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
    """An expert that cannot label this environment, or whose labels are not finite actions of the
    right shape.
    """


class TrainingError(SB3QuadError, RuntimeError):
    """Training that cannot go on, for example a loss that is no longer finite."""


class ControllerError(SB3QuadError, RuntimeError):
    """A controller that fails in flight: says when, and what it raised or gave."""


class WorkerDied(SB3QuadError, RuntimeError):
    """A worker process that ended before its task was done: killed, crashed, or out of memory."""


class ExportError(SB3QuadError, RuntimeError):
    """An exported policy that does not compute what the trained one does, or cannot be checked."""


def unknown(kind: str, name: object, valid: Iterable[str]) -> str:
    """The message for an unknown ``name``: what it may be a slip of, and the whole list.

    >>> unknown("task", "state_recovry", ["target_tracking", "state_recovery"])
    "unknown task 'state_recovry': did you mean 'state_recovery'? (valid: state_recovery,
    target_tracking)"
    """
    names = sorted(str(option) for option in valid)
    return f"unknown {kind} {str(name)!r}: {did_you_mean(name, names)}(valid: {', '.join(names)})"


def did_you_mean(name: object, valid: Iterable[str]) -> str:
    """The valid name that ``name`` misspells, or those few that it is a part of, as a question;
    empty if there is none.

    >>> did_you_mean("tracking", ["far_tracking", "state_recovery", "target_tracking"])
    "did you mean 'far_tracking' or 'target_tracking'? "
    """
    text, names = str(name).lower(), sorted(valid)
    letters = sum(map(str.isalnum, text))
    most = min(max(1, letters // 4), letters - 1)  # slips
    near = {
        each: _edit_distance(text, each.lower())
        for each in names
        if abs(len(each) - len(text)) <= most
    }
    found = [each for each in sorted(near, key=near.__getitem__)[:1] if near[each] <= most]
    if not found and (parts := _parts(text)):
        found = [each for each in names if parts <= _parts(each.lower())]
    return f"did you mean {' or '.join(map(repr, found))}? " if 0 < len(found) <= 3 else ""


def _parts(text: str) -> set[str]:
    return {*re.findall(r"[^\W_]+", text)}


def _edit_distance(given: str, meant: str) -> int:
    """How many letters left out, added, replaced, or swapped with the next make one text the other."""
    rows: list[list[int]] = [[*range(len(meant) + 1)]]
    for i, letter in enumerate(given):
        rows.append([i + 1])
        for j, other in enumerate(meant):
            least = min(rows[i][j + 1] + 1, rows[i + 1][j] + 1, rows[i][j] + (letter != other))
            if i > 0 and j > 0 and letter == meant[j - 1] and other == given[i - 1]:
                least = min(least, rows[i - 1][j - 1] + 1)
            rows[i + 1].append(least)
    return rows[-1][-1]
