"""Models along the way."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from stable_baselines3.common.callbacks import BaseCallback

from sb3_quad.training.files import save_model


class Checkpoint(BaseCallback):
    """Saves the model every ``every`` transitions, each file whole or not at all.

    :param every: transitions, over all environments together.
    :param path: from the number of transitions to the file.
    """

    def __init__(self, every: int, path: Callable[[int], Path], verbose: int = 0) -> None:
        super().__init__(verbose)
        self._every = every
        self._path = path
        self._next = every

    def _on_training_start(self) -> None:
        self._next = (self.num_timesteps // self._every + 1) * self._every

    def _on_step(self) -> bool:
        if self.num_timesteps >= self._next:
            save_model(self.model, self._path(self.num_timesteps))
            self._next += self._every
        return True
