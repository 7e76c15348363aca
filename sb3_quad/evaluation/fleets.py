"""n episodes flown at the same time, in either environment, for
:mod:`sb3_quad.evaluation.flights`.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import gymnasium
import numpy as np

from sb3_quad.base.arrays import BoolArray, Float32Array, FloatArray, IntArray
from sb3_quad.simulation.batch import QuadcopterBatch
from sb3_quad.simulation.settings import ENDLESS, FlightSettings
from sb3_quad.simulation.state import STATE, QuadcopterState, row_slices

ENV_ID = "QuadTargetTracking-v0"  # of the environment on PyBullet; its task comes with the settings


class FleetStep(NamedTuple):
    """The outcome of a control step, by row."""

    observation: Float32Array  # (n, 18), or the size that the agent observes
    reward: FloatArray  # (n,)
    lost: BoolArray  # (n,), crashed or out of range
    collided: BoolArray  # (n,), touches the ground
    distance: FloatArray  # (n,), |r - r_T|, m
    success: BoolArray  # (n,), would be a success if it ended now


class BatchFleet:
    """n vehicles in their first episodes, in one batched environment; a row that is lost stays so.

    :param seeds: of the episodes, (n,).
    :param settings: how they fly; ``max_episode_steps`` has no meaning here.
    """

    def __init__(self, seeds: Sequence[int], settings: FlightSettings) -> None:
        endless = settings.with_changes(max_episode_steps=ENDLESS)
        self._batch = QuadcopterBatch(len(seeds), endless, autoreset=False)
        self._batch.seed(seeds)
        self.vehicle = self._batch.vehicle_list[0]
        self.observation_size = self._batch.observation.size

    def reset(self, start: Mapping[str, FloatArray]) -> Float32Array:
        """Begin the episodes; return the observations, (n, observation_size).

        :param start: replaces the episodes' own sample: any of position, velocity, body_rates,
            target (n, 3) and quaternion (n, 4).
        """
        self._batch.reset()
        for name, values in start.items():
            self._batch.state[row_slices(STATE)[name]] = values.T
        return self._batch.observe()

    def step(self, actions: Float32Array, flying: BoolArray) -> FleetStep:
        """Fly one control step; only the rows that are ``flying`` have meaning in the result."""
        observation, reward, _ = self._batch.step(actions)
        end = self._batch.outcome
        return FleetStep(
            observation,
            reward.astype(np.float64),
            ~end["truncated"],
            end["collision"],
            end["distance"],
            end["success"],
        )

    def set_targets(self, rows: IntArray, targets: FloatArray) -> Float32Array:
        """Move the targets of some rows, (len(rows), 3); return all observations."""
        self._batch.set_target(targets, rows)
        return self._batch.observe()

    def set_wrench(self, wrench: FloatArray) -> None:
        """Set the wrench from now on, (n, WRENCH_SIZE), see :mod:`sb3_quad.simulation.state`."""
        self._batch.wrench[:] = wrench.T

    @property
    def wrench(self) -> FloatArray:
        """The external wrench on all rows in this control step, without drag, (n, WRENCH_SIZE)."""
        return self._batch.total_wrench().T

    def true_state(self) -> QuadcopterState:
        """The true state of all rows, fresh or live."""
        return self._batch.true_state()

    def close(self) -> None:
        """Release the environments, where they hold anything."""


class PyBulletFleet:
    """Flies as :class:`BatchFleet`, with a PyBullet environment per row, one after the other.

    The controller still sees them as one batch.
    """

    def __init__(self, seeds: Sequence[int], settings: FlightSettings) -> None:
        # Flights end by their plan; -1 is Gymnasium's word for an environment that truncates none.
        keywords = {**dict(settings), "max_episode_steps": -1, "disable_env_checker": True}
        self._seeds = seeds
        # By its id, since PyBullet may be missing, which matters here only.
        self._envs: list[Any] = [gymnasium.make(ENV_ID, **keywords).unwrapped for _ in seeds]
        self.vehicle = self._envs[0].vehicle
        self.observation_size = self._envs[0].batch.observation.size

    def reset(self, start: Mapping[str, FloatArray]) -> Float32Array:
        for row, env in enumerate(self._envs):
            state = {name: values[row] for name, values in start.items()}
            # A target is no part of an environment's state.
            options: dict[str, Any] = {"target": state.pop("target", None), "state": state}
            env.reset(seed=self._seeds[row], options=options)
        self._observation = np.stack([env.observe() for env in self._envs])
        return self._observation.copy()

    def step(self, actions: Float32Array, flying: BoolArray) -> FleetStep:
        n = len(actions)
        reward, distance = np.zeros((2, n))
        lost, collided, success = np.zeros((3, n), np.bool_)
        # The others have ended; their environments may not be stepped.
        for row in np.flatnonzero(flying):
            self._observation[row], reward[row], lost[row], _, info = self._envs[row].step(
                actions[row]
            )
            collided[row] = info["collision"]
            distance[row] = info["distance"]
            success[row] = info["is_success"]
        return FleetStep(self._observation.copy(), reward, lost, collided, distance, success)

    def set_targets(self, rows: IntArray, targets: FloatArray) -> Float32Array:
        for row, target in zip(rows, targets, strict=True):
            self._envs[row].set_target(target)
            self._observation[row] = self._envs[row].observe()
        return self._observation.copy()

    def set_wrench(self, wrench: FloatArray) -> None:
        for env, values in zip(self._envs, wrench, strict=True):
            env.wrench[:] = values

    @property
    def wrench(self) -> FloatArray:
        return np.stack([env.batch.total_wrench()[:, 0] for env in self._envs])

    def true_state(self) -> QuadcopterState:
        return QuadcopterState.concatenate([env.true_state() for env in self._envs])

    def close(self) -> None:
        for env in self._envs:
            env.close()


Fleet: TypeAlias = BatchFleet | PyBulletFleet
FLEETS: Mapping[str, type[Fleet]] = {"batch": BatchFleet, "pybullet": PyBulletFleet}
