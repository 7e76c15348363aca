"""Callbacks that do something at regular intervals: timesteps, seconds, or ends of episodes."""

import os
import time
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, EventCallback
from stable_baselines3.common.monitor import ResultsWriter
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.type_aliases import TrainFrequencyUnit
from stable_baselines3.common.utils import safe_mean

from sb3_quad.base.errors import ConfigError, raised_as
from sb3_quad.base.files import regular_file, save_model
from sb3_quad.base.types import Report, StrPath

LONGEST_TRAINING = 1e9  # s
# The end of an episode log holds its last line, and more than its header if that is all, bytes.
LONGEST_LINES = 10_000


class EveryTimesteps(EventCallback):
    """Calls :meth:`_on_event` after the first step at or beyond each multiple of ``every``.

    A resumed training keeps to the same multiples. SB3's EveryNTimesteps counts from its last call
    instead, so its events drift away from them.

    :param every: timesteps, over all environments together.
    :raises ConfigError: ``every`` is below 1.
    """

    def __init__(self, every: int, verbose: int = 0) -> None:
        super().__init__(verbose=verbose)
        if every < 1:
            raise ConfigError(f"{type(self).__name__}: every is {every}, must be at least 1")
        self._every = every
        self._passed = 0  # multiples that the training has passed

    def _on_training_start(self) -> None:
        self._passed = self.num_timesteps // self._every

    def _on_step(self) -> bool:
        before = self._passed
        self._passed = self.num_timesteps // self._every
        return self._passed == before or self._on_event()


class Checkpoint(EveryTimesteps):
    """Saves the model every ``every`` timesteps, each file whole or not at all.

    >>> from stable_baselines3 import PPO
    >>> from sb3_quad.envs import QuadcopterVecEnv
    >>> env = QuadcopterVecEnv(8, seed=0)
    >>> model = PPO("MlpPolicy", env, n_steps=100, batch_size=400, device="cpu")
    >>> _ = model.learn(1600, callback=Checkpoint(800, "checkpoints/rl_model_{steps}_steps.zip"))
    >>> sorted(path.name for path in Path("checkpoints").iterdir())
    ['rl_model_1600_steps.zip', 'rl_model_800_steps.zip']

    :param every: timesteps, over all environments together.
    :param path: the file, with ``{steps}`` where the number of timesteps goes. A file there is
        replaced.
    :raises ConfigError: ``every`` below 1, a path without ``{steps}``; when saving, a folder that
        cannot be written.
    """

    def __init__(self, every: int, path: str, verbose: int = 0) -> None:
        super().__init__(every, verbose)
        if "{steps}" not in path:
            raise ConfigError(
                f"Checkpoint: {path}: must hold {{steps}}, "
                "or each checkpoint would replace the one before"
            )
        self._path = path

    def _on_event(self) -> bool:
        save_model(self.model, self._path.replace("{steps}", str(self.num_timesteps)))
        return True


class ProgressLine(BaseCallback):
    """Reports once a minute how far the training is, where there is no terminal for a progress bar.

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

    def __init__(self, report: Report = print, seconds: float = 60.0, verbose: int = 0) -> None:
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
        line = (
            f"{self.num_timesteps:>12,} of {total:,} timesteps"
            f" ({100 * self.num_timesteps / total:.0f} %)"
        )
        # Monitor fills this buffer when an episode ends.
        episodes = self.model.ep_info_buffer
        if episodes:
            line += f", mean reward {safe_mean([episode['r'] for episode in episodes]):.2f}"
        # A resumed training is timed from its continuation.
        seconds_per_step = elapsed / (self.num_timesteps - self._first_timestep)
        return f"{line}, {seconds_per_step * (total - self.num_timesteps) / 60:.0f} min left"


class EpisodeLog(BaseCallback):
    """Writes a line for each episode that ends: return, length, seconds since the start, success.

    It reads ``info["episode"]``, which costs nothing until an episode ends. ``load_results`` and
    rl-zoo's plots read the file. An existing file is continued, and so are its seconds.

    >>> from stable_baselines3 import PPO
    >>> from stable_baselines3.common.results_plotter import load_results
    >>> from sb3_quad.envs import QuadcopterVecEnv
    >>> env = QuadcopterVecEnv(8, max_episode_steps=50, seed=0)
    >>> model = PPO("MlpPolicy", env, n_steps=100, batch_size=400, device="cpu")
    >>> _ = model.learn(800, callback=EpisodeLog("0.monitor.csv"))
    >>> len(load_results("."))
    16

    :param path: must be named ``<number>.monitor.csv``.
    :param env_id: noted in the file.
    """

    def __init__(self, path: StrPath, env_id: str = "", verbose: int = 0) -> None:
        super().__init__(verbose)
        self._path = Path(path)
        self._env_id = env_id

    def _on_training_start(self) -> None:
        lines = self._last_lines() if self._path.exists() else []
        # The seconds of an earlier training count, too.
        earlier = 0.0
        # The first two lines are the header, which a crash may have cut, too.
        if len(lines) > 2:
            with raised_as(ConfigError, f"{self._path}: its last line is no episode"):
                earlier = float(lines[-1].split(b",")[2])
                if not 0.0 <= earlier < LONGEST_TRAINING:
                    raise ValueError(f"t is {earlier:g}")
        # The clock of the day may be set back.
        self._start = time.monotonic() - earlier
        self._writer = ResultsWriter(
            str(self._path),
            {"t_start": time.time() - earlier, "env_id": self._env_id},
            ("is_success",),
            override_existing=len(lines) < 2,
        )

    def _last_lines(self) -> list[bytes]:
        """Return the last lines of the file, without one that a crash has cut, which it loses."""
        with regular_file(self._path).open("rb+") as file:
            size = file.seek(0, os.SEEK_END)
            begin = file.seek(max(0, size - LONGEST_LINES))
            whole, newline, _ = file.read().rpartition(b"\n")
            file.truncate(begin + len(whole + newline))
        return whole.splitlines()

    def _on_step(self) -> bool:
        seconds = round(time.monotonic() - self._start, 3)
        for row in np.flatnonzero(self.locals["dones"]):
            info = self.locals["infos"][row]
            if "episode" in info:
                self._writer.write_row(
                    {
                        "r": round(float(info["episode"]["r"]), 6),
                        "l": int(info["episode"]["l"]),
                        "t": seconds,
                        "is_success": info.get("is_success", ""),
                    }
                )
        return True

    def _on_training_end(self) -> None:
        self._writer.close()


def last_timestep(model: BaseAlgorithm) -> int:
    """Return the timestep at which the present ``model.learn`` ends, after whole rollouts."""
    steps = 1
    if isinstance(model, OnPolicyAlgorithm):
        steps = model.n_steps
    elif isinstance(model, OffPolicyAlgorithm):
        frequency: Any = model.train_freq
        if frequency.unit == TrainFrequencyUnit.STEP:
            steps = frequency.frequency
    rollout = steps * model.n_envs
    n_rollouts = -(-(model._total_timesteps - model.num_timesteps) // rollout)
    return model.num_timesteps + n_rollouts * rollout
