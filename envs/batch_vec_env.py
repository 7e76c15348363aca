"""``BatchVecEnv``: your own batched simulation as one Stable-Baselines3 environment."""

from functools import cached_property
from typing import Any

import numpy as np
from gymnasium.error import ResetNeeded
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from sb3_quad.base.errors import ConfigError, raised_as
from sb3_quad.base.types import AnyArray, IntArray, StrDict
from sb3_quad.envs.simulation.settings import ENDLESS


class BatchVecEnv(VecEnv):
    """Your own batch, whose n rows are stepped together, as an environment to train in.

    You write :meth:`begin` and :meth:`advance`, in NumPy, Numba, PyTorch or whatever is fast. This
    class begins the next episode of a row that ends within the same step, truncates episodes that
    are too long, and gives the infos that SB3 reads: ``terminal_observation``,
    ``TimeLimit.truncated`` and ``episode`` (``r``, ``l``). Observations are copied, so that your
    arrays may change in place.

    What the two methods return is checked: a wrong shape or a number that is not finite is a
    :class:`~sb3_quad.base.errors.ConfigError` that names the method.

    The constructor is that of SB3's ``VecEnv``: the number of rows, the observation space and the
    action space of one row. The observations are a Box.
    """

    render_mode = None
    #: Steps after which an episode is truncated; set your own.
    max_episode_steps = ENDLESS
    _lengths: IntArray | None = None

    @cached_property
    def rng(self) -> np.random.Generator:
        """Random numbers for your episodes, which :meth:`seed` seeds."""
        return np.random.default_rng()

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
        refuse_options(self)
        self._returns = np.zeros(self.num_envs)
        self._lengths = np.zeros(self.num_envs, np.int64)
        return self._begin(np.arange(self.num_envs))

    def _begin(self, rows: IntArray) -> AnyArray:
        """Begin new episodes and return their observations, checked (k, ...)."""
        return self._observations("begin", self.begin(rows), len(rows))

    def _observations(self, method: str, values: Any, n: int) -> AnyArray:
        space = self.observation_space
        shape = (n, *(space.shape or ()))
        return _checked(f"{method}: observations", values, shape, space.dtype)

    def step_async(self, actions: AnyArray) -> None:
        """Keep the actions, (n, ...), for ``step_wait``."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Step all rows; return observations (n, ...), rewards (n,), done (n,), infos."""
        if self._lengths is None:
            raise ResetNeeded("call reset() before step()")
        results = self.advance(self._actions)
        with raised_as(ConfigError, "advance: must return observations, rewards and terminated"):
            seen, gained, failed = results
        n = self.num_envs
        observations = self._observations("advance", seen, n)
        rewards = _checked("advance: rewards", gained, (n,), np.float32)
        terminated = _checked("advance: terminated", failed, (n,), np.bool_)
        self._returns += rewards
        self._lengths += 1
        dones = terminated | (self._lengths >= self.max_episode_steps)
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
            observations[ended] = self._begin(ended)
        return observations, rewards, dones, infos

    def close(self) -> None:
        """Do nothing: there is nothing to close."""

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of this environment, once for each of the given rows."""
        return [getattr(self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, *args: Any, **kwargs: Any) -> Any:
        """Refuse; override it if your rows have attributes of their own."""
        raise NotImplementedError("rows have no attributes and methods of their own")

    env_method: Any = set_attr

    def env_is_wrapped(self, wrapper_class: Any, indices: VecEnvIndices = None) -> list[bool]:
        """Return True for SB3's ``Monitor`` only, since infos have its ``episode``."""
        return [wrapper_class is Monitor for _ in self._get_indices(indices)]


def refuse_options(env: VecEnv) -> None:
    """Refuse reset options, which SB3 sets by a separate method before the reset."""
    if any(env._options):
        env._reset_options()
        raise ConfigError(
            "reset options: a batched environment takes none; "
            "set things after reset(), by methods such as set_target"
        )


def _checked(what: str, values: Any, shape: tuple[int, ...], dtype: Any) -> AnyArray:
    """Return a method's result as an array of its own.

    :param what: the method and what it returns, for the message.
    :raises ConfigError: another shape, or numbers that are not finite.
    """
    with raised_as(ConfigError, f"{what} are not numeric"):
        given = np.asarray(values)
        # A cast to integers or booleans hides numbers that are not finite or do not fit.
        with np.errstate(invalid="ignore"):
            array = given.astype(dtype)
    # None, from a method without a return, would become a number of shape ().
    if values is None:
        raise ConfigError(f"{what}: None; return an array of shape {shape}")
    if array.shape != shape:
        raise ConfigError(f"{what} of shape {array.shape}: must be of shape {shape}")
    if np.issubdtype(array.dtype, np.floating):
        unfit = ~np.isfinite(array)
        reason = "a number that is not finite"
    else:
        unfit = array != given
        reason = f"a number that is not a valid {array.dtype}"
    if unfit.any():
        row = np.argwhere(unfit)[0, 0]
        raise ConfigError(f"{what}: row {row} has {reason}")
    return array
