"""Executors by name, as ``--executor`` gives them."""

from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.executors.local import LocalExecutor
from sb3_quad.executors.protocol import Executor

EXECUTORS = ("local", "ray")


def start_executor(kind: str, workers: int, address: str | None = None, num_cpus: float = 1, num_gpus: float = 0) -> Executor:
    """An executor, ready for tasks; to be closed, or used as a context manager.

    :param kind: ``local`` or ``ray``.
    :param workers: tasks side by side; a cluster at an ``address`` has as many as it has room for.
    :param address: of a Ray cluster: ``auto``, ``host:port`` or ``ray://host:port``; None: one is started on this machine.
    :param num_cpus: cores that a task takes, for Ray to place it.
    :param num_gpus: GPUs that a task takes.
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
