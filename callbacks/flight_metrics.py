"""How the training's flights end, and how soon they arrive, in the log."""

from __future__ import annotations

from collections import deque
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from stable_baselines3.common.callbacks import BaseCallback

from sb3_quad.base.errors import ConfigError

FloatArray = npt.NDArray[np.float64]


class _Flight(NamedTuple):
    final_distance: float  # m
    time_to: float  # s; NaN if it never arrived
    collision: bool
    out_of_range: bool


class FlightMetrics(BaseCallback):
    """Logs distances and times of the latest training episodes; ``rollout/success_rate`` SB3 itself logs beside them.

    ===========================  ======================================================================================
    name                         meaning
    ===========================  ======================================================================================
    rollout/final_distance       |r - r_T| at the end, m: mean over the flights that were not lost
    rollout/reached_0.1m         share of the flights that came within the tolerance
    rollout/time_to_0.1m         s until they first did: mean over those
    rollout/collision_rate       share of the flights that touched the ground
    rollout/out_of_range_rate    share of those that got too far from the target
    ===========================  ======================================================================================

    With any algorithm, on the quadcopter's environments, batched or not; of the true state, so without noise. The flights
    are the training's own: by sampled actions, and under DAgger partly by the expert.

    >>> from stable_baselines3 import PPO
    >>> from sb3_quad.envs import QuadcopterVecEnv
    >>> env = QuadcopterVecEnv(8, task="state_recovery", max_episode_steps=50, seed=0)
    >>> model = PPO("MlpPolicy", env, n_steps=100, batch_size=400, n_epochs=1, seed=0, device="cpu")
    >>> metrics = FlightMetrics(tolerance=1.0)
    >>> _ = model.learn(800, callback=metrics)
    >>> metrics.figures()["rollout/reached_1m"]
    1.0

    :param tolerance: what counts as arrived, m. A flight that begins there arrives at 0 s, as every recovery does.
    :param window: episodes that the figures are about, the latest; None for the algorithm's ``stats_window_size``.
    :raises ConfigError: a tolerance that is not positive; when training begins, an environment that is no quadcopter's.
    """

    def __init__(self, tolerance: float = 0.1, window: int | None = None, verbose: int = 0) -> None:
        super().__init__(verbose)
        if not tolerance > 0.0:
            raise ConfigError(f"FlightMetrics: tolerance {tolerance} m: must be positive")
        if window is not None and window < 1:
            raise ConfigError(f"FlightMetrics: window {window}: must be at least 1 episode")
        self._tolerance, self._window = tolerance, window
        self._flights: deque[_Flight] = deque()
        self._new = False

    def figures(self) -> dict[str, float]:
        """What is logged, by name; without what no flight has shown yet."""
        if not self._flights:
            return {}
        final, time_to, collision, out_of_range = (np.array(column) for column in zip(*self._flights, strict=True))
        arrived, kept = ~np.isnan(time_to), ~(collision | out_of_range)
        figures = {
            f"rollout/reached_{self._tolerance:g}m": float(arrived.mean()),
            "rollout/collision_rate": float(collision.mean()),
            "rollout/out_of_range_rate": float(out_of_range.mean()),
        }
        if kept.any():
            figures["rollout/final_distance"] = float(final[kept].mean())
        if arrived.any():
            figures[f"rollout/time_to_{self._tolerance:g}m"] = float(time_to[arrived].mean())
        return figures

    def _on_training_start(self) -> None:
        env = self.training_env
        if not (env.has_attr("vehicle") and env.has_attr("true_state")):
            raise ConfigError(f"FlightMetrics: {env} is no quadcopter environment of sb3_quad; leave this callback away")
        n = env.num_envs
        self._control_step = float(env.get_attr("vehicle", [0])[0].control_step)
        self._flights = deque(self._flights, maxlen=self._window or self.model._stats_window_size)
        self._steps = np.zeros(n, dtype=np.int64)  # control steps of the episode so far
        self._time_to: FloatArray = np.where(self._distance() <= self._tolerance, 0.0, np.nan)
        self._from_its_start = np.full(n, self.num_timesteps == 0)  # an episode under way has flown unseen: it is left out

    def _on_step(self) -> bool:
        dones, infos = self.locals["dones"], self.locals["infos"]
        distance = self._distance()
        ended = np.flatnonzero(dones)
        for row in ended:  # it flies its next episode already
            distance[row] = infos[row]["distance"]
        self._steps += 1
        arrived = np.isnan(self._time_to) & (distance <= self._tolerance)
        self._time_to[arrived] = self._steps[arrived] * self._control_step
        if ended.size:
            self._note(ended, infos)
        return True

    def _note(self, ended: npt.NDArray[np.int64], infos: list[dict[str, Any]]) -> None:
        for row in ended:
            if self._from_its_start[row]:
                info = infos[row]
                times = float(info["distance"]), float(self._time_to[row])
                self._flights.append(_Flight(*times, bool(info["collision"]), bool(info["out_of_range"])))
                self._new = True
        self._from_its_start[ended] = True
        self._steps[ended] = 0
        self._time_to[ended] = np.where(self._distance()[ended] <= self._tolerance, 0.0, np.nan)

    def _on_rollout_end(self) -> None:
        if self._new:
            self._new = False
            for name, value in self.figures().items():
                self.logger.record(name, value)

    def _distance(self) -> FloatArray:
        """|r - r_T| of every row now, (n,), m."""
        env = self.training_env.unwrapped
        if hasattr(env, "true_state"):
            return np.asarray(env.true_state().distance)
        return np.array([state.distance[0] for state in env.env_method("true_state")])
