"""The training's episodes: each in a file, and how the latest flights ended in the log."""

import time
from collections import deque
from pathlib import Path

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import ResultsWriter

from sb3_quad.base.arrays import FloatArray
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import read_text
from sb3_quad.controllers.controller import true_state_of


class EpisodeLog(BaseCallback):
    """Adds a line for each episode that ends: return, length, seconds since the start, success.

    It reads ``info["episode"]``, which costs nothing until an episode ends. ``load_results`` and rl-zoo's plots read the file.
    An existing file is continued, its seconds too.

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

    def __init__(self, path: str | Path, env_id: str = "", verbose: int = 0) -> None:
        super().__init__(verbose)
        self._path = Path(path)
        self._env_id = env_id

    def _on_training_start(self) -> None:
        self._start = time.time()
        header: dict[str, float | str] = {"t_start": self._start, "env_id": self._env_id}
        rows = read_text(self._path).splitlines()[2:] if self._path.exists() else []
        self._writer = ResultsWriter(str(self._path), header, ("is_success",), override_existing=not self._path.exists())
        if rows:
            self._start -= float(rows[-1].split(",")[2])

    def _on_step(self) -> bool:
        infos, seconds = self.locals["infos"], round(time.time() - self._start, 3)
        for row in np.flatnonzero(self.locals["dones"]):
            info = infos[row]
            if "episode" in info:
                values = {"r": round(float(info["episode"]["r"]), 6), "l": int(info["episode"]["l"]), "t": seconds}
                self._writer.write_row({**values, "is_success": info.get("is_success", "")})
        return True

    def _on_training_end(self) -> None:
        self._writer.close()


class FlightMetrics(BaseCallback):
    """Logs distances and times of the latest training episodes, beside SB3's own ``rollout/success_rate``.

    ===========================  ======================================================================================
    name                         meaning
    ===========================  ======================================================================================
    rollout/final_distance       |r - r_T| at the end, m: mean over the flights that were not lost
    rollout/reached_0.1m         share of the flights that came within the tolerance
    rollout/time_to_0.1m         s until they first did: mean over those
    rollout/collision_rate       share of the flights that touched the ground
    rollout/out_of_range_rate    share of those that got too far from the target
    ===========================  ======================================================================================

    It works with any algorithm on the quadcopter's environments, batched or not, and measures the true state, without noise.
    The flights are those of the training: with sampled actions, and under DAgger partly flown by the expert.

    >>> from stable_baselines3 import PPO
    >>> from sb3_quad.envs import QuadcopterVecEnv
    >>> env = QuadcopterVecEnv(8, task="state_recovery", max_episode_steps=50, seed=0)
    >>> model = PPO("MlpPolicy", env, n_steps=100, batch_size=400, n_epochs=1, seed=0, device="cpu")
    >>> callback = FlightMetrics(tolerance=1.0)
    >>> _ = model.learn(800, callback=callback)
    >>> callback.metrics()["rollout/reached_1m"]
    1.0

    :param tolerance: what counts as arrived, m. A flight that begins there arrives at 0 s, as every recovery does.
    :param window: episodes that the metrics are about, the latest; None for the algorithm's ``stats_window_size``.
    :raises ConfigError: a tolerance that is not positive; when training begins, an environment that is no quadcopter's.
    """

    def __init__(self, tolerance: float = 0.1, window: int | None = None, verbose: int = 0) -> None:
        super().__init__(verbose)
        if not tolerance > 0.0:
            raise ConfigError(f"FlightMetrics: tolerance {tolerance} m: must be positive")
        if window is not None and window < 1:
            raise ConfigError(f"FlightMetrics: window {window}: must be at least 1 episode")
        self._tolerance, self._window = tolerance, window
        # By flight: final distance, m; time until it arrived, s, NaN if it never did; collision; out of range.
        self._flights: deque[tuple[float, float, bool, bool]] = deque()

    def metrics(self) -> dict[str, float]:
        """What is logged, by name; what no flight has shown yet is left out."""
        if not self._flights:
            return {}
        final, time_to, collision, out_of_range = np.array(self._flights, dtype=np.float64).T
        arrived, kept = ~np.isnan(time_to), (collision + out_of_range) == 0.0
        means = {
            f"reached_{self._tolerance:g}m": arrived,
            "collision_rate": collision,
            "out_of_range_rate": out_of_range,
            "final_distance": final[kept],
            f"time_to_{self._tolerance:g}m": time_to[arrived],
        }
        return {f"rollout/{name}": float(values.mean()) for name, values in means.items() if values.size}

    def _on_training_start(self) -> None:
        env, state = self.training_env, true_state_of(self.training_env)
        if state is None or not env.has_attr("vehicle"):
            raise ConfigError(f"FlightMetrics: {env} is no quadcopter environment of sb3_quad; leave this callback out")
        self._state = state
        self._control_step = float(env.get_attr("vehicle", [0])[0].control_step)
        self._flights = deque(self._flights, maxlen=self._window or self.model._stats_window_size)
        self._steps = np.zeros(env.num_envs, dtype=np.int64)  # control steps of the episode so far
        self._time_to: FloatArray = np.where(state().distance <= self._tolerance, 0.0, np.nan)
        # An episode that is already under way was not seen from its start: it is left out.
        self._from_its_start = np.full(env.num_envs, self.num_timesteps == 0)

    def _on_step(self) -> bool:
        infos, ended = self.locals["infos"], np.flatnonzero(self.locals["dones"])
        now = self._state().distance
        distance = now.copy()
        distance[ended] = [infos[row]["distance"] for row in ended]  # it flies its next episode already
        self._steps += 1
        arrived = np.isnan(self._time_to) & (distance <= self._tolerance)
        self._time_to[arrived] = self._steps[arrived] * self._control_step
        for row in ended[self._from_its_start[ended]]:
            lost = infos[row]["collision"], infos[row]["out_of_range"]
            self._flights.append((distance[row], self._time_to[row], *lost))
        self._from_its_start[ended] = True
        self._steps[ended] = 0
        self._time_to[ended] = np.where(now[ended] <= self._tolerance, 0.0, np.nan)
        return True

    def _on_rollout_end(self) -> None:
        for name, value in self.metrics().items():
            self.logger.record(name, value)
