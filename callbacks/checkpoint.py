"""Models along the way."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from stable_baselines3.common.callbacks import BaseCallback

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import save_model


class Checkpoint(BaseCallback):
    """Saves the model every ``every`` transitions, each file whole or not at all.

    >>> from stable_baselines3 import PPO
    >>> from sb3_quad.envs import QuadcopterVecEnv
    >>> model = PPO("MlpPolicy", QuadcopterVecEnv(8, seed=0), n_steps=100, batch_size=400, device="cpu")
    >>> _ = model.learn(1600, callback=Checkpoint(800, "checkpoints/rl_model_{steps}_steps.zip"))
    >>> sorted(path.name for path in Path("checkpoints").iterdir())
    ['rl_model_1600_steps.zip', 'rl_model_800_steps.zip']

    :param every: transitions, over all environments together.
    :param path: the file, with ``{steps}`` where the number of transitions goes; or a function from that number to the file.
        A file there is replaced.
    :raises ConfigError: ``every`` below 1, a path without ``{steps}``; when saving, a folder that cannot be written.
    """

    def __init__(self, every: int, path: str | Callable[[int], Path], verbose: int = 0) -> None:
        super().__init__(verbose)
        if every < 1:
            raise ConfigError(f"Checkpoint: every is {every}, must be at least 1")
        self._every = every
        self._path = _by_steps(path) if isinstance(path, str) else path
        self._next = every

    def _on_training_start(self) -> None:
        self._next = (self.num_timesteps // self._every + 1) * self._every

    def _on_step(self) -> bool:
        if self.num_timesteps >= self._next:
            save_model(self.model, self._path(self.num_timesteps))
            self._next += self._every
        return True


def _by_steps(template: str) -> Callable[[int], Path]:
    if "{steps}" not in template:
        raise ConfigError(f"Checkpoint: {template}: must hold {{steps}}, or each checkpoint would replace the one before")
    return lambda steps: Path(template.replace("{steps}", str(steps)))
