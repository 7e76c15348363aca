"""Trainings that end before their time: neither a signal nor a diverging loss costs the model."""

import random
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_quad.base.arrays import Arrays
from sb3_quad.base.errors import TrainingError
from sb3_quad.base.files import model_bytes, save_model
from sb3_quad.base.signals import StopSignals

ENVIRONMENT = "environment."  # before the names of the environments' arrays
MEMORY = "memory."  # before those of what the algorithm remembers beside its zip
PAUSE = 1.0  # s between two snapshots of an off-policy algorithm


class StopOnSignal(BaseCallback):
    """Makes Ctrl-C (SIGINT), SIGTERM and SIGHUP end ``model.learn`` after the step, and saves the model, whole or not at all.

    For your own scripts; ``sb3-quad train`` does more (resumable runs). A second signal interrupts at once, without saving.
    ``learn`` returns as usual and the script continues; ``signal`` tells whether one came.

    >>> import signal
    >>> from stable_baselines3 import PPO
    >>> from stable_baselines3.common.callbacks import ConvertCallback
    >>> from sb3_quad.envs import QuadcopterVecEnv
    >>> model = PPO("MlpPolicy", QuadcopterVecEnv(8, seed=0), n_steps=100, batch_size=400, device="cpu")
    >>> stop = StopOnSignal("interrupted.zip")
    >>> press = ConvertCallback(lambda at, _: at["self"].num_timesteps < 1000 or not signal.raise_signal(signal.SIGINT))
    >>> _ = model.learn(1_000_000, callback=[press, stop])  # and Ctrl-C, which `press` stands for here
    SIGINT after 1,000 timesteps: model saved to interrupted.zip
    >>> stop.signal, PPO.load("interrupted.zip", device="cpu").num_timesteps
    ('SIGINT', 1000)

    To continue: ``PPO.load("interrupted.zip", env).learn(n, reset_num_timesteps=False)``. While ``learn`` runs, signals are
    held back. If an exception ends it, the next signal is held back too.

    :param path: where the model goes; an existing file is replaced.
    :raises ConfigError: where the model is saved, a folder that cannot be written.
    """

    signal = ""
    """The name of the signal that ended the training, empty if none did."""
    exit_code = 0
    """For ``sys.exit``, as a shell expects it: 130 after SIGINT, 143 after SIGTERM, 129 after SIGHUP; 0 if none came."""

    def __init__(self, path: str | Path, verbose: int = 1) -> None:
        super().__init__(verbose)
        self._path = Path(path)

    def _on_training_start(self) -> None:
        self.signal, self.exit_code = "", 0
        self._signals = StopSignals()
        self._signals.__enter__()

    def _on_step(self) -> bool:
        return self._signals.received is None

    def _on_training_end(self) -> None:
        self._signals.hold()
        self.signal, self.exit_code = self._signals.name, self._signals.exit_code
        try:
            if self.signal:
                save_model(self.model, self._path)
                if self.verbose:
                    print(f"{self.signal} after {self.num_timesteps:,} timesteps: model saved to {self._path}")
        finally:
            self._signals.__exit__(None, None, None)


class Snapshot(NamedTuple):
    """A training between two rollouts: everything it needs to continue as if nothing had happened, except a dataset."""

    timesteps: int
    model: bytes  # the zip
    state: Arrays  # random numbers, and arrays under ``ENVIRONMENT`` and ``MEMORY``


class LastGoodModel(BaseCallback):
    """Takes a :class:`Snapshot` whenever a rollout starts; of an off-policy algorithm, whose rollouts are short, one a second.

    >>> from stable_baselines3 import PPO
    >>> from sb3_quad.envs import QuadcopterVecEnv
    >>> model = PPO("MlpPolicy", QuadcopterVecEnv(8, seed=0), n_steps=100, batch_size=400, device="cpu")
    >>> last_good = LastGoodModel()
    >>> _ = model.learn(1600, callback=last_good)
    >>> import io
    >>> last_good.snapshot.timesteps, PPO.load(io.BytesIO(last_good.snapshot.model), device="cpu").num_timesteps
    (800, 800)

    :param hurry: whether an off-policy algorithm's next snapshot is wanted at once.
    :raises TrainingError: parameters that are no longer finite; the snapshot is then the one from before that update.
    """

    snapshot: Snapshot | None = None
    _seconds = -np.inf  # when it was taken

    def __init__(self, hurry: Callable[[], bool] = lambda: False) -> None:
        super().__init__()
        self._hurry = hurry

    @property
    def is_fresh(self) -> bool:
        """Whether the rollout under way is in its first step after the snapshot, so that no buffer holds more than it."""
        after = self.num_timesteps - self.training_env.num_envs
        return not isinstance(self.model, OffPolicyAlgorithm) or self.snapshot is None or self.snapshot.timesteps == after

    def _on_rollout_start(self) -> None:
        if isinstance(self.model, OffPolicyAlgorithm) and time.monotonic() < self._seconds + PAUSE and not self._hurry():
            return
        self._seconds = time.monotonic()
        for name, parameter in self.model.policy.named_parameters():
            if not th.isfinite(parameter).all():
                raise TrainingError(f"after {self.num_timesteps:,} timesteps {name} is no longer finite; lower learning_rate")
        batch = getattr(self.training_env.unwrapped, "batch", None)  # there is none in dummy and subproc
        arrays = {} if batch is None else batch.snapshot()
        remembered: Arrays = getattr(self.model, "memory", dict)()
        state = random_state() | {f"{ENVIRONMENT}{name}": array for name, array in arrays.items()}
        state |= {f"{MEMORY}{name}": array for name, array in remembered.items()}
        self.snapshot = Snapshot(self.model.num_timesteps, model_bytes(self.model), state)

    def _on_step(self) -> bool:
        return True


def random_state() -> Arrays:
    """The states of torch's, NumPy's and Python's global random number generators."""
    _, keys, position, has_normal, normal = np.random.get_state(legacy=True)  # noqa: NPY002 - SB3 samples from it
    version, words, gauss = random.getstate()
    return {
        "torch": th.get_rng_state().numpy().copy(),
        "numpy.keys": np.array(keys),
        "numpy.rest": np.array([position, has_normal, normal], dtype=np.float64),
        "python.words": np.array([version, *words], dtype=np.int64),
        "python.gauss": np.array([np.nan if gauss is None else gauss]),
    }


def set_random_state(state: Arrays) -> None:
    """Undo what has happened to the random numbers since ``random_state``."""
    th.set_rng_state(th.from_numpy(np.array(state["torch"], dtype=np.uint8)))
    position, has_normal, normal = (float(value) for value in state["numpy.rest"])
    legacy = ("MT19937", np.array(state["numpy.keys"], dtype=np.uint32), int(position), int(has_normal), normal)
    np.random.set_state(legacy)  # noqa: NPY002
    version, *words = (int(word) for word in state["python.words"])
    gauss = float(state["python.gauss"][0])
    random.setstate((version, tuple(words), None if np.isnan(gauss) else gauss))
