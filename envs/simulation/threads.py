"""Threads that share a compiled function's work in chunks.

Every thread takes the next free chunk: a thread that comes late, or not at all, costs time but
changes nothing. Numba's own pools do not suit: one spins between calls and competes with torch for
the cores, and forbids fork.
"""

import os
import queue
import threading
from collections.abc import Callable
from typing import Any

import numpy as np

from sb3_quad.base.compiled import atomic_add, give_way, inner

Function = Callable[..., Any]
# Places in a control array, each on its own cache line, and the array's size
LEFT, DONE, LATE, CONTROL = range(0, 64, 16)
# Checks of a chunk that another thread still has, before this thread yields its core: about 30 µs
SPIN = 20_000
# Further checks, after which the call counts as late: longer than a chunk takes
PATIENCE = 5_000
# Calls without other threads after a late one, since something else keeps their core busy
REST = 100


@inner
def finish(control, chunks):
    """Wait for the chunks that other threads still have. ``control[LATE]`` says whether one has
    lost its core.
    """
    looks = 0
    while atomic_add(control, DONE, 0) < chunks:
        looks += 1
        if looks > SPIN:
            give_way()
    control[LATE] = looks > SPIN + PATIENCE


class _Pool:
    """Threads that sleep until there is a call whose chunks they can take."""

    def __init__(self) -> None:
        self.begun = self.resting = 0
        self.calls: queue.SimpleQueue[tuple[Function, Any]] = queue.SimpleQueue()

    def help(self) -> None:
        while True:
            function, arguments = self.calls.get()
            function(*arguments)
            # Keep nothing alive while this thread sleeps.
            del function, arguments


_pool = _Pool()


def share_out(function: Function, helpers: int, *arguments: Any) -> Any:
    """Return ``function(control, True, *arguments)``, while up to ``helpers`` threads call it with
    False.

    :param function: a compiled function. With True it sets ``control[LEFT]`` to the number of
        chunks first, and calls :func:`finish` last. In all threads it takes chunks by
        ``atomic_add(control, LEFT, -1)`` and counts those done in ``control[DONE]``. It is one
        call, because Python handles an interrupt between two calls, and nothing may be left half
        done.
    """
    pool = _pool
    control = np.zeros(CONTROL, np.int64)
    if helpers < 1:
        # A call without helpers does not shorten the rest of other calls.
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
    # A forked child has only the thread that forked.
    _pool = _Pool()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew)
