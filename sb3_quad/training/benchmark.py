"""Control steps per second of every way to fly, and of a whole training loop, measured in one process after another."""

import itertools
import platform
import re
import time
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from pathlib import Path
from timeit import Timer
from typing import Any

import gymnasium
import numba
import numpy as np
import torch
from gymnasium.wrappers import Autoreset
from stable_baselines3.common.callbacks import BaseCallback

from sb3_quad.base.cores import available_cpus
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.version import __version__
from sb3_quad.training.config import TrainingConfig, build_config
from sb3_quad.training.environments import make_environments
from sb3_quad.training.job import TrainingJob
from sb3_quad.training.trainer import build_model

ENV_ID = "QuadTargetTracking-v0"
TRAINED = "QuadStateRecovery-v0"  # by train without arguments
REPETITIONS = 5
NAMES = {"batch": "batch", "dummy": "PyBullet, DummyVecEnv", "subproc": "PyBullet, SubprocVecEnv"}
PACKAGES = ("stable_baselines3", "gymnasium", "torch", "numpy", "numba", "pybullet")


@dataclass(frozen=True)
class Measurement:
    """One line of the benchmark.

    :param rate: control steps per second, all environments together: the median of ``rates``.
    """

    name: str
    n_envs: int
    rate: float
    rates: list[float]


def single(seconds: float) -> list[Measurement]:
    """One PyBullet environment behind ``gymnasium.make``, random actions, resets where episodes end."""
    with closing(Autoreset(gymnasium.make(ENV_ID))) as env:
        env.reset(seed=0)
        return _measure({"PyBullet, one environment": env}, 1, (4,), seconds)


def vectorised(kind: str, n_envs: int, seconds: float, randomize: Any = None) -> list[Measurement]:
    """``VecEnv.step`` of ``batch``, ``dummy`` or ``subproc``: physics, noise, reward, resets, infos; random actions.

    :param randomize: to be flown with as well, in turns with still air: on a shared machine the speed changes from second to
        second.
    """
    envs: dict[str, Any] = {}
    with ExitStack() as stack:
        for name, randomized in ((NAMES[kind], {}), (f"{NAMES[kind]}, random worlds", randomize)):
            if randomized is not None:
                settings = {"n_timesteps": 1, "vec_env": kind, "env_kwargs": {"randomize": randomized}}
                env = stack.enter_context(closing(make_environments(build_config("ppo", ENV_ID, settings), n_envs, 0)))
                env.reset()
                envs[name] = env
        return _measure(envs, n_envs, (n_envs, 4), seconds)


def _measure(envs: dict[str, Any], n_envs: int, shape: tuple[int, ...], seconds: float) -> list[Measurement]:
    """Each environment for so many seconds; their repetitions take turns."""
    actions = itertools.cycle(np.random.default_rng(0).uniform(-1, 1, (16, *shape)).astype(np.float32))
    timers = {name: Timer(partial(lambda step: step(next(actions)), env.step)) for name, env in envs.items()}
    counts = {}
    for name, timer in timers.items():
        timer.timeit(3)  # compiles, fills caches
        count, elapsed = timer.autorange()
        counts[name] = max(1, round(count * seconds / REPETITIONS / elapsed))
    rates: dict[str, list[float]] = {name: [] for name in envs}
    for _ in range(REPETITIONS):
        for name, timer in timers.items():
            rates[name].append(counts[name] * n_envs / timer.timeit(counts[name]))
    return [_measurement(name, n_envs, each) for name, each in rates.items()]


def _measurement(name: str, n_envs: int, rates: list[float]) -> Measurement:
    return Measurement(name, n_envs, float(np.median(rates)), rates)


def training_loop(config: TrainingConfig, rollouts: int = REPETITIONS) -> list[Measurement]:
    """The rates of a whole SB3 training loop with the settings' own sizes, of its rollouts and of its updates.

    The first rollout and update, which compile, are left out.
    """
    if config.is_off_policy:
        raise ConfigError(f"{config.algo}: only loops of on-policy algorithms are measured, in rollouts and updates")
    with closing(make_environments(config, config.n_envs, 0)) as env:
        clock, steps = _Clock(), config.rollout_steps * config.n_envs
        build_model(TrainingJob(config=config), env).learn(steps * (rollouts + 1), callback=clock)
    rollout, update = np.diff(clock.times).reshape(-1, 2)[1:].T
    parts = {"whole loop": rollout + update, "rollout": rollout, "update": update}
    return [_measurement(f"{config.algo}, {part}", config.n_envs, (steps / each).tolist()) for part, each in parts.items()]


class _Clock(BaseCallback):
    """When rollouts begin and end; an update lies between two of them."""

    def __init__(self) -> None:
        super().__init__()
        self.times: list[float] = []

    def _note(self) -> None:
        self.times.append(time.perf_counter())

    _on_rollout_start = _on_rollout_end = _on_training_end = _note

    def _on_step(self) -> bool:
        return True


def machine() -> dict[str, Any]:
    """What it was measured on."""
    cpuinfo = Path("/proc/cpuinfo")
    named = re.search(r"model name\s*: (.*)", cpuinfo.read_text(encoding="utf-8")) if cpuinfo.is_file() else None
    return {
        "processor": named[1] if named else platform.processor() or platform.machine(),
        "cores": available_cpus(),
        "system": platform.platform(),
        "python": platform.python_version(),
        "versions": {"sb3_quad": __version__, **{package: metadata.version(package) for package in PACKAGES}},
        "threads": {"torch": torch.get_num_threads(), "numba": numba.get_num_threads()},
        "time": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
    }
