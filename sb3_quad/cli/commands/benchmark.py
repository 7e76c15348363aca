"""Measure control steps per second of environments and training loops.

The environments are PyBullet's, alone and vectorised, and the compiled batch.

examples:
  # everything, about a minute
  sb3-quad benchmark
  # the batch at two sizes, and PyBullet
  sb3-quad benchmark --sizes 240 4096 --no-training
  # rollouts and updates of training loops only
  sb3-quad benchmark --training
  sb3-quad benchmark --algo ppo_bc --conf-file robust/ppo_bc.yml
"""

import itertools
import time
from argparse import Namespace
from contextlib import ExitStack, closing
from timeit import Timer
from typing import Any

from sb3_quad.cli.parser import SEVERAL, YES_OR_NO, Flags, Parser, above_zero, add_flags, positive

ENV_ID = "QuadTargetTracking-v0"
# The environment of the training loops.
TRAINED = "QuadStateRecovery-v0"
REPETITIONS = 5
# What is measured, its rows, and control steps per second of all rows in each repetition.
Measurement = tuple[str, int, list[float]]


FLAGS: Flags = {
    "--sizes": (
        {"nargs": "+", "type": positive, "metavar": "N"},
        [64, 240, 1024, 4096, 16384],
        "numbers of rows of the batch (64 240 1024 4096 16384)",
    ),
    "--n-envs N": (positive, 8, "environments of DummyVecEnv and SubprocVecEnv (8)"),
    "--seconds S": (above_zero, 3.0, "duration of each measurement (3)"),
    "--algo": (SEVERAL, ["dagger", "ppo_bc"], "algorithms of the training loops (dagger ppo_bc)"),
    "-conf --conf-file FILE": (str, None, "settings of the training loops (ALGO.yml)"),
    "--training": (YES_OR_NO, None, "measure only, or no, training loops (both)"),
}


def add_arguments(parser: Parser) -> None:
    add_flags(parser, FLAGS)


def run(options: Namespace) -> int:
    """Measure and print. Returns the exit code."""
    import numpy as np

    from sb3_quad.cli.output import console
    from sb3_quad.evaluation.tables import text_table
    from sb3_quad.training.config import load_config

    configs = []
    if options.training is not False:
        configs = [load_config(algo, TRAINED, options.conf_file) for algo in options.algo]
    measurements: list[Measurement] = []
    screen = console()
    with screen.status("measuring"):
        if options.training is not True:
            measurements += _measure_steps(options.sizes, options.n_envs, options.seconds)
        for config in configs:
            measurements += _measure_loop(config)
    reference = np.median(measurements[0][2])
    lines = []
    for name, rows, rates in measurements:
        rate = np.median(rates)
        lines.append((name, f"{rows:,}", f"{rate:,.0f}", f"{rate / reference:,.1f} x"))
    title = f"control steps per second (median of {REPETITIONS})"
    screen.print(text_table(title, ("", "rows", "steps/s", "to the first line"), lines))
    return 0


def _measure_steps(sizes: list[int], n_envs: int, seconds: float) -> list[Measurement]:
    """Step environments with random actions, including noise, rewards, resets and infos.

    They take turns, since the speed of a shared machine changes by the second.

    :param seconds: Duration for each environment, s.
    """
    with ExitStack() as stack:
        measurements: list[Measurement] = []
        steps = []
        for name, rows, env in _environments(stack, sizes, n_envs):
            timer = _timer(env, rows)
            # Compiles, and fills caches.
            timer.timeit(3)
            count, elapsed = timer.autorange()
            steps.append((timer, max(1, round(count * seconds / REPETITIONS / elapsed))))
            measurements.append((name, rows, []))
        for _ in range(REPETITIONS):
            for (_, rows, rates), (timer, count) in zip(measurements, steps, strict=True):
                rates.append(rows * count / timer.timeit(count))
    return measurements


def _environments(stack: ExitStack, sizes: list[int], n_envs: int) -> list[tuple[str, int, Any]]:
    """Return name, rows and environment of each measurement. ``stack`` closes them."""
    import gymnasium
    from gymnasium.wrappers import Autoreset

    from sb3_quad.training.config import build_config, load_config
    from sb3_quad.training.environments import make_environments

    environments: list[tuple[str, int, Any]] = []

    def add(name: str, kind: str, rows: int, **env_kwargs: Any) -> None:
        settings = {"n_timesteps": 1, "vec_env": kind, "env_kwargs": env_kwargs}
        env = make_environments(build_config("ppo", ENV_ID, settings), rows, 0)
        environments.append((name, rows, stack.enter_context(closing(env))))

    single = stack.enter_context(closing(Autoreset(gymnasium.make(ENV_ID))))
    environments.append(("PyBullet, one environment", 1, single))
    add("PyBullet, DummyVecEnv", "dummy", n_envs)
    add("PyBullet, SubprocVecEnv", "subproc", n_envs)
    robust = load_config("dagger", TRAINED, "robust/dagger.yml").env_kwargs["randomize"]
    for size in sizes:
        add("batch", "batch", size)
        add("batch, domain randomization", "batch", size, randomize=robust)
    for _, _, env in environments:
        env.reset()
    return environments


def _timer(env: Any, rows: int) -> Timer:
    """Return a timer of one step with random actions."""
    import numpy as np

    # One environment takes an action (4,), all others (rows, 4).
    shape = env.action_space.shape if rows == 1 else (rows, 4)
    actions = np.random.default_rng(0).uniform(-1, 1, (16, *shape)).astype(np.float32)
    endless = itertools.cycle(actions)
    return Timer(lambda: env.step(next(endless)))


def _measure_loop(config: Any) -> list[Measurement]:
    """Train with the sizes of the settings. The first rollout and update, which compile, do not
    count.
    """
    import numpy as np
    from stable_baselines3.common.callbacks import BaseCallback

    from sb3_quad.base.errors import ConfigError
    from sb3_quad.training.config import TrainingJob
    from sb3_quad.training.environments import make_environments
    from sb3_quad.training.trainer import build_model

    class Clock(BaseCallback):
        """Notes when rollouts begin and end. An update lies between two of them."""

        def _note(self) -> None:
            times.append(time.perf_counter())

        _on_rollout_start = _on_rollout_end = _on_training_end = _note

        def _on_step(self) -> bool:
            return True

    if config.is_off_policy:
        raise ConfigError(
            f"{config.algo}: only loops of on-policy algorithms are measured, "
            "in rollouts and updates"
        )
    times: list[float] = []
    steps = config.rollout_steps * config.n_envs
    with closing(make_environments(config, config.n_envs, 0)) as env:
        model = build_model(TrainingJob(config=config), env)
        model.learn(steps * (REPETITIONS + 1), callback=Clock())
    rollout, update = np.diff(times).reshape(-1, 2)[1:].T
    seconds = {"whole loop": rollout + update, "rollout": rollout, "update": update}
    return [
        (f"{config.algo}, {part}", config.n_envs, (steps / durations).tolist())
        for part, durations in seconds.items()
    ]
