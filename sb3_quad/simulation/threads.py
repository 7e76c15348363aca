"""The threads that share a batch's work, and the line that says that numba compiles.

Numba's own thread pools do not suit small batches: one sleeps and takes tens of microseconds to start, another spins
between calls, fights torch for the cores and forbids fork. Here a worker looks for blocks for some microseconds after its
last one, then sleeps; nobody waits for it unless it holds a block.
"""

import os
import sys
import threading
import weakref
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any

import numpy as np
from numba.core import event

from sb3_quad.base.arrays import IntArray
from sb3_quad.base.cores import available_cpus
from sb3_quad.simulation.cache import compiled_by_one
from sb3_quad.simulation.compiled import LANES
from sb3_quad.simulation.kernel import AWAKE, BUSY, JOB, LATE, LINE, NOT_FINITE, StepArrays, step_arrays, work

PATIENCE = 20_000  # looks for a block before a worker sleeps: some 30 microseconds
WORTHWHILE = 3  # blocks; fewer are done before a worker has woken
REST = 100  # jobs done without workers after one kept a job waiting: its core is busy with something else
MOST = 64  # workers


class Workers:
    """Threads that take blocks of whatever job is under way; one job at a time."""

    def __init__(self) -> None:
        self.control = np.zeros(AWAKE + LINE * max(available_cpus(), MOST), dtype=np.int64)
        self.resting = 0
        self._lock = threading.Lock()
        self._asleep: list[threading.Lock] = []  # a worker sleeps by locking its own twice

    def wake(self, count: int) -> None:
        """Have ``count`` workers look for blocks."""
        with self._lock:
            for number in range(len(self._asleep), count):
                asleep = threading.Lock()
                threading.Thread(
                    target=_loop, args=(self.control, number, asleep), daemon=True, name="sb3_quad worker"
                ).start()
                self._asleep.append(asleep)
            for k in range(count):
                if not self.control[AWAKE + LINE * k] and self._asleep[k].locked():
                    self._asleep[k].release()


def _loop(control: IntArray, number: int, asleep: threading.Lock) -> None:
    nothing = np.zeros(1, dtype=JOB).view(np.int64), *step_arrays(1, 1)
    while True:
        asleep.acquire()
        work(control, number, PATIENCE, *nothing)


_workers = Workers()
_batch_locks: weakref.WeakSet[Any] = weakref.WeakSet()


def batch_lock() -> AbstractContextManager[Any]:
    """A lock for a batch, which one thread may take several times; free in a forked child, whatever the parent was at."""
    lock = threading.RLock()
    _batch_locks.add(lock)
    return lock


def _renew() -> None:
    global _workers
    _workers = Workers()  # a forked child has no threads but the one that forked
    for lock in _batch_locks:
        lock._at_fork_reinit()


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
    outcome = BUSY
    if count > 0:
        workers.wake(count)
        outcome = work(workers.control, -1, PATIENCE, job, *arrays)
        if outcome == LATE:
            workers.resting = REST
    if outcome == BUSY:
        alone = np.zeros(AWAKE, dtype=np.int64)  # a control array that no worker looks at
        outcome = work(alone, -1, PATIENCE, job, *arrays)
    return bool(outcome != NOT_FINITE)


@contextmanager
def first_run() -> Iterator[None]:
    """Around a :func:`run` that may compile: of processes that start together one does, and says so, the others wait."""
    with compilation_notice(), compiled_by_one(work):
        yield


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
