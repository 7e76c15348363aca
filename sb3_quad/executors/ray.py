"""Calls on a Ray cluster. Ray places them, retries them, and copies this package to its nodes."""

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

from sb3_quad.base.errors import ConfigError, WorkerDied, raised_as
from sb3_quad.base.files import one_line
from sb3_quad.base.imports import require
from sb3_quad.base.process import TRUST_VARIABLE
from sb3_quad.base.types import StrDict

# How often Ray repeats a call whose node or worker process dies.
RETRIES = 3


class RayExecutor:
    """Calls on a cluster at an address, or on one that runs here for as long as this executor.

    If the worker or the node of a call dies, Ray starts the call again on another one, up to
    ``RETRIES`` times. Workers of a cluster at an address get this package from here
    (``runtime_env``); its dependencies must be installed there. Workers use the working directory
    of this process, so all machines need a shared disk.

    :raises ConfigError: No cluster answers at the address.
    """

    def __init__(self, workers: int, address: str | None, num_cpus: float, num_gpus: float) -> None:
        self._ray = require("ray", "ray", "--executor ray")
        self._options = {"num_cpus": num_cpus, "num_gpus": num_gpus, "max_retries": RETRIES}
        self._references = list[Any]()
        environment: StrDict = {
            "env_vars": {
                "PYTHONPATH": os.pathsep.join(map(os.path.abspath, sys.path)),
                TRUST_VARIABLE: os.environ.get(TRUST_VARIABLE, "0"),
            }
        }
        options: StrDict = {}
        where = (
            f"Ray cluster {address or 'on this machine'}: cannot be used; an address is auto, "
            "host:port or ray://host:port, and ray start --head --port 6379 starts a cluster"
        )
        # Ray raises exceptions of many kinds, and uploads the package during init.
        with raised_as(ConfigError, where), tempfile.TemporaryDirectory() as folder:
            if address is None:
                # Ray warns about a variable that this package does not use.
                os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
                # With Ray's niceness of 15, workers would get no time next to other work.
                os.environ.setdefault("RAY_worker_niceness", "0")
                options = {"num_cpus": workers * num_cpus, "include_dashboard": False}
            else:
                # Ray would wait for minutes and then end the process. For auto it searches this
                # machine, and raises at once if it finds nothing.
                if address != "auto":
                    host, _, port = address.removeprefix("ray://").rpartition(":")
                    socket.create_connection((host.strip("[]"), int(port)), timeout=4.0).close()
                environment["py_modules"] = [str(_copy_package(Path(folder)))]
            self._ray.init(
                address or "local",
                runtime_env=environment,
                log_to_driver=False,
                logging_level="ERROR",
                **options,
            )

    def submit(self, function: Callable[..., Any], *arguments: Any) -> "Future[Any]":
        call = self._ray.remote(**self._options)(_call)
        reference = call.remote(sys.argv, os.getcwd(), function, *arguments)
        self._references.append(reference)
        future = Future[Any]()

        def hand_over(done: "Future[Any]") -> None:
            """Give the future the outcome of Ray's future, with an error that is not one of Ray's
            classes.
            """
            error = done.exception()
            if error is None:
                future.set_result(done.result())
            elif isinstance(error, self._ray.exceptions.RayTaskError):
                future.set_exception(error.cause)
            else:
                future.set_exception(
                    WorkerDied(f"its workers on the cluster ended ({one_line(error)})")
                )

        reference.future().add_done_callback(hand_over)
        return future

    def stop(self) -> None:
        """Cancel all calls. Running ones are interrupted as by Ctrl-C, which a training answers by
        saving.
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


def _copy_package(folder: Path) -> Path:
    """Copy this package into a folder as a wheel lays it out, with a checkout's ``envs/``,
    ``callbacks/`` and ``zoo_configs/`` inside.
    """
    package = Path(__file__).resolve().parents[1]
    target = folder / "sb3_quad"
    ignored = shutil.ignore_patterns("*.pyc")
    shutil.copytree(package, target, ignore=ignored)
    for name in ("envs", "callbacks", "zoo_configs"):
        if not (target / name).exists():
            shutil.copytree(package.parent / name, target / name, ignore=ignored)
    return target


def _call(argv: list[str], folder: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function on a worker, in the folder and with the command line of the caller.

    Runs record both.
    """
    if not Path(folder).is_dir():
        raise ConfigError(
            f"{folder}: not seen by {platform.node()}; a Ray cluster needs a shared disk"
        )
    os.chdir(folder)
    sys.argv = argv
    torch.set_num_threads(1)
    return function(*arguments)
