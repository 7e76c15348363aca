"""The same n episodes in either environment, side by side in one process, for :func:`sb3_quad.evaluation.flights.fly`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from sb3_quad.dynamics.state import QuadcopterState
from sb3_quad.dynamics.vehicle import Vehicle, load_vehicle
from sb3_quad.errors import ConfigError

MAX_CLIENTS = 512  # PyBullet allows about 1000 physics clients in a process
Observation = npt.NDArray[np.float32]
FloatArray = npt.NDArray[np.float64]
Step = tuple[Observation, FloatArray, npt.NDArray[np.bool_], FloatArray]


class Fleet(ABC):
    """n vehicles in their first episodes, row k seeded with ``seed + k``."""

    n: int
    control_step: float  # s

    @abstractmethod
    def reset(self) -> Observation:
        """Begin; observations (n, 18)."""

    @abstractmethod
    def step(self, actions: npt.NDArray[np.float32], flying: npt.NDArray[np.bool_]) -> Step:
        """One control step of the rows that are ``flying``; what comes back of the others has no meaning.

        :return: observations (n, 18); rewards (n,); terminated (n,); |r - r_T| at the end of the step (n,), m.
        """

    @abstractmethod
    def true_state(self) -> QuadcopterState:
        """The true state of all rows, fresh or live."""

    @abstractmethod
    def close(self) -> None:
        """Release the environments."""


class BatchFleet(Fleet):
    """All rows in one batched environment."""

    def __init__(
        self,
        n: int,
        task: Any,
        task_kwargs: Mapping[str, Any] | None,
        vehicle: str | Vehicle,
        noise: float,
        seed: int,
        max_steps: int,
    ) -> None:
        from sb3_quad.envs.vec_env import QuadcopterVecEnv

        # One step longer than is flown, so that the time limit never hides the last state behind a reset.
        self._env = QuadcopterVecEnv(
            n, task=task, task_kwargs=task_kwargs, vehicle=vehicle, noise=noise, seed=seed, max_episode_steps=max_steps + 1
        )
        self.n = n
        self.control_step = self._env.vehicle.control_step

    def reset(self) -> Observation:
        return np.asarray(self._env.reset(), dtype=np.float32)

    def step(self, actions: npt.NDArray[np.float32], flying: npt.NDArray[np.bool_]) -> Step:
        observation, rewards, terminated, infos = self._env.step(actions)
        error = self._env.true_state().distance
        for row in np.flatnonzero(terminated):
            error[row] = infos[row]["distance"]
        return np.asarray(observation, dtype=np.float32), np.asarray(rewards, dtype=np.float64), terminated, error

    def true_state(self) -> QuadcopterState:
        return self._env.true_state()

    def close(self) -> None:
        self._env.close()


class PyBulletFleet(Fleet):
    """A PyBullet environment per row, in turn; the controller still sees them as one batch."""

    def __init__(
        self,
        n: int,
        task: Any,
        task_kwargs: Mapping[str, Any] | None,
        vehicle: str | Vehicle,
        noise: float,
        seed: int,
        max_steps: int,
    ) -> None:
        from sb3_quad.envs.quadcopter_env import QuadcopterEnv

        if n > MAX_CLIENTS:
            raise ConfigError(f"n_episodes {n}: PyBullet flies at most {MAX_CLIENTS} side by side; fly them in several parts")
        self._envs = [QuadcopterEnv(task=task, task_kwargs=task_kwargs, vehicle=vehicle, noise=noise) for _ in range(n)]
        self.n = n
        self._seed = seed
        self.control_step = load_vehicle(vehicle).control_step

    def reset(self) -> Observation:
        self._observation = np.stack([env.reset(seed=self._seed + k)[0] for k, env in enumerate(self._envs)])
        return self._observation

    def step(self, actions: npt.NDArray[np.float32], flying: npt.NDArray[np.bool_]) -> Step:
        observation = self._observation.copy()
        rewards, error = np.zeros(self.n), np.full(self.n, np.nan)
        terminated = np.zeros(self.n, dtype=np.bool_)
        for k in np.flatnonzero(flying):
            observation[k], rewards[k], terminated[k], _, info = self._envs[k].step(actions[k])
            error[k] = info["distance"]
        self._observation = observation
        return observation, rewards, terminated, error

    def true_state(self) -> QuadcopterState:
        return QuadcopterState.concatenate([env.true_state() for env in self._envs])

    def close(self) -> None:
        for env in self._envs:
            env.close()


FLEETS = {"batch": BatchFleet, "pybullet": PyBulletFleet}
