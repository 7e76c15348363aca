"""Your own callback: flights of the current policy, as plots in TensorBoard.

    python examples/trajectory_plots.py
    tensorboard --logdir tb

In a settings file, with ``-tb FOLDER`` and ``PYTHONPATH=examples`` on the command line::

    callback:
      - trajectory_plots.TrajectoryPlots: {every: 1000000, task: state_recovery}
"""

import argparse
from typing import Any

import numpy as np
from matplotlib.figure import Figure as Picture
from stable_baselines3.common.logger import Figure
from stable_baselines3.common.utils import LinearSchedule

from sb3_quad import DAgger, GeometricExpert
from sb3_quad.base.seeds import row_seeds
from sb3_quad.base.types import Arrays
from sb3_quad.callbacks.every import EveryTimesteps
from sb3_quad.envs import QuadcopterVecEnv
from sb3_quad.envs.simulation import MAX_EPISODE_STEPS
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.evaluation.flightlog import Recorder
from sb3_quad.evaluation.flights import fly, fly_settings


class TrajectoryPlots(EveryTimesteps):
    """Fly a few episodes every ``every`` timesteps, and log them as ``flights/figure``.

    The figure shows path, error and actions. It works with any algorithm whose policy flies on the
    quadcopter's own observation. The flights are deterministic, the same each time, and separate
    from the training: neither its environments nor its random numbers are touched.

    :param every: timesteps between plots.
    :param n_episodes: episodes in a plot.
    :param seed: seed of the flights.
    :param max_episode_steps: control steps after which an episode ends at the latest.
    :param environment: keywords of :class:`~sb3_quad.envs.vec_env.QuadcopterVecEnv`, such as
        ``task`` and ``vehicle``.
    :raises ConfigError: ``every`` or ``n_episodes`` below 1, or an unknown keyword.
    """

    def __init__(
        self,
        every: int,
        n_episodes: int = 4,
        seed: int = 0,
        max_episode_steps: int = MAX_EPISODE_STEPS,
        verbose: int = 0,
        **environment: Any,
    ) -> None:
        super().__init__(every, verbose)
        self._seeds = row_seeds(seed, n_episodes)
        environment["max_episode_steps"] = max_episode_steps
        self._settings = FlightSettings().with_changes(**environment)

    def _on_event(self) -> bool:
        recorder = Recorder(len(self._seeds))
        fly_settings(self.model, self._settings, self._seeds, hooks=[recorder])
        plot = Figure(_plot(recorder.arrays()), close=False)
        self.logger.record("flights/figure", plot, exclude=("stdout", "log", "json", "csv"))
        self.logger.dump(self.num_timesteps)
        return True


def _plot(flights: Arrays) -> Picture:
    """Paths in 3-D, distance from the target, and the actions of the first flight."""
    picture = Picture(figsize=(13, 4), layout="constrained")
    space: Any = picture.add_subplot(1, 3, 1, projection="3d")
    space.set(xlabel="x (m)", ylabel="y (m)", zlabel="z (m)", title="paths and targets")
    error = picture.add_subplot(
        1, 3, 2, xlabel="time (s)", ylabel="distance from target (m)", title="error"
    )
    actions = picture.add_subplot(
        1, 3, 3, xlabel="time (s)", ylabel="action", title="actions of flight 0", ylim=(-1.05, 1.05)
    )
    paths = zip(flights["position"], flights["target"], strict=True)
    for number, (position, target) in enumerate(paths):
        space.plot(*position.T, color=f"C{number}")
        space.plot(*target[:1].T, color=f"C{number}", marker="D")
        distance = np.linalg.norm(position - target, axis=1)
        error.plot(flights["time"], distance, label=f"flight {number}")
    actions.plot(
        flights["time"], flights["action"][0], label=[f"rotor {rotor}" for rotor in range(4)]
    )
    space.set_aspect("equal", adjustable="datalim")
    for axes in (error, actions):
        axes.grid(alpha=0.3)
        axes.legend(frameon=False)
    return picture


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--timesteps",
        type=int,
        default=600_000,
        help="transitions, over all environments (%(default)s)",
    )
    arguments = parser.parse_args()

    env = QuadcopterVecEnv(240, task="state_recovery", max_episode_steps=500, seed=0)
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
        tensorboard_log="tb",
    )
    plots = TrajectoryPlots(
        every=60_000, n_episodes=2, max_episode_steps=200, task="state_recovery"
    )
    model.learn(arguments.timesteps, callback=plots)
    flights = fly(model, "state_recovery", n_episodes=480, seed=1_000_000)
    print(f"agent: success {flights.success.mean():.1%}, survival {flights.survival.mean():.1%}")
    print("plots are in tb/")
