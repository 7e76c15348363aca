"""A line about the progress of a training, for logs and pipes."""

import time
from collections.abc import Callable

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import safe_mean

from sb3_quad.callbacks.every import last_timestep


class ProgressLine(BaseCallback):
    """Report how far the training is, once a minute: where the output is no terminal to draw a bar.

    >>> from stable_baselines3 import PPO
    >>> from sb3_quad.envs import QuadcopterVecEnv
    >>> env = QuadcopterVecEnv(8, max_episode_steps=50, seed=0)
    >>> model = PPO("MlpPolicy", env, n_steps=100, batch_size=400, device="cpu")
    >>> lines = []
    >>> _ = model.learn(800, callback=ProgressLine(lines.append, seconds=0.0))
    >>> lines[-1].split(",")[0].strip()
    '800 of 800 timesteps (100 %)'

    :param report: called with each line.
    :param seconds: between two lines.
    """

    def __init__(
        self, report: Callable[[str], None] = print, seconds: float = 60.0, verbose: int = 0
    ) -> None:
        super().__init__(verbose)
        self._report = report
        self._seconds = seconds

    def _on_training_start(self) -> None:
        self._start = time.monotonic()
        self._next_line = self._start + self._seconds
        self._first_timestep = self.num_timesteps
        self._last_timestep = last_timestep(self.model)

    def _on_step(self) -> bool:
        now = time.monotonic()
        if now >= self._next_line:
            self._next_line = now + self._seconds
            self._report(self._line(now - self._start))
        return True

    def _line(self, elapsed: float) -> str:
        total = self._last_timestep
        line = f"{self.num_timesteps:>12,} of {total:,} timesteps"
        line += f" ({100 * self.num_timesteps / total:.0f} %)"
        # Monitor fills this buffer where an episode ends.
        episodes = self.model.ep_info_buffer
        if episodes:
            line += f", mean reward {safe_mean([episode['r'] for episode in episodes]):.2f}"
        # A resumed training is timed from where it continues.
        seconds_per_step = elapsed / (self.num_timesteps - self._first_timestep)
        minutes = seconds_per_step * (total - self.num_timesteps) / 60
        return f"{line}, {minutes:.0f} min left"
