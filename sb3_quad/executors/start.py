"""What an executor does, and executors by name, as ``--executor`` gives them."""

from collections.abc import Callable
from concurrent.futures import Future
from types import TracebackType
from typing import Any, Protocol

from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.executors.local import LocalExecutor

EXECUTORS = ("local", "ray")


class Executor(Protocol):
    """Calls functions in processes that each have one thread of PyTorch.

    A function is given by the name of its module, so it stands at the top of one; arguments and results are pickled.
    """

    @property
    def workers(self) -> int:
        """How many calls run side by side, at most."""

    def submit(self, function: Callable[..., Any], *arguments: Any) -> "Future[Any]":
        """Have a function called. Its future raises :class:`~sb3_quad.base.errors.WorkerDied` if the worker ended first."""

    def stop(self) -> None:
        """Cancel the calls that have not begun, and ask those under way to stop."""

    def __enter__(self) -> "Executor": ...

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """End all workers, at once."""


def start_executor(kind: str, workers: int, address: str | None = None, num_cpus: float = 1, num_gpus: float = 0) -> Executor:
    """An executor, to be used as a context manager.

    :param kind: ``local`` or ``ray``.
    :param workers: calls side by side; a cluster at an ``address`` has as many as it has room for.
    :param address: of a Ray cluster: ``auto``, ``host:port`` or ``ray://host:port``; None: one is started on this machine.
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
