"""Ctrl-C and SIGTERM as a request to stop, answered where the training can be left cleanly."""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class StopSignals:
    """Within its ``with`` block, the first SIGINT or SIGTERM is only noted; a second one raises KeyboardInterrupt.

    Outside the main thread, where Python allows no handlers, signals act as ever. Blocks may be nested: the outer one learns
    of what the inner one received.
    """

    def __init__(self) -> None:
        self.received: int | None = None
        self._previous: dict[int, Any] = {}

    @property
    def exit_code(self) -> int:
        """What the shell expects of a program that a signal ended: 130 for SIGINT, 143 for SIGTERM; 0 if none came."""
        return 128 + self.received if self.received else 0

    @property
    def name(self) -> str:
        """The signal's name, empty if none came."""
        return signal.Signals(self.received).name if self.received else ""

    def __enter__(self) -> "StopSignals":
        if threading.current_thread() is threading.main_thread():
            self._previous = {number: signal.signal(number, self._note) for number in SIGNALS}
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        outer = getattr(self._previous.get(self.received or 0), "__self__", None)
        if isinstance(outer, StopSignals):
            outer.received = self.received

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.received is not None:
            raise KeyboardInterrupt
        self.received = number


@contextmanager
def interrupts_leave() -> Iterator[None]:
    """Within the block, Ctrl-C ends the program at once, with exit code 130: for imports.

    A KeyboardInterrupt there comes out of some compiled modules as an ImportError, or not at all.
    """

    def leave(number: int, frame: FrameType | None) -> None:
        os.write(2, b"interrupted\n")
        os._exit(130)

    main = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGINT, leave) if main else None
    try:
        yield
    finally:
        if main:
            signal.signal(signal.SIGINT, before)


def ignore_interrupts() -> None:
    """In a worker process: leave Ctrl-C, which the terminal sends to every process, to the one that trains."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
