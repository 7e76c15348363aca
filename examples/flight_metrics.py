"""A callback that logs distances and times of the latest training episodes.

    python examples/flight_metrics.py

In a settings file, with ``PYTHONPATH=examples``: ``callback: [flight_metrics.FlightMetrics]``. What
it logs, such as ``rollout/reached_0.1m``, can move a coefficient: ``coefficient_schedule.py``.
"""

import argparse
from collections import deque

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import LinearSchedule

from sb3_quad import DAgger, GeometricExpert
from sb3_quad.agents.controller import true_state_of
from sb3_quad.base.errors import ConfigError
from sb3_quad.envs import QuadcopterVecEnv
from sb3_quad.evaluation.flights import fly


class FlightMetrics(BaseCallback):
    """Log distances and times of the latest training episodes, next to ``rollout/success_rate``.

    =========================  =================================================================
    name                       meaning
    =========================  =================================================================
    rollout/final_distance     |r - r_T| at the end, m: mean over the flights that survived
    rollout/reached_0.1m       share of the flights that came within the tolerance
    rollout/time_to_0.1m       s until they first did so: mean over those flights
    rollout/collision_rate     share of the flights that touched the ground
    rollout/out_of_range_rate  share of the flights that got too far from the target
    =========================  =================================================================

    It works with any algorithm on the quadcopter's environments, batched or not, and measures the
    true state, without noise. The flights are those of the training: their actions are sampled, and
    under DAgger the expert flies a part of them.

    :param tolerance: distance within which a flight has arrived, m. A flight that begins there
        arrives at 0 s, as every recovery does.
    :param window: number of latest episodes to average over; None: the algorithm's
        ``stats_window_size``.
    :raises ConfigError: for a tolerance that is not positive; when training begins, for an
        environment that is not a quadcopter's.
    """

    def __init__(self, tolerance: float = 0.1, window: int | None = None, verbose: int = 0) -> None:
        super().__init__(verbose)
        if not tolerance > 0.0:
            raise ConfigError(f"FlightMetrics: tolerance {tolerance} m: must be positive")
        if window is not None and window < 1:
            raise ConfigError(f"FlightMetrics: window {window}: must be at least 1 episode")
        self._tolerance = tolerance
        self._window = window
        # For each flight, the final distance, m; the time until it arrived, s, NaN if it never did;
        # collision; out of range
        self._flights: deque[tuple[float, float, bool, bool]] = deque()

    def metrics(self) -> dict[str, float]:
        """The logged means, by name, without those that no flight has contributed to yet."""
        if not self._flights:
            return {}
        final, time_to, collision, out_of_range = np.array(self._flights, dtype=np.float64).T
        arrived = ~np.isnan(time_to)
        survived = (collision + out_of_range) == 0.0
        means = {
            f"reached_{self._tolerance:g}m": arrived,
            "collision_rate": collision,
            "out_of_range_rate": out_of_range,
            "final_distance": final[survived],
            f"time_to_{self._tolerance:g}m": time_to[arrived],
        }
        return {
            f"rollout/{name}": float(values.mean()) for name, values in means.items() if values.size
        }

    def _on_training_start(self) -> None:
        env = self.training_env
        state = true_state_of(env)
        if state is None or not env.has_attr("vehicle"):
            raise ConfigError(
                f"FlightMetrics: {env} is not a quadcopter environment of sb3_quad; "
                "remove this callback"
            )
        self._state = state
        self._control_step = float(env.get_attr("vehicle", [0])[0].control_step)
        self._flights = deque(self._flights, maxlen=self._window or self.model._stats_window_size)
        self._steps = np.zeros(env.num_envs, dtype=np.int64)  # control steps of the episode so far
        self._time_to: np.ndarray = np.where(state().distance <= self._tolerance, 0.0, np.nan)
        # The start of an episode that is already under way was not seen, so do not count it.
        self._from_its_start = np.full(env.num_envs, self.num_timesteps == 0)

    def _on_step(self) -> bool:
        infos = self.locals["infos"]
        ended = np.flatnonzero(self.locals["dones"])
        now = self._state().distance
        distance = now.copy()
        # A row that has ended is already in its next episode; its info has the last distance.
        for row in ended:
            distance[row] = infos[row]["distance"]
        self._steps += 1
        arrived = np.isnan(self._time_to) & (distance <= self._tolerance)
        self._time_to[arrived] = self._steps[arrived] * self._control_step
        for row in ended[self._from_its_start[ended]]:
            collision = infos[row]["collision"]
            out_of_range = infos[row]["out_of_range"]
            self._flights.append((distance[row], self._time_to[row], collision, out_of_range))
        self._from_its_start[ended] = True
        self._steps[ended] = 0
        self._time_to[ended] = np.where(now[ended] <= self._tolerance, 0.0, np.nan)
        return True

    def _on_rollout_end(self) -> None:
        for name, value in self.metrics().items():
            self.logger.record(name, value)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--timesteps", type=int, default=600_000, help="over all environments (%(default)s)"
    )
    arguments = parser.parse_args()

    env = QuadcopterVecEnv(240, task="target_tracking", max_episode_steps=500, seed=0)
    model = DAgger(
        "MlpPolicy",
        env,
        expert=GeometricExpert(),
        n_steps=125,
        batch_size=2048,
        gradient_steps=100,
        n_epochs=1,
        gamma=0.99,
        learning_rate=LinearSchedule(5e-3, 2.5e-4, 1.0),
        dataset_capacity=1_500_000,
        # The expert flies the first rollout, and less of each following one.
        beta=1.0,
        beta_decay=0.2,
        beta_final=0.0,
        seed=0,
        device="cpu",
    )
    metrics = FlightMetrics()
    model.learn(arguments.timesteps, callback=metrics)
    for name, value in metrics.metrics().items():
        print(f"{name}: {value:.3f}")
    flights = fly(model, "target_tracking", n_episodes=480, seed=1_000_000)
    print(f"agent: success {flights.success.mean():.1%}, survival {flights.survival.mean():.1%}")
