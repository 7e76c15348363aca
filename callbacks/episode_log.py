"""Every training episode in a file, as SB3's Monitor writes it, for any vectorised environment."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TextIO

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback


class EpisodeLog(BaseCallback):
    """Adds a line for each episode that ends: return, length, seconds since the start, success.

    Reads ``info["episode"]``, so it costs nothing while episodes go on; ``load_results`` and rl-zoo's plots read the file.
    A file that is there already is continued.

    >>> from stable_baselines3 import PPO
    >>> from stable_baselines3.common.results_plotter import load_results
    >>> from sb3_quad.envs import QuadcopterVecEnv
    >>> env = QuadcopterVecEnv(8, max_episode_steps=50, seed=0)
    >>> model = PPO("MlpPolicy", env, n_steps=100, batch_size=400, device="cpu")
    >>> _ = model.learn(800, callback=EpisodeLog("0.monitor.csv"))
    >>> len(load_results("."))
    16

    :param path: named ``<number>.monitor.csv``.
    :param env_id: noted in the file.
    """

    def __init__(self, path: str | Path, env_id: str = "", verbose: int = 0) -> None:
        super().__init__(verbose)
        self._path = Path(path)
        self._env_id = env_id
        self._file: TextIO | None = None
        self._start = 0.0

    def _on_training_start(self) -> None:
        self._start = time.time()
        new = not self._path.exists()
        self._file = self._path.open("a", encoding="utf-8")
        if new:
            self._file.write(f"#{json.dumps({'t_start': self._start, 'env_id': self._env_id})}\nr,l,t,is_success\n")

    def _on_step(self) -> bool:
        ended = np.flatnonzero(self.locals["dones"])
        if self._file is not None and ended.size:
            seconds = time.time() - self._start
            infos = self.locals["infos"]
            for i in ended:
                episode = infos[i].get("episode")
                if episode is not None:
                    success = infos[i].get("is_success", "")
                    self._file.write(f"{float(episode['r']):.6f},{int(episode['l'])},{seconds:.3f},{success}\n")
        return True

    def _on_rollout_end(self) -> None:
        if self._file is not None:
            self._file.flush()

    def _on_training_end(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None
