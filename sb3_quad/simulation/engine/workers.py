"""The threads that share a batch's work, and the line that says that numba compiles.

Numba's own thread pools do not suit small batches: one sleeps and takes tens of microseconds to start, another spins
between calls, fights torch for the cores and forbids fork. Here a worker looks for blocks for some microseconds after its
last one, then sleeps; nobody waits for it unless it holds a block.
"""

import os
import sys
import threading
import time
from contextlib import AbstractContextManager

import numpy as np
from numba.core import event

from sb3_quad.base.arrays import IntArray
from sb3_quad.simulation.engine.lowlevel import LANES
from sb3_quad.simulation.engine.work import AWAKE, DONE, JOB, LINE, StepArrays, step_arrays, work

PATIENCE = 20_000  # looks for a block before a worker sleeps: some 30 microseconds
WORTHWHILE = 3  # blocks; fewer are done before a worker has woken
REST = 100  # jobs done without workers after one kept a job waiting: its core is busy with something else
MOST = 64  # workers


def available_cpus() -> int:
    """CPUs that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Workers:
    """Threads that take blocks of whatever job is under way; one job at a time."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.control = np.zeros(AWAKE + LINE * max(available_cpus(), MOST), dtype=np.int64)
        self.resting = 0
        self._signals: list[threading.Semaphore] = []

    def wake(self, count: int) -> None:
        """Have ``count`` workers look for blocks."""
        while len(self._signals) < count:
            number, signal = len(self._signals), threading.Semaphore(0)
            self._signals.append(signal)
            threading.Thread(target=_loop, args=(self.control, number, signal), daemon=True, name="sb3_quad worker").start()
        for k in range(count):
            if not self.control[AWAKE + LINE * k]:
                self.control[AWAKE + LINE * k] = 1
                self._signals[k].release()


def _loop(control: IntArray, number: int, signal: threading.Semaphore) -> None:
    nothing = np.zeros(1, dtype=JOB).view(np.int64), *step_arrays(1)
    while True:
        signal.acquire()
        work(control, number, PATIENCE, *nothing)


_workers = Workers()


def _renew() -> None:
    global _workers
    _workers = Workers()  # a forked child has no threads but the one that forked


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew)


def run(job: IntArray, threads: int, arrays: StepArrays) -> bool:
    """Do a job, see :func:`~.work.work`, by up to ``threads`` threads.

    :return: False if an action is not finite, and then nothing has happened.
    """
    workers = _workers
    blocks = -(-len(arrays.dones) // LANES)
    count = min(threads, blocks, MOST) - 1 if blocks >= WORTHWHILE else 0
    if count > 0 and workers.resting > 0:
        workers.resting -= 1
        count = 0
    if count < 1 or not workers.lock.acquire(blocking=False):
        alone = np.zeros(AWAKE + LINE, dtype=np.int64)  # a control array that no worker looks at
        return bool(work(alone, -1, PATIENCE, job, *arrays) >= 0)
    try:
        workers.wake(count)
        outcome = work(workers.control, -1, PATIENCE, job, *arrays)
        if outcome == 0:
            workers.resting = REST
            while workers.control[DONE] < blocks:
                time.sleep(0)
        return bool(outcome >= 0)
    finally:
        workers.lock.release()


def compilation_notice() -> AbstractContextManager[None]:
    """Say on stderr, once, that numba compiles something meanwhile; what it finds in its cache is not compiled."""
    notice: AbstractContextManager[None] = event.install_listener("numba:compile", _Notice())
    return notice


class _Notice(event.Listener):
    told = False

    def on_start(self, event: event.Event) -> None:
        if not self.told:
            sys.stderr.write("sb3_quad: compiling the simulation, once; it is kept for later runs (about 15 s)\n")
        self.told = True

    def on_end(self, event: event.Event) -> None:
        pass
