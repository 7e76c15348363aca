"""Executors, which call functions in other processes: workers on this machine, or a Ray cluster."""

from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from typing import TYPE_CHECKING, Any, TypeAlias

from sb3_quad.base.errors import ConfigError, refuse_unknown
from sb3_quad.base.process import StopSignals
from sb3_quad.base.types import Report
from sb3_quad.executors.local import LocalExecutor

EXECUTORS = ("local", "ray")
# Time between two checks for a signal, s.
TICK = 1.0

if TYPE_CHECKING:
    from sb3_quad.executors.ray import RayExecutor

Executor: TypeAlias = "LocalExecutor | RayExecutor"
"""Calls functions by ``submit``, in processes that each have one thread of PyTorch.

Functions are pickled by the name of their module, so they must be defined at its top level.
Arguments and results are pickled too. A future raises
:class:`~sb3_quad.base.errors.WorkerDied` if its worker ended first.
"""


def start_executor(
    kind: str, workers: int, address: str | None = None, num_cpus: float = 1, num_gpus: float = 0
) -> Executor:
    """Return an executor to use as a context manager, which ends all workers when it exits.

    :param kind: ``local`` or ``ray``.
    :param workers: Number of concurrent calls. A cluster at an ``address`` runs as many as fit.
    :param address: Address of a Ray cluster: ``auto``, ``host:port`` or ``ray://host:port``. With
        None, a cluster is started on this machine.
    :param num_cpus: Cores that Ray reserves for a call.
    :param num_gpus: GPUs that Ray reserves for a call.
    :raises ConfigError: An unknown kind, fewer than one worker, or an address that does not answer.
        :class:`~sb3_quad.base.errors.MissingExtra` without Ray.
    """
    refuse_unknown("executor", [kind], EXECUTORS)
    if kind == "local":
        if address is not None:
            raise ConfigError(f"address {address}: goes with --executor ray")
        return LocalExecutor(workers)
    # Ray is an extra.
    from sb3_quad.executors.ray import RayExecutor

    return RayExecutor(workers, address, num_cpus, num_gpus)


def as_they_end(
    executor: Executor,
    calls: "dict[Future[Any], Any]",
    signals: StopSignals,
    report: Report,
) -> "Iterator[tuple[Any, Future[Any]]]":
    """Yield the key and the future of each call when it ends.

    After a signal the executor is stopped. Calls that it cancels are not yielded.

    :param calls: The key of each call. It is emptied.
    """
    stopped = False
    while calls:
        wait(calls, TICK, FIRST_COMPLETED)
        # wait() does not report cancelled calls.
        for future in list(calls):
            if future.done():
                key = calls.pop(future)
                if not future.cancelled():
                    yield key, future
        if signals.received is not None and not stopped:
            stopped = True
            report(f"{signals.name}: running calls save their work and end")
            executor.stop()
