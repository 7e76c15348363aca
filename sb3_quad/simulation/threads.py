"""Threads that share a compiled function's work in chunks.

Whoever comes takes the next chunk: a thread that is late, or never comes, costs time but changes
nothing. Numba's own pools do not suit: one spins between calls and fights torch for the cores, and
forbids fork.
"""

import os
import queue
import threading
from collections.abc import Callable
from typing import Any

import numpy as np

from sb3_quad.simulation.compiled import atomic_add, compiled, give_way

LEFT, DONE, LATE, CONTROL = (
    0,
    16,
    32,
    48,
)  # places in a control array, each on a cache line of its own, and its size
# Looks at a chunk that another thread still has, before that gets the core: some 30 microseconds
SPIN = 20_000
PATIENCE = 5_000  # looks after that, with which the call counts as late: longer than a chunk takes
REST = 100  # calls without other threads after a late one: their core is busy with something else


@compiled
def finish(control, chunks):
    """Wait for the chunks that other threads still have, and note in ``control[LATE]`` whether one
    has lost its core.
    """
    looks = 0
    while atomic_add(control, DONE, 0) < chunks:
        looks += 1
        if looks > SPIN:
            give_way()
    control[LATE] = looks > SPIN + PATIENCE


class _Pool:
    """Threads that sleep until there is a call to take chunks of."""

    def __init__(self) -> None:
        self.begun = self.resting = 0
        self.calls: queue.SimpleQueue[tuple[Callable[..., Any], Any]] = queue.SimpleQueue()

    def help(self) -> None:
        while True:
            function, arguments = self.calls.get()
            function(*arguments)
            del function, arguments  # nothing stays alive while this thread sleeps


_pool = _Pool()


def share_out(function: Callable[..., Any], helpers: int, *arguments: Any) -> Any:
    """``function(control, True, *arguments)``, while up to so many threads call it with False; what
    it returns here.

    :param function: a compiled one. With True it sets ``control[LEFT]`` to the number of chunks
        first, and at its end calls :func:`finish`. In all threads it takes chunks by
        ``atomic_add(control, LEFT, -1)`` and counts those done in ``control[DONE]``. It is one
        call, since an interrupt, which Python sees to between two calls, must leave nothing half
        done.
    """
    pool, control = _pool, np.zeros(CONTROL, np.int64)
    if helpers < 1:
        return function(control, True, *arguments)
    if pool.resting > 0:
        pool.resting -= 1
        helpers = 0
    while pool.begun < helpers:
        threading.Thread(target=pool.help, daemon=True, name="sb3_quad").start()
        pool.begun += 1
    for _ in range(helpers):
        pool.calls.put((function, (control, False, *arguments)))
    result = function(control, True, *arguments)
    if control[LATE]:
        pool.resting = REST
    return result


def _renew() -> None:
    global _pool
    _pool = _Pool()  # a forked child has no threads but the one that forked


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew)
