"""Tasks on a Ray cluster: placement, retries and what travels between machines are Ray's."""

import os
import shutil
import socket
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import torch

import sb3_quad
from sb3_quad.base.errors import ConfigError, WorkerDied
from sb3_quad.base.imports import require
from sb3_quad.base.trust import VARIABLE, trusted

RETRIES = 3  # of a task whose node or worker process dies
ANSWER = 15.0  # s that a cluster has to answer
PORT = 6379  # of a cluster's head, where an address names none
CLIENT, CLIENT_PORT = "ray://", 10001


@dataclass(eq=False)
class RayTask:
    """A call on the cluster."""

    reference: Any

    def result(self) -> Any:
        """See :meth:`~sb3_quad.executors.protocol.Task.result`."""
        import ray

        ended = (
            ray.exceptions.WorkerCrashedError,
            ray.exceptions.NodeDiedError,
            ray.exceptions.OutOfMemoryError,
            ray.exceptions.ObjectLostError,
            ray.exceptions.TaskCancelledError,
        )
        try:
            return ray.get(self.reference)
        except ended as error:
            reason = " ".join(str(error).split())[:120]
            raise WorkerDied(f"its worker on the cluster ended, and {RETRIES} more after it ({reason})") from None
        except ray.exceptions.RayTaskError as error:
            raise error.as_instanceof_cause() from None


class RayExecutor:
    """Tasks on a cluster at an address, or on one that is started here for as long as this executor lives.

    A task whose worker or node dies is begun again on another, by Ray, up to ``RETRIES`` times. Workers of a cluster at an
    address get this package from here (``runtime_env``); what it depends on is installed there.

    :raises ConfigError: an address at which no cluster answers within 20 s.
    """

    remote = True

    def __init__(self, workers: int, address: str | None = None, num_cpus: float = 1, num_gpus: float = 0) -> None:
        ray = self._ray = require("ray", "ray", "--executor ray")
        self._needs = {"num_cpus": num_cpus, "num_gpus": num_gpus, "max_retries": RETRIES}
        self._references: dict[Any, RayTask] = {}
        self._package = tempfile.TemporaryDirectory(prefix="sb3_quad-")
        variables = {VARIABLE: "1"} if trusted() else {}
        environment: dict[str, Any] = {"env_vars": variables}
        options: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR", "runtime_env": environment}
        try:
            if address is None:
                variables["PYTHONPATH"] = os.pathsep.join(map(os.path.abspath, sys.path))
                local = {"num_cpus": workers * num_cpus, "include_dashboard": False}
                os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # Ray's warning about it is none of ours
                os.environ.setdefault("RAY_worker_niceness", "0")  # Ray's 15 leaves them nothing beside other work
                ray.init(address="local", **local, **options)
            else:
                check_cluster(address)
                environment["py_modules"] = [str(_copy_package(Path(self._package.name)))]
                ray.init(address=address, **options)
            total = ray.cluster_resources()
        except ConfigError:
            self._package.cleanup()
            raise
        except Exception as error:  # Ray raises what it likes
            self._package.cleanup()
            reason = " ".join(str(error).split())[:200]
            raise ConfigError(f"Ray cluster {address or 'on this machine'}: cannot be used ({reason})") from None
        self.workers = max(1, int(total.get("CPU", 0) // num_cpus) if num_cpus else workers)

    @property
    def pending(self) -> int:
        """Tasks on the cluster."""
        return len(self._references)

    def submit(self, function: Callable[..., Any], *arguments: Any) -> RayTask:
        """Have a function called on the cluster, as soon as it has room."""
        call = self._ray.remote(_call).options(name=getattr(function, "__name__", "task"), **self._needs)
        task = RayTask(call.remote(sys.argv, function, *arguments))
        self._references[task.reference] = task
        return task

    def wait(self, seconds: float | None = None) -> Sequence[RayTask]:
        """Wait for a task to be done, at most for some seconds."""
        if not self._references:
            return []
        done, _ = self._ray.wait([*self._references], num_returns=1, timeout=seconds)
        return [self._references.pop(reference) for reference in done]

    def cancel(self) -> None:
        """Forget all tasks; those under way are interrupted."""
        for reference in self._references:
            self._ray.cancel(reference, force=True)

    def close(self) -> None:
        """Leave the cluster, or end the one that was started here."""
        if self._ray.is_initialized():
            self.cancel()
        self._references.clear()
        self._ray.shutdown()
        self._package.cleanup()

    def __enter__(self) -> "RayExecutor":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


def check_cluster(address: str) -> None:
    """See that a cluster answers at an address, so that nobody waits for one that does not.

    :raises ConfigError: nobody answers within 20 s.
    """
    if address == "auto":  # Ray looks for one on this machine, and says at once that there is none
        return
    host, _, port = address.removeprefix(CLIENT).rpartition(":")
    if not host:
        host, port = port, str(CLIENT_PORT if address.startswith(CLIENT) else PORT)
    if not port.isdigit() or not host:
        raise ConfigError(f"address {address!r}: must be auto, host:port or ray://host:port")
    refused = ConfigError(
        f"address {address}: no Ray cluster answers; start one with: ray start --head --port {PORT}, or leave --address out"
    )
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=4.0).close()
    except (OSError, OverflowError):
        raise refused from None
    if os.environ.get("RAY_USE_TLS", "0") not in ("", "0"):
        return
    grpc = require("grpc", "ray", "--address")  # which Ray speaks; Ray itself keeps trying where something else answers
    with grpc.insecure_channel(f"{host}:{port}") as channel:
        try:
            grpc.channel_ready_future(channel).result(timeout=ANSWER)
        except grpc.FutureTimeoutError:
            raise refused from None


def _copy_package(folder: Path) -> Path:
    """This package as a wheel lays it out, so that a checkout's ``envs/`` and its like are where others find them.

    What is compiled already comes along; a node of another kind compiles anew.
    """
    target = folder / "sb3_quad"
    roots = [Path(path) for path in sb3_quad.__path__]
    ignored = shutil.ignore_patterns("*.pyc")
    shutil.copytree(roots[0], target, ignore=ignored)
    for root in roots[1:]:
        for name in ("envs", "callbacks", "zoo_configs"):
            if (root / name / "__init__.py").is_file() and not (target / name).exists():
                shutil.copytree(root / name, target / name, ignore=ignored)
    return target


def _call(argv: list[str], function: Callable[..., Any], *arguments: Any) -> Any:
    """On a worker, for whom the command line is that of the driver, as of a process that it spawns: runs note it."""
    sys.argv = argv
    torch.set_num_threads(1)
    return function(*arguments)
