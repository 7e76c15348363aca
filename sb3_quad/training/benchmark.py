"""Control steps per second of every way to fly, and of a whole training loop, measured in one process after another."""

from __future__ import annotations

import os
import platform
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_quad.settings.config import TrainingConfig, build_config

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv

ENV_ID = "QuadTargetTracking-v0"
REPETITIONS = 5
PACKAGES = ("sb3_quad", "stable_baselines3", "gymnasium", "torch", "numpy", "numba", "pybullet")


@dataclass(frozen=True)
class Measurement:
    """One line of the benchmark.

    :param rate: control steps per second, all environments together: the median of ``rates``.
    """

    name: str
    n_envs: int
    rate: float
    rates: list[float]


def single(seconds: float) -> Measurement:
    """One PyBullet environment behind ``gymnasium.make``, random actions, resets where episodes end."""
    import gymnasium

    env = gymnasium.make(ENV_ID)
    env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1, 1, (64, 4)).astype(np.float32)

    def fly(steps: int) -> None:
        for step in range(steps):
            _, _, terminated, truncated, _ = env.step(actions[step % 64])
            if terminated or truncated:
                env.reset()

    try:
        return _measure("PyBullet, one environment", 1, fly, seconds)
    finally:
        env.close()


def vectorised(kind: str, n_envs: int, seconds: float) -> Measurement:
    """``VecEnv.step`` of ``batch``, ``dummy`` or ``subproc``: physics, noise, reward, resets, infos; random actions."""
    with _environments(kind, n_envs) as env:
        env.reset()
        actions = np.random.default_rng(0).uniform(-1, 1, (16, n_envs, 4)).astype(np.float32)

        def fly(steps: int) -> None:
            for step in range(steps):
                env.step(actions[step % 16])

        names = {"batch": "batch", "dummy": "PyBullet, DummyVecEnv", "subproc": "PyBullet, SubprocVecEnv"}
        return _measure(names[kind], n_envs, fly, seconds)


def training_loop(config: TrainingConfig, rollouts: int = REPETITIONS) -> list[Measurement]:
    """A whole SB3 training loop with the settings' own sizes: all of it, its rollouts, its updates; the first left out."""
    from sb3_quad.training.environments import make_environments
    from sb3_quad.training.job import TrainingJob
    from sb3_quad.training.trainer import build_model

    env = make_environments(config, config.n_envs, 0)
    try:
        model = build_model(TrainingJob(config), env)
        clock = {"rollout": [0.0], "update": [0.0]}
        collect, update = model.collect_rollouts, model.train
        model.collect_rollouts = _timed(collect, clock["rollout"])  # type: ignore[method-assign]
        model.train = _timed(update, clock["update"])  # type: ignore[method-assign]
        steps = model.n_steps * config.n_envs
        model.learn(steps * (rollouts + 1))
    finally:
        env.close()
    rollout, updates = clock["rollout"][2:], clock["update"][2:]  # a zero and the warm-up go
    both = [a + b for a, b in zip(rollout, updates, strict=True)]
    parts = {"whole loop": both, "rollout": rollout, "update": updates}
    return [
        Measurement(f"{config.algo}, {part}", config.n_envs, steps / statistics.median(times), [steps / t for t in times])
        for part, times in parts.items()
    ]


def machine() -> dict[str, Any]:
    """What the figures were measured on."""
    import numba
    import torch

    versions = {}
    for package in PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:  # a checkout that is not installed
            import sb3_quad

            versions[package] = sb3_quad.__version__
    return {
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "system": platform.platform(),
        "python": platform.python_version(),
        "versions": versions,
        "threads": {"torch": torch.get_num_threads(), "numba": numba.get_num_threads()},
        "time": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
    }


def as_dict(measurements: list[Measurement]) -> dict[str, Any]:
    """What ``--output`` writes."""
    return {"machine": machine(), "results": [asdict(measurement) for measurement in measurements]}


def _measure(name: str, n_envs: int, fly: Callable[[int], None], seconds: float) -> Measurement:
    fly(3)  # compiles, fills caches
    steps, elapsed = 1, 0.0
    while elapsed < seconds / 20:  # how many steps a repetition takes
        steps *= 2
        elapsed = _time(fly, steps)
    steps = max(1, round(steps * seconds / REPETITIONS / elapsed))
    rates = [steps * n_envs / _time(fly, steps) for _ in range(REPETITIONS)]
    return Measurement(name, n_envs, statistics.median(rates), rates)


def _time(fly: Callable[[int], None], steps: int) -> float:
    start = time.perf_counter()
    fly(steps)
    return time.perf_counter() - start


def _timed(function: Callable[..., Any], times: list[float]) -> Callable[..., Any]:
    def call(*args: Any, **kwargs: Any) -> Any:
        start = time.perf_counter()
        try:
            return function(*args, **kwargs)
        finally:
            times.append(time.perf_counter() - start)

    return call


@contextmanager
def _environments(kind: str, n_envs: int) -> Iterator[VecEnv]:
    from sb3_quad.training.environments import make_environments

    env = make_environments(build_config("ppo", ENV_ID, {"n_timesteps": 1, "vec_env": kind}), n_envs, 0)
    try:
        yield env
    finally:
        env.close()


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()
