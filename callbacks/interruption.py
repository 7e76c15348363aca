"""Trainings that end before their time: neither a signal nor a diverging loss costs the model."""

import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_quad.base.errors import TrainingError
from sb3_quad.base.files import model_bytes, save_model
from sb3_quad.base.signals import StopSignals

PAUSE = 1.0  # s between two snapshots of an off-policy algorithm, whose rollouts are short


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
    """A model between two rollouts."""

    timesteps: int
    model: bytes  # the zip


class LastGoodModel(BaseCallback):
    """Takes a :class:`Snapshot` whenever a rollout starts; of an off-policy algorithm at most one a second.

    >>> from stable_baselines3 import PPO
    >>> from sb3_quad.envs import QuadcopterVecEnv
    >>> model = PPO("MlpPolicy", QuadcopterVecEnv(8, seed=0), n_steps=100, batch_size=400, device="cpu")
    >>> last_good = LastGoodModel()
    >>> _ = model.learn(1600, callback=last_good)
    >>> import io
    >>> last_good.snapshot.timesteps, PPO.load(io.BytesIO(last_good.snapshot.model), device="cpu").num_timesteps
    (800, 800)

    :raises TrainingError: parameters that are no longer finite; the snapshot is then the one from before that update.
    """

    snapshot: Snapshot | None = None
    _taken = -np.inf  # when it was, s

    def _is_due(self) -> bool:
        return not isinstance(self.model, OffPolicyAlgorithm) or time.monotonic() >= self._taken + PAUSE

    def _on_rollout_start(self) -> None:
        if not self._is_due():
            return
        self._taken = time.monotonic()
        for name, parameter in self.model.policy.named_parameters():
            if not th.isfinite(parameter).all():
                raise TrainingError(f"after {self.num_timesteps:,} timesteps {name} is no longer finite; lower learning_rate")
        self.snapshot = Snapshot(self.model.num_timesteps, model_bytes(self.model))

    def _on_step(self) -> bool:
        return True
