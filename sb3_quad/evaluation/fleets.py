"""n episodes flown at the same time, in either environment, for
:mod:`sb3_quad.evaluation.flights`.
"""

from collections.abc import Mapping, Sequence
from operator import attrgetter
from typing import Any

import gymnasium
import numpy as np

from sb3_quad.base.types import BoolArray, Float32Array, FloatArray, IntArray, StrDict
from sb3_quad.simulation.batch import QuadcopterBatch
from sb3_quad.simulation.settings import ENDLESS, FlightSettings
from sb3_quad.simulation.state import STATE, TARGET, QuadcopterState, row_slices

Start = Mapping[str, FloatArray]
# The environment on PyBullet; its task comes with the settings.
ENV_ID = "QuadTargetTracking-v0"


class Fleet:
    """n vehicles in their first episodes, in one batched environment; a row that is lost stays so.

    :param seeds: of the episodes, (n,).
    :param settings: how they fly; ``max_episode_steps`` has no meaning here, since flights end by
        their plan.
    """

    def __init__(self, seeds: Sequence[int], settings: FlightSettings) -> None:
        endless = settings.with_changes(max_episode_steps=ENDLESS)
        self._batches = self._open(seeds, endless)
        self.vehicle = self._batches[0].vehicle_list[0]
        self.observation_size = self._batches[0].observation.size

    def _open(self, seeds: Sequence[int], settings: FlightSettings) -> list[QuadcopterBatch]:
        batch = QuadcopterBatch(len(seeds), settings, autoreset=False)
        batch.seed(seeds)
        return [batch]

    def reset(self, start: Start) -> Float32Array:
        """Begin the episodes; return the observations, (n, observation_size).

        :param start: replaces the episodes' own sample: any of position, velocity, body_rates,
            target (n, 3) and quaternion (n, 4).
        """
        (batch,) = self._batches
        batch.reset()
        for name, values in start.items():
            batch.state[row_slices(STATE)[name]] = values.T
        return batch.observe()

    def step(self, actions: Float32Array, flying: BoolArray) -> tuple[Float32Array, FloatArray]:
        """Fly one control step; return the observations and the rewards, (n,).

        Only the rows that are ``flying`` have meaning in them and in :attr:`outcome`.
        """
        observation, reward, _ = self._batches[0].step(actions)
        return observation, reward.astype(np.float64)

    def set_targets(self, rows: IntArray, targets: FloatArray) -> Float32Array:
        """Move the targets of some rows, (len(rows), 3); return all observations."""
        self._batches[0].state[TARGET, rows] = targets.T
        return self._batches[0].observe()

    def set_wrench(self, wrench: FloatArray) -> None:
        """Set the wrench from now on, (n, WRENCH_SIZE), see :mod:`sb3_quad.simulation.state`."""
        self._batches[0].wrench[:] = wrench.T

    @property
    def outcome(self) -> Any:
        """How the rows are, (n,), see :data:`~sb3_quad.simulation.kernel.OUTCOME`."""
        return np.concatenate([*map(attrgetter("outcome"), self._batches)])

    @property
    def wrench(self) -> FloatArray:
        """The external wrench on all rows in this control step, without drag, (n, WRENCH_SIZE)."""
        return np.hstack([*map(QuadcopterBatch.total_wrench, self._batches)]).T

    def true_state(self) -> QuadcopterState:
        """The true state of all rows, of its own memory."""
        return QuadcopterState.concatenate([*map(QuadcopterBatch.true_state, self._batches)])

    def close(self) -> None:
        """Release the environments, where they hold anything."""


class PyBulletFleet(Fleet):
    """Flies with a PyBullet environment per row, one after the other.

    The controller still sees them as one batch.
    """

    def _open(self, seeds: Sequence[int], settings: FlightSettings) -> list[QuadcopterBatch]:
        # Flights end by their plan; -1 is Gymnasium's word for an environment that truncates none.
        keywords = {**dict(settings), "max_episode_steps": -1, "disable_env_checker": True}
        self._seeds = seeds
        # By its id, since PyBullet may be missing, which matters here only.
        self._envs: list[Any] = [gymnasium.make(ENV_ID, **keywords).unwrapped for _ in seeds]
        return [*map(attrgetter("batch"), self._envs)]

    def reset(self, start: Start) -> Float32Array:
        for row, env in enumerate(self._envs):
            state = {name: values[row] for name, values in start.items()}
            # A target is no part of an environment's state.
            options: StrDict = {"target": state.pop("target", None), "state": state}
            env.reset(seed=self._seeds[row], options=options)
        self._observation = np.stack([env.observe() for env in self._envs])
        return self._observation.copy()

    def step(self, actions: Float32Array, flying: BoolArray) -> tuple[Float32Array, FloatArray]:
        reward = np.zeros(len(actions))
        # The others have ended; their environments may not be stepped.
        for row in np.flatnonzero(flying):
            self._observation[row], reward[row], *_ = self._envs[row].step(actions[row])
        return self._observation.copy(), reward

    def set_targets(self, rows: IntArray, targets: FloatArray) -> Float32Array:
        for row, target in zip(rows, targets, strict=True):
            self._envs[row].set_target(target)
            self._observation[row] = self._envs[row].observe()
        return self._observation.copy()

    def set_wrench(self, wrench: FloatArray) -> None:
        for env, values in zip(self._envs, wrench, strict=True):
            env.batch.wrench[:, 0] = values

    def close(self) -> None:
        for env in self._envs:
            env.close()


FLEETS: Mapping[str, type[Fleet]] = {"batch": Fleet, "pybullet": PyBulletFleet}
