"""Flights of the policy as it is, as figures in TensorBoard."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Figure

from sb3_quad.base.errors import ConfigError
from sb3_quad.envs.registration import MAX_EPISODE_STEPS
from sb3_quad.simulation.observation import OBSERVATION_SIZE

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Picture

    from sb3_quad.evaluation.flightlog import Arrays

WRITERS_WITHOUT_FIGURES = ("stdout", "log", "json", "csv")


class TrajectoryFigures(BaseCallback):
    """Flies a few episodes every ``every`` transitions and logs them as ``flights/figure``: path, error, actions.

    With any algorithm of Stable-Baselines3 whose policy flies the quadcopter's own observation. The flights are the same
    each time, deterministic, and apart from the training: neither its environments nor its random numbers are touched.

    >>> from stable_baselines3 import PPO
    >>> from sb3_quad.envs import QuadcopterVecEnv
    >>> env = QuadcopterVecEnv(8, "state_recovery", seed=0)
    >>> model = PPO("MlpPolicy", env, n_steps=100, batch_size=400, tensorboard_log="tb", device="cpu")
    >>> figures = TrajectoryFigures(every=800, n_flights=2, max_steps=50, task="state_recovery")
    >>> _ = model.learn(800, callback=figures)

    In a configuration file, with ``-tb`` on the command line::

        callback:
          - sb3_quad.callbacks.TrajectoryFigures: {every: 1000000, task: state_recovery}

    :param every: transitions between figures.
    :param n_flights: episodes in a figure.
    :param seed: of the first of them; the next has the next one.
    :param max_steps: control steps of an episode that nothing ends before.
    :param task: as :class:`~sb3_quad.envs.vec_env.QuadcopterVecEnv` takes it, as are ``task_kwargs``, ``vehicle``, ``noise``
        and ``observation_std``.
    :raises ConfigError: ``every`` or ``n_flights`` below 1; when training begins, a policy of other spaces.
    """

    def __init__(
        self,
        every: int,
        n_flights: int = 4,
        seed: int = 0,
        max_steps: int = MAX_EPISODE_STEPS,
        task: Any = "target_tracking",
        task_kwargs: Mapping[str, Any] | None = None,
        vehicle: Any = "itm",
        noise: float = 0.05,
        observation_std: Any = None,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        for name, value in (("every", every), ("n_flights", n_flights), ("max_steps", max_steps)):
            if value < 1:
                raise ConfigError(f"TrajectoryFigures: {name} is {value}, must be at least 1")
        self._every, self._next = every, every
        self._seeds, self._max_steps = range(seed, seed + n_flights), max_steps
        self._setting = (task, task_kwargs, vehicle, noise, max_steps, observation_std)

    def _on_training_start(self) -> None:
        shapes = self.model.observation_space.shape, self.model.action_space.shape
        if shapes != ((OBSERVATION_SIZE,), (4,)):
            raise ConfigError(
                f"TrajectoryFigures: the policy has observations and actions of shape {shapes[0]} and {shapes[1]}, "
                f"the quadcopter's are ({OBSERVATION_SIZE},) and (4,)"
            )
        self._next = (self.num_timesteps // self._every + 1) * self._every

    def _on_step(self) -> bool:
        if self.num_timesteps >= self._next:
            self._next = (self.num_timesteps // self._every + 1) * self._every
            figure = Figure(draw_flights(self._fly()), close=False)
            self.logger.record("flights/figure", figure, exclude=WRITERS_WITHOUT_FIGURES)
            self.logger.dump(self.num_timesteps)
        return True

    def _fly(self) -> Arrays:
        from sb3_quad.evaluation.flightlog import Recorder
        from sb3_quad.evaluation.flights import fly

        recorder = Recorder(len(self._seeds), self._max_steps)
        task, task_kwargs, vehicle, noise, max_steps, std = self._setting
        keywords = {"vehicle": vehicle, "noise": noise, "task_kwargs": task_kwargs, "observation_std": std}
        fly(self.model, task, len(self._seeds), self._seeds[0], max_steps=max_steps, hooks=[recorder], **keywords)
        return recorder.arrays()


def draw_flights(arrays: Arrays) -> Picture:
    """Sampled flights as a figure: paths in 3-D, distance from the target, and the actions of the first.

    :param arrays: as :mod:`sb3_quad.evaluation.flightlog` lays them out.
    """
    from matplotlib.figure import Figure as New

    picture = New(figsize=(13, 4), layout="constrained")
    grid = picture.add_gridspec(1, 3, width_ratios=(1.3, 1.0, 1.0), wspace=0.08)
    space: Any = picture.add_subplot(grid[0], projection="3d")
    error, actions = picture.add_subplot(grid[1]), picture.add_subplot(grid[2])
    time = arrays["time"]
    for number, (position, target) in enumerate(zip(arrays["position"], arrays["target"], strict=True)):
        colour = f"C{number}"
        space.plot(*position.T, color=colour, linewidth=1.2)
        space.plot(*target[0][:, None], marker="D", color=colour, markersize=5)
        error.plot(time, np.linalg.norm(position - target, axis=1), color=colour, label=f"flight {number}")
    for rotor in range(4):
        actions.plot(time, arrays["action"][0, :, rotor], linewidth=0.8, label=f"rotor {rotor}")
    space.set(xlabel="x (m)", ylabel="y (m)", zlabel="z (m)", title="paths and targets")
    space.set_aspect("equal", adjustable="datalim")
    error.set(xlabel="time (s)", ylabel="distance from target (m)", ylim=(0.0, None), title="error")
    actions.set(xlabel="time (s)", ylabel="action", ylim=(-1.05, 1.05), title="actions of flight 0")
    for axes in (error, actions):
        axes.grid(alpha=0.3)
        axes.legend(frameon=False)
    return picture
