"""State of the whole process: its signals, its CPUs, whether it trusts files, and notices that it
prints once.
"""

import functools
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from sb3_quad.base.errors import ConfigError

# A closed terminal sends SIGHUP. Windows has no such signal.
_SIGHUP: "signal.Signals | None" = getattr(signal, "SIGHUP", None)
_FROM_THE_TERMINAL = [number for number in (signal.SIGINT, _SIGHUP) if number is not None]
SIGNALS = (*_FROM_THE_TERMINAL, signal.SIGTERM)
TRUST_VARIABLE = "SB3_QUAD_TRUST"
_YES = ("1", "true", "yes", "on")
_NO = ("", "0", "false", "no", "off")

_most_cpus = sys.maxsize


class StopSignals:
    """Turn Ctrl-C, SIGTERM and SIGHUP into a request to stop within a ``with`` block.

    The first signal is only noted, so that the program can stop where it is safe. The second one
    raises KeyboardInterrupt, and further ones do nothing. Outside the main thread, where Python
    allows no handlers, signals keep their usual effect. SIGHUP stays ignored under ``nohup``.
    Blocks may be nested: the outer one sees the signal that the inner one received.

    :param patience: Number of signals that are only noted. With 0 the first one raises
        KeyboardInterrupt.
    """

    def __init__(self, patience: int = 1) -> None:
        self.received: int | None = None
        self._patience = patience
        self._previous: dict[int, Any] = {}

    @property
    def exit_code(self) -> int:
        """The exit code that a shell expects after a signal, such as 130 after SIGINT. 0 if none
        came.
        """
        if self.received is None:
            return 0
        return 128 + self.received

    @property
    def name(self) -> str:
        """The signal's name, empty if none came."""
        if self.received is None:
            return ""
        return signal.Signals(self.received).name

    def __enter__(self) -> "StopSignals":
        if threading.current_thread() is threading.main_thread():
            for number in SIGNALS:
                # Under nohup the program is meant to survive a closed terminal.
                if number != _SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
                    self._previous[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        if self.received is not None:
            outer = getattr(self._previous.get(self.received), "__self__", None)
            if isinstance(outer, StopSignals):
                outer.received = self.received

    def hold(self) -> None:
        """Only note signals from now on, so that nothing interrupts a save."""
        self._patience = -1

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.received = self.received or number
        self._patience -= 1
        if self._patience == -1:
            raise KeyboardInterrupt


@contextmanager
def interrupts_leave() -> Iterator[None]:
    """Let Ctrl-C kill the program at once within the block, with the shell's exit code 130. For
    imports.

    A KeyboardInterrupt comes out of some compiled modules as an ImportError, or not at all.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def ignore_interrupts() -> None:
    """Ignore the signals of the terminal in a worker process, which the training process ends."""
    for number in _FROM_THE_TERMINAL:
        signal.signal(number, signal.SIG_IGN)


def use_cpus(count: int) -> None:
    """Limit the CPUs of this process, which shares a machine with others."""
    global _most_cpus
    _most_cpus = count


def available_cpus() -> int:
    """The number of CPUs that this process may use."""
    # Only Linux tells the CPUs that a process is restricted to.
    if hasattr(os, "sched_getaffinity"):
        return min(len(os.sched_getaffinity(0)), _most_cpus)
    return min(os.cpu_count() or 1, _most_cpus)


def trusted() -> bool:
    """Whether files may run their own code: after ``--trust``, or by ``SB3_QUAD_TRUST=1``.

    :raises ConfigError: the variable is neither yes nor no.
    """
    value = os.environ.get(TRUST_VARIABLE, "").lower()
    if value not in (*_YES, *_NO):
        raise ConfigError(f"{TRUST_VARIABLE}={value!r}: must be 1 to trust files, or 0")
    return value in _YES


@contextmanager
def trusting(asked: bool) -> Iterator[None]:
    """Trust all files within the block, if ``asked``. Workers inherit it through an environment
    variable.
    """
    before = os.environ.get(TRUST_VARIABLE, "")
    if asked:
        os.environ[TRUST_VARIABLE] = "1"
    try:
        yield
    finally:
        if asked:
            os.environ[TRUST_VARIABLE] = before


@functools.cache
def print_once(line: str) -> None:
    """Print a notice on stderr, unless this process has printed it already."""
    sys.stderr.write(f"sb3_quad: {line}\n")
