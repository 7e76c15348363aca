"""Worker processes on this machine, one core each."""

import multiprocessing
import os
import sys
import threading
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from types import TracebackType
from typing import Any

import torch

from sb3_quad.base.errors import WorkerDied
from sb3_quad.base.signals import ignore_interrupts


@dataclass(eq=False)
class LocalTask:
    """A call, and what became of it."""

    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    future: "Future[Any] | None" = None

    def result(self) -> Any:
        """See :meth:`~sb3_quad.executors.protocol.Task.result`."""
        assert self.future is not None, "the task is not done"
        try:
            return self.future.result()
        except BrokenProcessPool:
            raise WorkerDied("its worker process ended unexpectedly (out of memory?)") from None


@dataclass(eq=False)
class _Worker:
    """A pool of one process, so that a dead worker is known by its task, and no other task is lost."""

    pool: ProcessPoolExecutor
    process: BaseProcess | None = None


class LocalExecutor:
    """Up to ``workers`` processes, each started when it is first needed.

    They end with the process that started them, also where that is killed. Ctrl-C in a terminal is left to that process.
    """

    remote = False

    def __init__(self, workers: int) -> None:
        self.workers = workers
        self._context = _context()
        self._watched, self._held = self._context.Pipe(duplex=False)  # what holds it open is closed, or ends with us
        self._waiting = deque[LocalTask]()
        self._at_work = dict["Future[Any]", tuple[LocalTask, _Worker]]()
        self._idle = list[_Worker]()

    @property
    def pending(self) -> int:
        """Tasks that wait or are under way."""
        return len(self._waiting) + len(self._at_work)

    def submit(self, function: Callable[..., Any], *arguments: Any) -> LocalTask:
        """Have a function called, as soon as a worker is free and :meth:`wait` is called."""
        task = LocalTask(function, arguments)
        self._waiting.append(task)
        return task

    def wait(self, seconds: float | None = None) -> Sequence[LocalTask]:
        """Begin tasks; wait for one to be done, at most for some seconds."""
        while self._waiting and len(self._at_work) < self.workers:
            self._begin(self._waiting.popleft())
        done = []
        for future in wait(self._at_work, seconds, FIRST_COMPLETED).done:
            task, worker = self._at_work.pop(future)
            if isinstance(future.exception(), BrokenProcessPool):
                worker.pool.shutdown()
            else:
                self._idle.append(worker)
            done.append(task)
        return done

    def cancel(self) -> None:
        """Forget the tasks that wait; SIGTERM to the workers under way, by which a training saves and ends."""
        self._waiting.clear()
        for _, worker in self._at_work.values():
            if worker.process is not None:
                worker.process.terminate()

    def close(self) -> None:
        """End all workers."""
        for worker in self._idle:
            worker.pool.shutdown()
        self._held.close()
        for _, worker in self._at_work.values():
            worker.pool.shutdown(cancel_futures=True)
        self._watched.close()

    def __enter__(self) -> "LocalExecutor":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def _begin(self, task: LocalTask) -> None:
        worker = self._idle.pop() if self._idle else _Worker(ProcessPoolExecutor(1, self._context, _begin, (self._watched,)))
        before = set(multiprocessing.active_children())
        task.future = worker.pool.submit(task.function, *task.arguments)
        started = set(multiprocessing.active_children()) - before
        if worker.process is None and started:
            worker.process = started.pop()
        self._at_work[task.future] = task, worker


def _context() -> Any:
    """How workers start: forked from a process that has imported what takes seconds and does nothing else; else anew."""
    if sys.platform != "linux":
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["torch", "stable_baselines3", "numba"])
    return context


def _begin(watched: Connection) -> None:
    ignore_interrupts()  # the process that started the workers ends them
    threading.Thread(target=_end_with_starter, args=(watched,), daemon=True).start()
    torch.set_num_threads(1)


def _end_with_starter(watched: Connection) -> None:
    """End this worker as soon as the process that it works for is done with it, also by being killed."""
    watched.poll(None)
    os._exit(1)
