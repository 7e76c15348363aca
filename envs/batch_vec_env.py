"""``BatchVecEnv``: anybody's own compiled batch as one Stable-Baselines3 environment."""

from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from sb3_quad.base.types import AnyArray, IntArray, StrDict
from sb3_quad.simulation.settings import ENDLESS


class BatchVecEnv(VecEnv):
    """Your own batch, whose n rows are stepped together, as an environment to train in.

    You write :meth:`begin` and :meth:`advance`, in NumPy, Numba, PyTorch or whatever is fast. This
    class begins the next episode of a row that ends within the same step, truncates episodes that
    are too long, and gives the infos that SB3 reads: ``terminal_observation``,
    ``TimeLimit.truncated`` and ``episode`` (``r``, ``l``). Observations are copied, so that your
    arrays may change in place.

    The constructor is that of SB3's ``VecEnv``: the number of rows, the observation space and the
    action space of one row. The observations are a Box.
    """

    render_mode = None
    #: Steps after which an episode is truncated; set your own.
    max_episode_steps = ENDLESS
    #: Random numbers for your episodes, which :meth:`seed` seeds.
    rng: np.random.Generator

    def __init__(
        self,
        num_envs: int,
        observation_space: "spaces.Space[Any]",
        action_space: "spaces.Space[Any]",
    ) -> None:
        super().__init__(num_envs, observation_space, action_space)
        self.rng = np.random.default_rng()

    def begin(self, rows: IntArray) -> Any:
        """Begin a new episode in the given rows (k,); return their observations (k, ...)."""
        raise NotImplementedError

    def advance(self, actions: AnyArray) -> Any:
        """Step all rows by their actions (n, ...).

        :return: observations (n, ...); rewards (n,); and which rows have terminated, bool (n,),
            because they have failed or arrived.
        """
        raise NotImplementedError

    def seed(self, seed: int | None = None) -> list[int | None]:
        """Seed ``rng``; None: by a random number."""
        self.rng = np.random.default_rng(seed)
        return [seed] * self.num_envs

    def reset(self) -> VecEnvObs:
        """Begin a new episode in every row; return the observations (n, ...)."""
        self._returns = np.zeros(self.num_envs)
        self._lengths = np.zeros(self.num_envs, np.int64)
        return np.array(self.begin(np.arange(self.num_envs)), self.observation_space.dtype)

    def step_async(self, actions: AnyArray) -> None:
        """Keep the actions, (n, ...), for ``step_wait``."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Step all rows; return observations (n, ...), rewards (n,), done (n,), infos."""
        seen, gained, failed = self.advance(self._actions)
        observations = np.array(seen, self.observation_space.dtype)
        rewards = np.array(gained, np.float32)
        terminated = np.array(failed, np.bool_)
        # In place, where NumPy refuses arrays (n, 1).
        self._returns += rewards
        self._lengths += 1
        dones = self._lengths >= self.max_episode_steps
        dones |= terminated
        infos: list[StrDict] = [{} for _ in dones]
        ended = np.flatnonzero(dones)
        for row in ended:
            infos[row] = {
                "terminal_observation": observations[row].copy(),
                "TimeLimit.truncated": not terminated[row],
                "episode": {"r": self._returns[row], "l": self._lengths[row]},
            }
        if ended.size:
            self._returns[ended] = 0.0
            self._lengths[ended] = 0
            observations[ended] = self.begin(ended)
        return observations, rewards, dones, infos

    def close(self) -> None:
        """Do nothing: there is nothing to close."""

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of this environment, once for each of the given rows."""
        return [getattr(self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, *args: Any, **kwargs: Any) -> Any:
        """Refuse; override it where your rows have attributes of their own."""
        raise NotImplementedError("rows have no attributes and methods of their own")

    env_method: Any = set_attr

    def env_is_wrapped(self, wrapper_class: Any, indices: VecEnvIndices = None) -> list[bool]:
        """Return True for SB3's ``Monitor`` only, since the rows give its ``info["episode"]``."""
        return [wrapper_class is Monitor for _ in self._get_indices(indices)]
