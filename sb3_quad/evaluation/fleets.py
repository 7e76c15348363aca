"""The same n episodes in either environment, side by side in one process, for :mod:`sb3_quad.evaluation.flights`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from sb3_quad.base.arrays import BoolArray, Float32Array, FloatArray, IntArray
from sb3_quad.base.errors import ConfigError
from sb3_quad.envs.quadcopter_env import QuadcopterEnv
from sb3_quad.settings.flight import FlightSettings
from sb3_quad.simulation.batch import QuadcopterBatch
from sb3_quad.simulation.layout import row_slices
from sb3_quad.simulation.state import STATE, QuadcopterState
from sb3_quad.vehicles.vehicle import Vehicle

MAX_CLIENTS = 512  # PyBullet allows about 1000 physics clients in a process


class FleetStep(NamedTuple):
    """What a control step gives: observations (n, 18), rewards (n,), which rows are lost (n,), |r - r_T| (n,) in m."""

    observation: Float32Array
    reward: FloatArray
    lost: BoolArray
    distance: FloatArray


class Fleet(ABC):
    """n vehicles in their first episodes; a row that is lost stays so.

    :param seeds: of the episodes, (n,).
    :param settings: how they fly; ``max_episode_steps`` has no meaning here.
    """

    def __init__(self, seeds: Sequence[int], settings: FlightSettings) -> None:
        self.n, self.seeds = len(seeds), seeds
        self.keywords = {key: value for key, value in settings.keywords().items() if key != "max_episode_steps"}
        self.collided = np.zeros(self.n, dtype=np.bool_)
        """Whether the last control step of each row ended on the ground, (n,)."""

    @property
    @abstractmethod
    def vehicle(self) -> Vehicle:
        """What flies."""

    @abstractmethod
    def reset(self, start: Mapping[str, FloatArray] | None = None) -> Float32Array:
        """Begin; observations (n, 18).

        :param start: what the episodes' own sample is replaced by: position, velocity, body_rates, target (n, 3) or
            quaternion (n, 4).
        """

    @abstractmethod
    def step(self, actions: Float32Array, flying: BoolArray) -> FleetStep:
        """One control step of the rows that are ``flying``; what comes back of the others has no meaning."""

    @abstractmethod
    def set_targets(self, rows: IntArray, targets: FloatArray) -> Float32Array:
        """Move the targets of some rows, (len(rows), 3); all observations with the new targets, (n, 18)."""

    @abstractmethod
    def set_wrench(self, wrench: FloatArray) -> None:
        """The wrench from now on, (n, WRENCH_SIZE), see :mod:`sb3_quad.simulation.state`."""

    @abstractmethod
    def true_state(self) -> QuadcopterState:
        """The true state of all rows, fresh or live."""

    def close(self) -> None:  # noqa: B027 - most hold nothing
        """Release the environments."""


class BatchFleet(Fleet):
    """All rows in one batched environment."""

    def __init__(self, seeds: Sequence[int], settings: FlightSettings) -> None:
        super().__init__(seeds, settings)
        self.batch = QuadcopterBatch(self.n, **self.keywords, max_episode_steps=2**62, autoreset=False)
        self.batch.seed(seeds)
        self.collided = self.batch.outcome["collision"]

    @property
    def vehicle(self) -> Vehicle:
        return self.batch.vehicle_list[0]

    def reset(self, start: Mapping[str, FloatArray] | None = None) -> Float32Array:
        observation = self.batch.reset()
        for name, values in (start or {}).items():
            self.batch.state[row_slices(STATE)[name]] = values.T
        return self.batch.observe() if start else observation

    def step(self, actions: Float32Array, flying: BoolArray) -> FleetStep:
        observation, rewards, _ = self.batch.step(actions)
        outcome = self.batch.outcome
        return FleetStep(observation, rewards.astype(np.float64), ~outcome["truncated"], outcome["distance"].copy())

    def set_targets(self, rows: IntArray, targets: FloatArray) -> Float32Array:
        self.batch.set_target(targets, rows)
        return self.batch.observe()

    def set_wrench(self, wrench: FloatArray) -> None:
        self.batch.wrench[:] = wrench.T

    def true_state(self) -> QuadcopterState:
        return self.batch.true_state()


class PyBulletFleet(Fleet):
    """A PyBullet environment per row, in turn; the controller still sees them as one batch."""

    def __init__(self, seeds: Sequence[int], settings: FlightSettings) -> None:
        super().__init__(seeds, settings)
        if self.n > MAX_CLIENTS:
            raise ConfigError(
                f"n_episodes {self.n}: PyBullet flies at most {MAX_CLIENTS} side by side; fly them in several parts"
            )
        self._envs = [QuadcopterEnv(**self.keywords) for _ in seeds]

    @property
    def vehicle(self) -> Vehicle:
        return self._envs[0].vehicle

    def reset(self, start: Mapping[str, FloatArray] | None = None) -> Float32Array:
        rows = []
        for k, env in enumerate(self._envs):
            options: dict[str, Any] = {"state": {name: values[k] for name, values in (start or {}).items()}}
            options["target"] = options["state"].pop("target", None)
            rows.append(env.reset(seed=self.seeds[k], options=options)[0])
        self._observation = np.stack(rows)
        return self._observation

    def step(self, actions: Float32Array, flying: BoolArray) -> FleetStep:
        observation = self._observation.copy()
        rewards, distance = np.zeros(self.n), np.full(self.n, np.nan)
        lost = np.zeros(self.n, dtype=np.bool_)
        for k in np.flatnonzero(flying):
            observation[k], rewards[k], lost[k], _, info = self._envs[k].step(actions[k])
            distance[k], self.collided[k] = info["distance"], info["collision"]
        self._observation = observation
        return FleetStep(observation, rewards, lost, distance)

    def set_targets(self, rows: IntArray, targets: FloatArray) -> Float32Array:
        self._observation = self._observation.copy()
        for row, target in zip(rows, targets, strict=True):
            self._envs[row].set_target(target)
            self._observation[row] = self._envs[row].observe()
        return self._observation

    def set_wrench(self, wrench: FloatArray) -> None:
        for env, values in zip(self._envs, wrench, strict=True):
            env.wrench[:] = values

    def true_state(self) -> QuadcopterState:
        return QuadcopterState.concatenate([env.true_state() for env in self._envs])

    def close(self) -> None:
        for env in self._envs:
            env.close()


FLEETS: Mapping[str, type[Fleet]] = {"batch": BatchFleet, "pybullet": PyBulletFleet}
