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


class LocalExecutor:
    """Up to ``workers`` processes, each started when it is first needed.

    A thread of this process waits for each of them. Each is a pool of its own, so that one that
    dies takes no other's call along. They end with the process that started them, also where that
    is killed. Ctrl-C in a terminal is left to it.
    """

    def __init__(self, workers: int) -> None:
        self.workers = workers
        self._threads = ThreadPoolExecutor(workers)
        self._own = threading.local()  # by thread: its pool and its process
        self._processes = set[int]()
        self._stopped = False

    def submit(self, function: Callable[..., Any], *arguments: Any) -> "Future[Any]":
        return self._threads.submit(self._call, function, *arguments)

    def stop(self) -> None:
        """Cancel the calls that have not begun; SIGTERM to those under way, by which a training
        saves and ends.
        """
        self._end(signal.SIGTERM)

    def __enter__(self) -> "LocalExecutor":
        return self

    def __exit__(self, *error: object) -> None:
        self._end(signal.SIGKILL)
        self._threads.shutdown()

    def _end(self, number: int) -> None:
        self._stopped = True
        self._threads.shutdown(wait=False, cancel_futures=True)
        for process in list(self._processes):
            with suppress(ProcessLookupError):
                os.kill(process, number)

    def _call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """In a thread: have its process call a function."""
        own = self._own
        try:
            if not hasattr(own, "pool"):
                own.pool = ProcessPoolExecutor(1, _context(), _begin)
                own.process = own.pool.submit(os.getpid).result()
                self._processes.add(own.process)
            if self._stopped:  # before the process was known, which has had no signal then
                raise BrokenProcessPool
            return own.pool.submit(function, *arguments).result()
        except BrokenProcessPool:
            self._processes.discard(getattr(own, "process", 0))
            own.__dict__.clear()
            raise WorkerDied("its worker process ended unexpectedly (out of memory?)") from None


def _context() -> Any:
    """How workers start: forked from a process that has imported what takes seconds and does
    nothing else; else anew.
    """
    if sys.platform != "linux":
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["torch", "stable_baselines3", "numba"])
    return context


def _begin() -> None:
    ignore_interrupts()  # the process that started the workers ends them
    threading.Thread(target=_end_with_starter, daemon=True).start()
    torch.set_num_threads(1)


def _end_with_starter() -> None:
    """End this worker as soon as the process that it works for has ended, also by being killed."""
    starter = multiprocessing.parent_process()
    assert starter is not None
    starter.join()
    os._exit(1)
