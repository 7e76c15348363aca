"""The exceptions that this package raises on bad input.

Each message is one line that names the thing and the way out. The command line prints it and exits
with code 2.
"""

from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from difflib import get_close_matches


class SB3QuadError(Exception):
    """Base of every error that a user's input can cause."""


class ConfigError(SB3QuadError, ValueError):
    """A file, key or value that does not fit. Names it, what is wrong and what is allowed."""


class MissingExtra(ConfigError, ImportError):
    """A package that is not installed. Names what needs it and the extra that installs it."""


class CannotHover(ConfigError):
    """A vehicle whose rotors cannot produce hover thrust: too weak, or unable to go as low."""


class ExpertError(SB3QuadError, ValueError):
    """An expert that cannot label this environment, or whose labels are not finite actions."""


class TrainingError(SB3QuadError, RuntimeError):
    """Training that cannot continue, for example because the loss is no longer finite."""


class ControllerError(SB3QuadError, RuntimeError):
    """A controller that fails in flight. Says when, and what it raised or returned."""


class ExportError(SB3QuadError, RuntimeError):
    """An exported policy whose actions differ from the trained one's, or that cannot be checked."""


@contextmanager
def raised_as(error: type[SB3QuadError], what: str) -> Iterator[None]:
    """Turn whatever third-party code raises in this block into an ``error`` of one line.

    :param what: Whose code it is and what it does, such as "reward energy: fails".
    """
    try:
        yield
    except SB3QuadError:
        raise
    except (Exception, SystemExit) as failure:
        reason = " ".join(str(failure).split())[:200]
        raise error(f"{what} ({type(failure).__name__}: {reason})") from failure


@contextmanager
def named(where: str) -> Iterator[None]:
    """Put what a ConfigError in this block is about before its message."""
    try:
        yield
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None


def refuse_unknown(kind: str, names: Iterable[str], valid: Collection[str], more: str = "") -> None:
    """Refuse names that are not among the valid ones.

    :param more: ends the message.
    :raises ConfigError: with the message of :func:`unknown`.
    """
    for name in names:
        if name not in valid:
            raise ConfigError(unknown(kind, name, valid) + more)


def unknown(kind: str, name: object, valid: Iterable[str]) -> str:
    """The message for an unknown name: a guess at what was meant, and the whole list.

    >>> unknown("task", "state_recovry", ["target_tracking", "state_recovery"])
    "unknown task 'state_recovry': did you mean 'state_recovery'? (valid: state_recovery,
    target_tracking)"
    """
    names = sorted(map(str, valid))
    guess = did_you_mean(name, names)
    colon = ":" if guess else ""
    return f"unknown {kind} {str(name)!r}{colon} {guess}(valid: {', '.join(names)})"


def did_you_mean(name: object, valid: Iterable[str]) -> str:
    """A question with the valid name that ``name`` misspells; empty if none is near.

    >>> did_you_mean("state_recovry", ["state_recovery", "target_tracking"])
    "did you mean 'state_recovery'? "
    """
    guesses = get_close_matches(str(name), sorted(valid), n=1, cutoff=0.65)
    if not guesses:
        return ""
    return f"did you mean {guesses[0]!r}? "
