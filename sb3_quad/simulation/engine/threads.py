"""Helping threads for the batched environment, and the line that says when compiling takes a while.

Numba's own thread pools do not suit small batches: one sleeps and takes tens of microseconds to start, another spins
between calls, fights torch for the cores and forbids fork. Here a helper looks for work for some microseconds after its
last block, then sleeps; it is never waited for unless it holds a block.
"""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from sb3_quad.simulation.engine.batch_kernel import AWAKE, DONE, JOB_SIZE, work
from sb3_quad.simulation.engine.lowlevel import LANES
from sb3_quad.simulation.observation import OBSERVATION_SIZE

PATIENCE = 20_000  # looks for work before a helper sleeps: some 30 microseconds
WORTHWHILE = 3  # blocks; fewer are done before a helper has woken
REST = 100  # jobs done without helpers after one kept a job waiting: its core is busy with something else


def available_cpus() -> int:
    """CPUs that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _no_job() -> tuple[npt.NDArray[Any], ...]:
    return (
        np.zeros(JOB_SIZE, dtype=np.int64),
        np.zeros((1, 4), dtype=np.float32),
        np.zeros((1, OBSERVATION_SIZE), dtype=np.float32),
        np.zeros(1, dtype=np.float32),
        np.zeros(1, dtype=np.bool_),
    )


class Helpers:
    """Threads that take blocks of whatever job is under way; one job at a time."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.control = np.zeros(AWAKE + 16 * max(available_cpus(), 64), dtype=np.int64)
        self.resting = 0
        self._signals: list[threading.Semaphore] = []

    def wake(self, count: int) -> None:
        """Have ``count`` helpers look for work."""
        while len(self._signals) < count:
            self._start()
        for k in range(count):
            if not self.control[AWAKE + 16 * k]:
                self.control[AWAKE + 16 * k] = 1
                self._signals[k].release()

    def _start(self) -> None:
        number = len(self._signals)
        signal = threading.Semaphore(0)
        self._signals.append(signal)
        threading.Thread(target=_help, args=(self.control, number, signal), daemon=True, name="sb3_quad helper").start()


def _help(control: npt.NDArray[np.int64], number: int, signal: threading.Semaphore) -> None:
    nothing = _no_job()
    while True:
        signal.acquire()
        work(control, number, PATIENCE, *nothing)


_helpers = Helpers()


def _renew() -> None:
    global _helpers
    _helpers = Helpers()  # a forked child has no threads but the one that forked


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew)


def run(job: npt.NDArray[np.int64], n: int, threads: int, arrays: tuple[npt.NDArray[Any], ...]) -> bool:
    """Do a job of n rows by up to ``threads`` threads; False if an action is not finite, and then nothing has happened."""
    helpers = _helpers
    blocks = -(-n // LANES)
    count = min(threads, blocks, 64) - 1 if blocks >= WORTHWHILE else 0
    if count > 0 and helpers.resting > 0:
        helpers.resting -= 1
        count = 0
    if count < 1 or not helpers.lock.acquire(blocking=False):
        return bool(work(_alone(), -1, PATIENCE, job, *arrays) >= 0)
    try:
        helpers.wake(count)
        outcome = work(helpers.control, -1, PATIENCE, job, *arrays)
        if outcome == 0:
            helpers.resting = REST
            while helpers.control[DONE] < blocks:
                time.sleep(0)
        return bool(outcome >= 0)
    finally:
        helpers.lock.release()


_own = threading.local()


def _alone() -> npt.NDArray[np.int64]:
    """A control array that no helper looks at, of this thread."""
    if not hasattr(_own, "control"):
        _own.control = np.zeros(AWAKE + 16, dtype=np.int64)
    control: npt.NDArray[np.int64] = _own.control
    return control


@contextlib.contextmanager
def compilation_notice(after: float = 1.5) -> Iterator[None]:
    """Say on stderr that code is being compiled, if the block under it takes longer than ``after`` seconds."""
    message = "sb3_quad: compiling the batched environment, once; it is kept for later runs (about 15 s)\n"
    timer = threading.Timer(after, lambda: sys.stderr.write(message))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
