"""Measure control steps per second of environments and training loops.

The environments are the compiled batch and, where it is installed, PyBullet's,
alone and vectorised. A training loop is a rollout with its update; APG's
includes the backward pass through the recorded flights.

The last line compares a core of your machine with a core of the one on which
the CPU seconds in the documentation were measured: at 0.5, expect twice as
many. It needs the batch with 240 rows, and counts CPU seconds, so other
programs hardly matter.

examples:
  # everything, about a minute
  sb3-quad benchmark
  # the batch at two sizes, and PyBullet
  sb3-quad benchmark --sizes 240 4096 --no-training
  # rollouts with their updates of training loops only
  sb3-quad benchmark --training
  sb3-quad benchmark --algo apg --conf-file robust/apg.yml
"""

import itertools
from argparse import Namespace
from collections.abc import Callable
from importlib.util import find_spec
from time import process_time
from timeit import Timer
from typing import Any, NamedTuple

from sb3_quad.base.errors import ConfigError
from sb3_quad.cli.parser import (
    SEVERAL,
    YES_OR_NO,
    Flags,
    above_zero,
    positive,
)

ENV_ID = "QuadTargetTracking-v0"
# The environment of the training loops.
TRAINED = "QuadStateRecovery-v0"
REPETITIONS = 5
# The subject that needs one core, and its steps/s on the reference machine
REFERENCE = ("batch", 240)
REFERENCE_RATE = 9.15e6


class Subject(NamedTuple):
    """Something to measure.

    :param call: flies some control steps of all rows.
    :param steps: as many, of all rows together.
    """

    name: str
    rows: int
    steps: int
    call: Callable[[], Any]
    env: Any


FLAGS: Flags = {
    "--sizes": (
        {"nargs": "+", "type": positive, "metavar": "N"},
        [64, 240, 1024, 4096, 16384],
        "numbers of rows of the batch (64 240 1024 4096 16384)",
    ),
    "--n-envs N": (positive, 8, "environments of DummyVecEnv and SubprocVecEnv (8)"),
    "--seconds S": (above_zero, 3.0, "duration of each measurement (3)"),
    "--algo": (
        SEVERAL,
        ["dagger", "ppo_bc", "apg"],
        "algorithms of the training loops (dagger ppo_bc apg)",
    ),
    "-conf --conf-file FILE": "settings of the training loops (ALGO.yml)",
    "--training": (
        YES_OR_NO,
        "--training: only training loops; --no-training: only environments (default: both)",
    ),
}


def run(options: Namespace) -> int:
    """Measure and print. Returns the exit code."""
    import numpy as np

    from sb3_quad.cli.output import console
    from sb3_quad.evaluation.tables import text_table

    subjects: list[Subject] = []
    if options.training is not True:
        subjects += _environments(options.sizes, options.n_envs)
    if options.training is not False:
        for algo in options.algo:
            subjects.append(_training_loop(algo, options.conf_file))
    with console().status("measuring"):
        rates = np.median(_measure(subjects, options.seconds), axis=0)
    lines = []
    for subject, rate in zip(subjects, rates, strict=True):
        lines.append((subject.name, f"{subject.rows:,}", f"{rate:,.0f}"))
    console().print(text_table("control steps per second", ("", "rows", "steps/s"), lines))
    for subject in subjects:
        if subject[:2] == REFERENCE:
            count, seconds = Timer(subject.call, timer=process_time).autorange()
            speed = subject.steps * count / seconds / REFERENCE_RATE
            print(f"this machine: {speed:.2f} times the reference, core by core")
        subject.env.close()
    return 0


def _measure(subjects: list[Subject], seconds: float) -> list[list[float]]:
    """Return control steps per second of each subject, in each repetition.

    They take turns, since the speed of a shared machine changes by the second.

    :param seconds: Duration for each subject, s.
    """
    timers = []
    for subject in subjects:
        timer = Timer(subject.call)
        # Compiles, and fills caches.
        timer.timeit(3)
        count, elapsed = timer.autorange()
        timers.append(
            (timer, subject.steps, max(1, round(count * seconds / REPETITIONS / elapsed)))
        )
    return [
        [steps * count / timer.timeit(count) for timer, steps, count in timers]
        for _ in range(REPETITIONS)
    ]


def _environments(sizes: list[int], n_envs: int) -> list[Subject]:
    """Return the environments, which fly random actions, including noise, rewards, resets and
    infos.
    """
    import gymnasium
    import numpy as np
    from gymnasium.wrappers import Autoreset

    from sb3_quad.training.config import SETTINGS, build_config, load_config
    from sb3_quad.training.environments import make_environments

    subjects = []

    def add(name: str, rows: int, env: Any, *shape: int) -> None:
        env.reset()
        random = np.random.default_rng(0)
        actions = itertools.cycle(random.uniform(-1, 1, (16, *shape, 4)).astype(np.float32))
        subjects.append(Subject(name, rows, rows, lambda: env.step(next(actions)), env))

    def add_vectorised(name: str, kind: str, rows: int, **env_kwargs: Any) -> None:
        settings = {"n_timesteps": 1, "vec_env": kind, "env_kwargs": env_kwargs}
        add(name, rows, make_environments(build_config("ppo", ENV_ID, settings), rows, 0), rows)

    if find_spec("pybullet"):
        add("PyBullet, one environment", 1, Autoreset(gymnasium.make(ENV_ID)))
        add_vectorised("PyBullet, DummyVecEnv", "dummy", n_envs)
        add_vectorised("PyBullet, SubprocVecEnv", "subproc", n_envs)
    settings = SETTINGS.packaged("robust/dagger.yml")
    robust = load_config("dagger", TRAINED, settings).env_kwargs["randomize"]
    for size in sizes:
        add_vectorised("batch", "batch", size)
        add_vectorised("batch, figure eight", "batch", size, reference="figure_eight")
        add_vectorised("batch, domain randomization", "batch", size, randomize=robust)
    return subjects


def _training_loop(algo: str, conf_file: str | None) -> Subject:
    """Return a training with the sizes of the settings, of one rollout and update in each call."""
    from sb3_quad.training.config import TrainingJob, load_config
    from sb3_quad.training.environments import make_environments
    from sb3_quad.training.trainer import build_model

    config = load_config(algo, TRAINED, conf_file)
    if config.is_off_policy:
        raise ConfigError(f"{algo}: only loops of on-policy algorithms are measured")
    env = make_environments(config, config.n_envs, 0)
    model = build_model(TrainingJob(config=config), env)
    steps = config.rollout
    return Subject(f"{algo}, whole loop", config.n_envs, steps, lambda: model.learn(steps), env)
