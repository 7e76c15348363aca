"""PyTorch's threads. They wait for one another at every operation: over networks of 64 to 256 units
that is hardly faster than one, and beside another process it takes several times as long.
"""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

import torch as th

from sb3_quad.base.process import available_cpus


@contextmanager
def one_thread() -> Iterator[None]:
    """Give PyTorch one thread for the duration of the block."""
    threads = th.get_num_threads()
    th.set_num_threads(1)
    try:
        yield
    finally:
        th.set_num_threads(threads)


def one_thread_by_default() -> AbstractContextManager[None]:
    """Like :func:`one_thread`, but leave a number that ``torch.set_num_threads`` was given.

    By itself PyTorch takes a thread for each CPU, or for each core, which may be half as many.
    """
    cpus = available_cpus()
    return one_thread() if th.get_num_threads() in (cpus, cpus // 2) else nullcontext()
