"""The same n episodes in either environment, side by side in one process, for :mod:`sb3_quad.evaluation.flights`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from sb3_quad.base.errors import ConfigError
from sb3_quad.simulation.state import BODY_RATES, POSITION, QUATERNION, TARGET, VELOCITY, QuadcopterState
from sb3_quad.vehicles.vehicle import Vehicle, load_vehicle

MAX_CLIENTS = 512  # PyBullet allows about 1000 physics clients in a process
Observation = npt.NDArray[np.float32]
FloatArray = npt.NDArray[np.float64]
Step = tuple[Observation, FloatArray, npt.NDArray[np.bool_], FloatArray]
STATE_ROWS = {"position": POSITION, "quaternion": QUATERNION, "velocity": VELOCITY, "body_rates": BODY_RATES, "target": TARGET}


class Fleet(ABC):
    """n vehicles in their first episodes, row k seeded with ``seeds[k]``."""

    n: int
    control_step: float  # s

    @abstractmethod
    def reset(self, start: Mapping[str, FloatArray] | None = None) -> Observation:
        """Begin; observations (n, 18).

        :param start: what the episodes' own draw is replaced by: any of ``STATE_ROWS``, (n, 3), quaternions (n, 4).
        """

    @abstractmethod
    def step(self, actions: npt.NDArray[np.float32], flying: npt.NDArray[np.bool_]) -> Step:
        """One control step of the rows that are ``flying``; what comes back of the others has no meaning.

        :return: observations (n, 18); rewards (n,); terminated (n,); |r - r_T| at the end of the step (n,), m.
        """

    @abstractmethod
    def retarget(self, rows: npt.NDArray[np.int64], targets: FloatArray) -> Observation:
        """Move the targets of some rows, (len(rows), 3); all observations with the new targets, (n, 18)."""

    @abstractmethod
    def set_wrench(self, wrench: FloatArray) -> None:
        """Forces (N) and torques (N m) from now on, (n, 12): force world, force body, torque world, torque body."""

    @abstractmethod
    def true_state(self) -> QuadcopterState:
        """The true state of all rows, fresh or live."""

    @property
    @abstractmethod
    def collided(self) -> npt.NDArray[np.bool_]:
        """Whether the last episode of each row that ended did so on the ground, (n,)."""

    @abstractmethod
    def close(self) -> None:
        """Release the environments."""


class BatchFleet(Fleet):
    """All rows in one batched environment."""

    def __init__(
        self,
        seeds: Sequence[int],
        task: Any,
        task_kwargs: Mapping[str, Any] | None,
        vehicle: str | Vehicle,
        noise: float,
        max_steps: int,
        observation_std: npt.ArrayLike | None = None,
    ) -> None:
        from sb3_quad.envs.vec_env import QuadcopterVecEnv

        self.n = len(seeds)
        # One step longer than is flown, so that the time limit never hides the last state behind a reset.
        self._env = QuadcopterVecEnv(
            self.n,
            task=task,
            task_kwargs=task_kwargs,
            vehicle=vehicle,
            noise=noise,
            observation_std=observation_std,
            max_episode_steps=max_steps + 1,
        )
        self._env.batch.seed(seeds)
        self.control_step = self._env.vehicle.control_step

    def reset(self, start: Mapping[str, FloatArray] | None = None) -> Observation:
        observation = np.asarray(self._env.reset(), dtype=np.float32)
        if not start:
            return observation
        for name, values in start.items():
            self._env.true_state().array[STATE_ROWS[name]] = values.T
        return self._env.batch.observe()

    def step(self, actions: npt.NDArray[np.float32], flying: npt.NDArray[np.bool_]) -> Step:
        observation, rewards, terminated, infos = self._env.step(actions)
        error = self._env.true_state().distance
        for row in np.flatnonzero(terminated):
            error[row] = infos[row]["distance"]
        return np.asarray(observation, dtype=np.float32), np.asarray(rewards, dtype=np.float64), terminated, error

    def retarget(self, rows: npt.NDArray[np.int64], targets: FloatArray) -> Observation:
        self._env.set_target(targets, rows)
        return self._env.batch.observe()

    def set_wrench(self, wrench: FloatArray) -> None:
        self._env.batch.wrench[:] = wrench.T

    def true_state(self) -> QuadcopterState:
        return self._env.true_state()

    @property
    def collided(self) -> npt.NDArray[np.bool_]:
        return self._env.batch.collided

    def close(self) -> None:
        self._env.close()


class PyBulletFleet(Fleet):
    """A PyBullet environment per row, in turn; the controller still sees them as one batch."""

    def __init__(
        self,
        seeds: Sequence[int],
        task: Any,
        task_kwargs: Mapping[str, Any] | None,
        vehicle: str | Vehicle,
        noise: float,
        max_steps: int,
        observation_std: npt.ArrayLike | None = None,
    ) -> None:
        from sb3_quad.envs.quadcopter_env import QuadcopterEnv

        self.n, self._seeds = len(seeds), seeds
        if self.n > MAX_CLIENTS:
            raise ConfigError(
                f"n_episodes {self.n}: PyBullet flies at most {MAX_CLIENTS} side by side; fly them in several parts"
            )
        keywords: dict[str, Any] = {"task": task, "task_kwargs": task_kwargs, "vehicle": vehicle, "noise": noise}
        self._envs = [QuadcopterEnv(**keywords, observation_std=observation_std) for _ in seeds]
        self.control_step = load_vehicle(vehicle).control_step

    def reset(self, start: Mapping[str, FloatArray] | None = None) -> Observation:
        rows = []
        for k, env in enumerate(self._envs):
            options: dict[str, Any] = {"state": {name: values[k] for name, values in (start or {}).items()}}
            options["target"] = options["state"].pop("target", None)
            rows.append(env.reset(seed=self._seeds[k], options=options)[0])
        self._observation = np.stack(rows)
        self._collided = np.zeros(self.n, dtype=np.bool_)
        return self._observation

    def step(self, actions: npt.NDArray[np.float32], flying: npt.NDArray[np.bool_]) -> Step:
        observation = self._observation.copy()
        rewards, error = np.zeros(self.n), np.full(self.n, np.nan)
        terminated = np.zeros(self.n, dtype=np.bool_)
        for k in np.flatnonzero(flying):
            observation[k], rewards[k], terminated[k], _, info = self._envs[k].step(actions[k])
            error[k], self._collided[k] = info["distance"], info["collision"]
        self._observation = observation
        return observation, rewards, terminated, error

    def retarget(self, rows: npt.NDArray[np.int64], targets: FloatArray) -> Observation:
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

    @property
    def collided(self) -> npt.NDArray[np.bool_]:
        return self._collided

    def close(self) -> None:
        for env in self._envs:
            env.close()


FLEETS: Mapping[str, type[BatchFleet] | type[PyBulletFleet]] = {"batch": BatchFleet, "pybullet": PyBulletFleet}
