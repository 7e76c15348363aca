"""Measure control steps per second: PyBullet, SB3's vectorised environments, the batch, and
training loops.

examples:
  sb3-quad benchmark                                   everything, about a minute
  sb3-quad benchmark --sizes 240 4096 --no-training    the batch at two sizes, and PyBullet
  sb3-quad benchmark --training                        rollouts and updates of trainings
  sb3-quad benchmark --algo ppo_bc --conf-file robust/ppo_bc.yml
"""

import argparse
import itertools
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from functools import partial
from timeit import Timer
from typing import Any

from sb3_quad.cli.parser import YES_OR_NO, Parser, above_zero, positive

ENV_ID = "QuadTargetTracking-v0"
TRAINED = "QuadStateRecovery-v0"  # in the training loops
REPETITIONS = 5
Rates = dict[
    str, list[float]
]  # control steps per second of each repetition, all environments together


def add_arguments(parser: Parser) -> None:
    add = parser.add_argument
    add(
        "--sizes",
        nargs="+",
        type=positive,
        default=[64, 240, 1024, 4096, 16384],
        metavar="N",
        help="rows of the batch",
    )
    add(
        "--n-envs",
        type=positive,
        default=8,
        metavar="N",
        help="environments of DummyVecEnv and SubprocVecEnv (8)",
    )
    add(
        "--seconds",
        type=above_zero,
        default=3.0,
        metavar="S",
        help="duration of each measurement (3)",
    )
    add(
        "--algo",
        nargs="+",
        default=["dagger", "ppo_bc"],
        help="algorithms of the training loops (dagger ppo_bc)",
    )
    add("-conf", "--conf-file", metavar="FILE", help="its settings (ALGO.yml)")
    add("--training", help="only, or no, training loops: their rollouts and updates", **YES_OR_NO)


def run(options: argparse.Namespace) -> int:
    """Measure one way after another, print. Returns the exit code."""
    import numpy as np

    from sb3_quad.cli.output import console
    from sb3_quad.evaluation.tables import text_table
    from sb3_quad.training.config import load_config

    screen, found = console(), list[tuple[str, int, list[float]]]()
    loops = (
        []
        if options.training is False
        else [load_config(algo, TRAINED, options.conf_file) for algo in options.algo]
    )
    with screen.status("measuring"):
        if options.training is not True:
            for n_envs, rates in _steps(options.sizes, options.n_envs, options.seconds):
                found += [(name, n_envs, each) for name, each in rates.items()]
        for config in loops:
            found += [
                (f"{config.algo}, {part}", config.n_envs, each)
                for part, each in _loop(config).items()
            ]
    median = [float(np.median(each)) for _, _, each in found]
    texts = [(f"{rate:,.0f}", f"{rate / median[0]:,.1f} x") for rate in median]
    rows = [(name, f"{n:,}", *text) for (name, n, _), text in zip(found, texts, strict=True)]
    screen.print(
        text_table(
            "control steps per second (median of 5)",
            ("", "rows", "steps/s", "to the first line"),
            rows,
        )
    )
    return 0


def _steps(sizes: list[int], n_envs: int, seconds: float) -> Iterator[tuple[int, Rates]]:
    """Environments with random actions: physics, noise, reward, resets, infos. By their number, the
    rates of each kind.
    """
    import gymnasium
    from gymnasium.wrappers import Autoreset

    from sb3_quad.training.config import build_config, load_config
    from sb3_quad.training.environments import make_environments

    def vectorised(kind: str, n: int, **keywords: Any) -> Any:
        settings = {"n_timesteps": 1, "vec_env": kind, "env_kwargs": keywords}
        return closing(make_environments(build_config("ppo", ENV_ID, settings), n, 0))

    randomize = load_config("dagger", TRAINED, "robust/dagger.yml").env_kwargs["randomize"]
    with closing(Autoreset(gymnasium.make(ENV_ID))) as env:
        env.reset(seed=0)
        yield 1, _rates({"PyBullet, one environment": env}, (4,), seconds)
    for kind, name in (("dummy", "DummyVecEnv"), ("subproc", "SubprocVecEnv")):
        with vectorised(kind, n_envs) as env:
            env.reset()
            yield n_envs, _rates({f"PyBullet, {name}": env}, (n_envs, 4), seconds)
    for size in sizes:
        with ExitStack() as stack:
            still, random = (
                stack.enter_context(vectorised("batch", size, randomize=each))
                for each in (None, randomize)
            )
            for env in (still, random):
                env.reset()
            yield size, _rates({"batch": still, "batch, random worlds": random}, (size, 4), seconds)


def _rates(envs: dict[str, Any], shape: tuple[int, ...], seconds: float) -> Rates:
    """Each environment for so many seconds; they take turns, since the speed of a shared machine
    changes by the second.
    """
    import numpy as np

    actions = itertools.cycle(
        np.random.default_rng(0).uniform(-1, 1, (16, *shape)).astype(np.float32)
    )
    timers = {
        name: Timer(partial(lambda step: step(next(actions)), env.step))
        for name, env in envs.items()
    }
    counts = {}
    for name, timer in timers.items():
        timer.timeit(3)  # compiles, fills caches
        count, elapsed = timer.autorange()
        counts[name] = max(1, round(count * seconds / REPETITIONS / elapsed))
    found: Rates = {name: [] for name in envs}
    for _ in range(REPETITIONS):
        for name, timer in timers.items():
            found[name].append(
                counts[name] * int(np.prod(shape)) / shape[-1] / timer.timeit(counts[name])
            )
    return found


def _loop(config: Any) -> Rates:
    """A whole training loop with the settings' own sizes; the first rollout and update, which
    compile, are left out.
    """
    import numpy as np
    from stable_baselines3.common.callbacks import BaseCallback

    from sb3_quad.base.errors import ConfigError
    from sb3_quad.training.config import TrainingJob
    from sb3_quad.training.environments import make_environments
    from sb3_quad.training.trainer import build_model

    class Clock(BaseCallback):
        """When rollouts begin and end; an update lies between two of them."""

        def _note(self) -> None:
            times.append(time.perf_counter())

        _on_rollout_start = _on_rollout_end = _on_training_end = _note

        def _on_step(self) -> bool:
            return True

    if config.is_off_policy:
        raise ConfigError(
            f"{config.algo}: only loops of on-policy algorithms are measured, in rollouts and updates"
        )
    times: list[float] = []
    with closing(make_environments(config, config.n_envs, 0)) as env:
        steps = config.rollout_steps * config.n_envs
        build_model(TrainingJob(config=config), env).learn(
            steps * (REPETITIONS + 1), callback=Clock()
        )
    rollout, update = np.diff(times).reshape(-1, 2)[1:].T
    parts = {"whole loop": rollout + update, "rollout": rollout, "update": update}
    return {name: (steps / each).tolist() for name, each in parts.items()}
