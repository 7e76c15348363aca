"""Worker processes on this machine, one core each."""

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from typing import Any

import torch

from sb3_quad.base.errors import WorkerDied
from sb3_quad.base.process import ignore_interrupts

# Windows has no SIGKILL. Its SIGTERM ends a process at once.
_KILL = getattr(signal, "SIGKILL", signal.SIGTERM)


class LocalExecutor:
    """Up to ``workers`` processes, each started when it is first needed.

    A thread of this process waits for each worker. Each worker is a separate pool, so that one that
    dies does not end the calls of others; its own call is tried once more. Workers end with the
    process that started them, even if that is killed. They ignore Ctrl-C, which this process
    handles.
    """

    def __init__(self, workers: int) -> None:
        self._threads = ThreadPoolExecutor(workers)
        # The pool and the process id of each thread's worker.
        self._worker = threading.local()
        self._processes = set[int]()
        self._stopped = False

    def submit(self, function: Callable[..., Any], *arguments: Any) -> "Future[Any]":
        return self._threads.submit(self._call, function, *arguments)

    def stop(self) -> None:
        """Cancel the calls that wait, and send SIGTERM to the running ones.

        A training answers SIGTERM by saving.
        """
        self._end(signal.SIGTERM)

    def __enter__(self) -> "LocalExecutor":
        return self

    def __exit__(self, *error: object) -> None:
        self._end(_KILL)
        self._threads.shutdown()

    def _end(self, number: int) -> None:
        self._stopped = True
        self._threads.shutdown(wait=False, cancel_futures=True)
        for process in list(self._processes):
            with suppress(ProcessLookupError):
                os.kill(process, number)

    def _call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call a function in the worker of the present thread."""
        worker = self._worker
        # A worker that dies is replaced once: it may have lacked memory that others have released.
        for _ in range(2):
            with suppress(BrokenProcessPool):
                if not hasattr(worker, "pool") and not self._stopped:
                    worker.pool = ProcessPoolExecutor(1, _context(), _begin)
                    worker.process = worker.pool.submit(os.getpid).result()
                    self._processes.add(worker.process)
                # A worker that was still unknown when the executor stopped got no signal.
                if self._stopped:
                    break
                return worker.pool.submit(function, *arguments).result()
            self._processes.discard(getattr(worker, "process", 0))
            worker.__dict__.clear()
        raise WorkerDied("its worker process ended unexpectedly (out of memory?)")


def _context() -> Any:
    """Return how workers start: on Linux, forked from a server that has done the slow imports;
    elsewhere, as new processes.
    """
    if sys.platform != "linux":
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["torch", "stable_baselines3", "numba"])
    return context


def _begin() -> None:
    ignore_interrupts()
    threading.Thread(target=_end_with_starter, daemon=True).start()
    torch.set_num_threads(1)


def _end_with_starter() -> None:
    """End this worker as soon as the process that started it has ended, even by being killed."""
    starter = multiprocessing.parent_process()
    assert starter is not None
    starter.join()
    os._exit(1)
