"""Ctrl-C, SIGTERM and SIGHUP as a request to stop, answered where the training can be left cleanly."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # the last when a terminal is closed


class StopSignals:
    """Within its ``with`` block, the first signal is only noted, the second raises
    KeyboardInterrupt, more do nothing.

    Outside the main thread, where Python allows no handlers, signals act as ever. SIGHUP stays
    ignored under ``nohup``. Blocks may be nested: the outer one learns of what the inner one
    received.

    :param patience: signals that are only noted; with 0 the first one raises KeyboardInterrupt.
    """

    def __init__(self, patience: int = 1) -> None:
        self.received: int | None = None
        self._patience = patience
        self._previous: dict[int, Any] = {}

    @property
    def exit_code(self) -> int:
        """What the shell expects of a program that a signal ended: such as 130 for SIGINT; 0 if
        none came.
        """
        return 128 + self.received if self.received else 0

    @property
    def name(self) -> str:
        """The signal's name, empty if none came."""
        return signal.Signals(self.received).name if self.received else ""

    def __enter__(self) -> "StopSignals":
        if threading.current_thread() is threading.main_thread():
            under_nohup = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
            handled = [number for number in SIGNALS if number != signal.SIGHUP or not under_nohup]
            self._previous = {number: signal.signal(number, self._note) for number in handled}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        outer = getattr(self._previous.get(self.received or 0), "__self__", None)
        if isinstance(outer, StopSignals):
            outer.received = self.received

    def hold(self) -> None:
        """From now on, only note signals: nothing interrupts what is saved."""
        self._patience = -1

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.received = self.received or number
        self._patience -= 1
        if self._patience == -1:
            raise KeyboardInterrupt


@contextmanager
def interrupts_leave() -> Iterator[None]:
    """Within the block, Ctrl-C kills the program at once, as the shell's exit code 130 says: for
    imports.

    A KeyboardInterrupt there comes out of some compiled modules as an ImportError, or not at all.
    """
    main = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGINT, signal.SIG_DFL) if main else None
    try:
        yield
    finally:
        if main:
            signal.signal(signal.SIGINT, before)


def ignore_interrupts() -> None:
    """In a worker process: leave the signals that a terminal sends to every process to the one that
    trains.
    """
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
