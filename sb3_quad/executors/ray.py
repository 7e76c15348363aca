"""Calls on a Ray cluster: placement, retries and the package's code on its nodes are Ray's."""

import os
import platform
import shutil
import socket
import sys
import tempfile
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import torch

from sb3_quad.base.errors import ConfigError, WorkerDied
from sb3_quad.base.imports import require
from sb3_quad.base.process import TRUST_VARIABLE, trusted

RETRIES = 3  # of a call whose node or worker process dies


class RayExecutor:
    """Calls on a cluster at an address, or on one that is started here for as long as this executor
    lives.

    A call whose worker or node dies is begun again on another, by Ray, up to ``RETRIES`` times.
    Workers of a cluster at an address get this package from here (``runtime_env``); what it depends
    on is installed there. They work in this process's folder, so all machines need a disk that they
    share.

    :raises ConfigError: an address at which no cluster answers.
    """

    def __init__(
        self, workers: int, address: str | None = None, num_cpus: float = 1, num_gpus: float = 0
    ) -> None:
        ray = self._ray = require("ray", "ray", "--executor ray")
        self._needs = {"num_cpus": num_cpus, "num_gpus": num_gpus, "max_retries": RETRIES}
        self._references = list[Any]()
        variables = {
            "PYTHONPATH": os.pathsep.join(map(os.path.abspath, sys.path)),
            **({TRUST_VARIABLE: "1"} if trusted() else {}),
        }
        environment: dict[str, Any] = {"env_vars": variables}
        options: dict[str, Any] = {
            "log_to_driver": False,
            "logging_level": "ERROR",
            "runtime_env": environment,
        }
        try:
            if address is None:
                os.environ.setdefault(
                    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0"
                )  # Ray's warning about it is none of ours
                os.environ.setdefault(
                    "RAY_worker_niceness", "0"
                )  # Ray's 15 leaves them nothing beside other work
                ray.init(
                    address="local", num_cpus=workers * num_cpus, include_dashboard=False, **options
                )
            else:
                _check_address(address)
                with tempfile.TemporaryDirectory() as folder:  # which Ray uploads
                    environment["py_modules"] = [str(_copy_package(Path(folder)))]
                    ray.init(address=address, **options)
            total = ray.cluster_resources()
        except ConfigError:
            raise
        except Exception as error:  # Ray raises what it likes
            reason = " ".join(str(error).split())[:200]
            raise ConfigError(
                f"Ray cluster {address or 'on this machine'}: cannot be used ({reason})"
            ) from None
        self.workers = max(1, int(total.get("CPU", 0) // num_cpus) if num_cpus else workers)

    def submit(self, function: Callable[..., Any], *arguments: Any) -> "Future[Any]":
        call = self._ray.remote(_call).options(
            name=getattr(function, "__name__", "call"), **self._needs
        )
        reference, future = call.remote(sys.argv, os.getcwd(), function, *arguments), Future[Any]()
        self._references.append(reference)
        reference.future().add_done_callback(lambda done: self._hand_over(done, future))
        return future

    def stop(self) -> None:
        """Cancel all calls; those under way are interrupted as by Ctrl-C, by which a training saves
        and ends.
        """
        for reference in self._references:
            self._ray.cancel(reference)

    def __enter__(self) -> "RayExecutor":
        return self

    def __exit__(self, *error: object) -> None:
        """Leave the cluster, or end the one that was started here."""
        for reference in self._references:
            self._ray.cancel(reference, force=True)
        self._ray.shutdown()

    def _hand_over(self, done: "Future[Any]", future: "Future[Any]") -> None:
        """Give a future the outcome that Ray's has, with an error that is not of Ray's kinds."""
        error = done.exception()
        if error is None:
            future.set_result(done.result())
        elif isinstance(error, self._ray.exceptions.RayTaskError):
            future.set_exception(error.cause)
        else:
            reason = " ".join(str(error).split())[:120]
            future.set_exception(
                WorkerDied(
                    f"its worker on the cluster ended, and {RETRIES} more after it ({reason})"
                )
            )


def _check_address(address: str) -> None:
    """See that somebody answers at an address, since Ray itself would wait for minutes, and then
    end the process.
    """
    if address == "auto":  # Ray looks for one on this machine, and says at once that there is none
        return
    host, _, port = address.removeprefix("ray://").rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=4.0).close()
    except (ValueError, OSError, OverflowError):
        way_out = "must be auto, host:port or ray://host:port; start one with: ray start --head --port 6379"
        raise ConfigError(f"address {address}: no Ray cluster answers; {way_out}") from None


def _copy_package(folder: Path) -> Path:
    """This package as a wheel lays it out, so that nodes find a checkout's ``envs/`` and its like
    inside of it.
    """
    package, target = Path(__file__).resolve().parents[1], folder / "sb3_quad"
    ignored = shutil.ignore_patterns("*.pyc")
    shutil.copytree(package, target, ignore=ignored)
    for name in ("envs", "callbacks", "zoo_configs"):
        if not (target / name).exists():
            shutil.copytree(package.parent / name, target / name, ignore=ignored)
    return target


def _call(argv: list[str], folder: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """On a worker: as in the process that asks, in its folder and with its command line, which runs
    note.
    """
    if not Path(folder).is_dir():
        raise ConfigError(
            f"{folder}: not seen by {platform.node()}; a Ray cluster needs a disk that all share"
        )
    os.chdir(folder)
    sys.argv = argv
    torch.set_num_threads(1)
    return function(*arguments)
