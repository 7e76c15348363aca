"""The training's episodes in a file."""

import time
from pathlib import Path

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import ResultsWriter

from sb3_quad.base.files import read_text
from sb3_quad.base.types import StrPath


class EpisodeLog(BaseCallback):
    """Adds a line for each episode that ends: return, length, seconds since the start, success.

    It reads ``info["episode"]``, which costs nothing until an episode ends. ``load_results`` and
    rl-zoo's plots read the file. An existing file is continued, its seconds too.

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
        self._start = time.time()
        header: dict[str, float | str] = {"t_start": self._start, "env_id": self._env_id}
        is_new = not self._path.exists()
        if not is_new:
            # A crash may have cut the last row.
            with self._path.open("rb+") as file:
                file.truncate(file.read().rfind(b"\n") + 1)
            # The seconds of an earlier training count, too; two lines are the file's head.
            rows = read_text(self._path).splitlines()[2:]
            if rows:
                self._start -= float(rows[-1].split(",")[2])
        self._writer = ResultsWriter(
            str(self._path), header, ("is_success",), override_existing=is_new
        )

    def _on_step(self) -> bool:
        seconds = round(time.time() - self._start, 3)
        for row in np.flatnonzero(self.locals["dones"]):
            info = self.locals["infos"][row]
            if "episode" in info:
                values = {
                    "r": round(float(info["episode"]["r"]), 6),
                    "l": int(info["episode"]["l"]),
                    "t": seconds,
                    "is_success": info.get("is_success", ""),
                }
                self._writer.write_row(values)
        return True

    def _on_training_end(self) -> None:
        self._writer.close()
