"""Trainings that end before their time: a diverging loss does not cost the model."""

import time
from typing import NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_quad.base.errors import TrainingError
from sb3_quad.base.files import model_bytes

PAUSE = 1.0  # s between two snapshots of an off-policy algorithm, whose rollouts are short


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
