"""Where functions are executed: worker processes of this machine, or a Ray cluster; one small seam
for both.
"""

from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.base.process import StopSignals
from sb3_quad.executors.local import LocalExecutor

EXECUTORS = ("local", "ray")
TICK = 1.0  # s between two looks for a signal
Key = TypeVar("Key")

if TYPE_CHECKING:
    from sb3_quad.executors.ray import RayExecutor

Executor: TypeAlias = "LocalExecutor | RayExecutor"
"""Calls functions in processes that each have one thread of PyTorch, by ``submit``.

A function is given by the name of its module, so it stands at the top of one; arguments and results
are pickled. Its future raises :class:`~sb3_quad.base.errors.WorkerDied` if the worker ended first.
"""


def start_executor(
    kind: str, workers: int, address: str | None = None, num_cpus: float = 1, num_gpus: float = 0
) -> Executor:
    """An executor, to be used as a context manager, at whose end all workers end at once.

    :param kind: ``local`` or ``ray``.
    :param workers: calls side by side; a cluster at an ``address`` has as many as it has room for.
    :param address: of a Ray cluster: ``auto``, ``host:port`` or ``ray://host:port``; None: one is
        started on this machine.
    :param num_cpus: cores that a call takes, for Ray to place it.
    :param num_gpus: GPUs that a call takes.
    :raises ConfigError: an unknown kind, fewer than one worker, an address that does not answer;
        :class:`~sb3_quad.base.errors.MissingExtra` without Ray.
    """
    if kind not in EXECUTORS:
        raise ConfigError(unknown("executor", kind, EXECUTORS))
    if workers < 1:
        raise ConfigError(f"workers {workers}: must be at least 1")
    if kind == "local":
        if address is not None:
            raise ConfigError(f"address {address}: goes with --executor ray")
        return LocalExecutor(workers)
    from sb3_quad.executors.ray import RayExecutor  # only where it is asked for

    return RayExecutor(workers, address, num_cpus, num_gpus)


def as_they_end(
    executor: Executor,
    calls: "dict[Future[Any], Key]",
    signals: StopSignals,
    report: Callable[[str], None],
) -> "Iterator[tuple[Key, Future[Any]]]":
    """Calls as they end, by what they are called; after a signal the executor is stopped, and what
    it cancelled left out.

    :param calls: emptied; more may be put in on the way.
    """
    stopped = False
    while calls:
        wait(calls, TICK, FIRST_COMPLETED)
        for future in [
            each for each in calls if each.done()
        ]:  # those cancelled, too, which wait() does not see
            key = calls.pop(future)
            if not future.cancelled():
                yield key, future
        if signals.received is not None and not stopped:
            stopped = True
            report(f"{signals.name}: what is under way is saved and ends")
            executor.stop()
