"""``QuadcopterVecEnv``: n quadcopters as one Stable-Baselines3 vectorised environment."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import Env, Wrapper, spaces
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn
from typing_extensions import Unpack

from sb3_quad.base.errors import ConfigError
from sb3_quad.simulation.batch import BatchKeywords, QuadcopterBatch
from sb3_quad.simulation.observation import OBSERVATION_SIZE
from sb3_quad.simulation.state import QuadcopterState
from sb3_quad.simulation.tasks import TaskSpec
from sb3_quad.vehicles.vehicle import Vehicle

_SETTERS = ("target", "noise", "observation_mean", "observation_std", "max_episode_steps")
_METHODS = ("set_target", "set_wrench", "set_noise", "set_observation_scaling", "set_task")


class QuadcopterVecEnv(VecEnv):
    """n quadcopters stepped together by compiled code; the flight is PyBullet's to 1e-9.

    The learning problem, the arguments and the setters are those of :class:`~sb3_quad.envs.quadcopter_env.QuadcopterEnv`;
    row i flies exactly as that environment does after ``reset(seed=seed + i)``. A row that ends begins its next episode
    within the same step, and its info then holds ``terminal_observation``, ``TimeLimit.truncated``, ``episode`` (``r``,
    ``l``, ``t`` as of SB3's Monitor), ``is_success``, ``distance``, ``collision`` and ``out_of_range``. The infos of other
    rows are empty. The list of infos is the environment's own and changes with the next step; the arrays are fresh.

    See :class:`~sb3_quad.simulation.batch.QuadcopterBatch` for the arguments.
    """

    def __init__(
        self,
        n_envs: int,
        task: TaskSpec = "target_tracking",
        task_kwargs: Mapping[str, Any] | None = None,
        **keywords: Unpack[BatchKeywords],
    ) -> None:
        self.batch = QuadcopterBatch(n_envs, task, task_kwargs, **keywords)
        self.render_mode: str | None = None
        self.spec = None
        self._infos: list[dict[str, Any]] = [{} for _ in range(self.batch.n)]
        self._ended: list[int] = []
        self._actions: npt.NDArray[Any] = np.zeros((self.batch.n, 4), dtype=np.float32)
        self._start = time.time()
        super().__init__(
            self.batch.n,
            spaces.Box(-np.inf, np.inf, (OBSERVATION_SIZE,), np.float32),
            spaces.Box(-1.0, 1.0, (4,), np.float32),
        )

    def reset(self) -> VecEnvObs:
        """Begin a new episode in every row; observations float32 (n, 18)."""
        if any(seed is not None for seed in self._seeds):
            self.batch.seed(self._seeds)
        given = any(self._options)
        self._reset_seeds()
        self._reset_options()
        if given:
            raise ConfigError("reset options: the batched environment takes none; call set_target and its like after reset()")
        self.reset_infos = [{} for _ in range(self.num_envs)]
        return self.batch.reset()

    def step_async(self, actions: npt.NDArray[Any]) -> None:
        """Keep the actions, (n, 4), for :meth:`step_wait`."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Fly one control step: observations (n, 18), rewards (n,), done (n,), infos."""
        for row in self._ended:
            self._infos[row] = {}
        observations, rewards, dones = self.batch.step(self._actions)
        rows = np.flatnonzero(dones)
        self._ended = rows.tolist()
        if self._ended:
            self._fill_infos(rows)
        return observations, rewards, dones, self._infos

    def _fill_infos(self, rows: npt.NDArray[np.int64]) -> None:
        elapsed = round(time.time() - self._start, 6)
        outcomes = self.batch.outcome[rows].tolist()  # of a copy, so that the last observations are fresh
        for row, (total, _, length, distance, collision, out_of_range, truncated, observation) in zip(
            self._ended, outcomes, strict=True
        ):
            self._infos[row] = {
                "terminal_observation": observation,
                "TimeLimit.truncated": truncated,
                "episode": {"r": round(total, 6), "l": length, "t": elapsed},
                "is_success": truncated,
                "distance": distance,
                "collision": collision,
                "out_of_range": out_of_range,
            }

    def close(self) -> None:
        """Nothing to close; calling it twice is fine."""

    def true_state(self) -> QuadcopterState:
        """The true state of all rows, a live view."""
        return self.batch.true_state()

    @property
    def vehicle(self) -> Vehicle:
        """The vehicle of row 0 (of all rows, unless a sequence was given)."""
        return self.batch.vehicle_list[0]

    @property
    def target(self) -> npt.NDArray[np.float64]:
        """Targets, (n, 3), world frame, m."""
        return self.true_state().target.copy()

    @property
    def noise(self) -> npt.NDArray[np.float64]:
        """Observation noise levels, (n,)."""
        return np.broadcast_to(self.batch.noise_level, (self.num_envs,)).copy()

    @property
    def observation_mean(self) -> npt.NDArray[np.float64]:
        """μ of Eq. 3.16, (n, 18)."""
        return np.broadcast_to(self.batch.mean.T, (self.num_envs, OBSERVATION_SIZE)).copy()

    @property
    def observation_std(self) -> npt.NDArray[np.float64]:
        """σ of Eq. 3.16, (n, 18)."""
        return np.broadcast_to(self.batch.std.T, (self.num_envs, OBSERVATION_SIZE)).copy()

    @property
    def max_episode_steps(self) -> int:
        """Control steps after which an episode is truncated."""
        return self.batch.max_episode_steps

    def set_target(self, position: Any, indices: VecEnvIndices = None) -> None:
        """Targets, (3,) for all of the rows or (rows, 3), world frame, m; until a row's next reset."""
        self.batch.set_target(position, indices)

    def set_wrench(
        self,
        force: Any = (0.0, 0.0, 0.0),
        torque: Any = (0.0, 0.0, 0.0),
        force_frame: str = "world",
        torque_frame: str = "body",
        indices: VecEnvIndices = None,
    ) -> None:
        """External force (N) and torque (N m) at the centre of mass, (3,) or (rows, 3); until set anew."""
        self.batch.set_wrench(force, torque, force_frame, torque_frame, indices)

    def set_noise(self, level: Any, indices: VecEnvIndices = None) -> None:
        """Relative standard deviation of the observation noise, () or (rows,)."""
        self.batch.set_noise(level, indices)

    def set_observation_scaling(self, mean: Any = None, std: Any = None, indices: VecEnvIndices = None) -> None:
        """μ and σ of Eq. 3.16, (18,) or (rows, 18) each; None leaves one as it is."""
        self.batch.set_observation_scaling(mean, std, indices)

    def set_task(self, task: TaskSpec, task_kwargs: Mapping[str, Any] | None = None, indices: VecEnvIndices = None) -> None:
        """The task of all episodes that begin from now on, in every row."""
        if indices is not None and set(self._get_indices(indices)) != set(range(self.num_envs)):
            raise ConfigError(
                "set_task: holds for all rows; give a mixture such as {'target_tracking': 1, 'state_recovery': 1}"
            )
        self.batch.set_task(task, task_kwargs)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """One value per requested row."""
        rows = self.batch.rows(indices)
        if attr_name == "vehicle":
            return [self.batch.vehicle_list[row] for row in rows]
        value = getattr(self, attr_name)
        per_row = attr_name in ("target", "noise", "observation_mean", "observation_std")
        return [value[row] if per_row else value for row in rows]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set ``target``, ``noise``, ``observation_mean``, ``observation_std`` of rows, or ``max_episode_steps`` of all."""
        if attr_name == "target":
            self.set_target(value, indices)
        elif attr_name == "noise":
            self.set_noise(value, indices)
        elif attr_name == "observation_mean":
            self.set_observation_scaling(mean=value, indices=indices)
        elif attr_name == "observation_std":
            self.set_observation_scaling(std=value, indices=indices)
        elif attr_name == "max_episode_steps":
            self.batch.set_max_episode_steps(value)
        else:
            raise AttributeError(f"{attr_name!r} cannot be set; these can: {', '.join(_SETTERS)}")

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method for the given rows; one result per row."""
        rows = self.batch.rows(indices)
        if method_name == "true_state":
            return [QuadcopterState(self.batch.state[:, row : row + 1]) for row in rows]
        if method_name in _METHODS:
            getattr(self, method_name)(*method_args, indices=indices, **method_kwargs)
        else:
            raise AttributeError(f"no method {method_name!r} of rows; there are: true_state, {', '.join(_METHODS)}")
        return [None] * rows.size

    def env_is_wrapped(self, wrapper_class: type[Wrapper[Any, Any, Any, Any]], indices: VecEnvIndices = None) -> list[bool]:
        """False for every row: rows are not Gymnasium environments."""
        return [False] * self.batch.rows(indices).size

    def get_images(self) -> Sequence[npt.NDArray[np.uint8] | None]:
        """No images: fly a :class:`~sb3_quad.envs.quadcopter_env.QuadcopterEnv` to see a flight."""
        return [None] * self.num_envs

    def _get_target_envs(self, indices: VecEnvIndices) -> Iterable[Env[Any, Any]]:
        raise ConfigError("a batched environment has no single environments; use get_attr, set_attr and env_method")
