"""The vectorised environment of a job: batched, one process, or one process each; the same learning
problem in all.
"""

import importlib
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium
from gymnasium.wrappers import TimeLimit
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

import sb3_quad  # noqa: F401  (registers the environments, also in a worker process)
from sb3_quad.base.errors import ConfigError, SB3QuadError, TrainingError
from sb3_quad.base.process import ignore_interrupts
from sb3_quad.envs.vec_env import QuadcopterVecEnv, RowSeeds
from sb3_quad.simulation.settings import ENDLESS
from sb3_quad.training.config import TrainingConfig
from sb3_quad.training.values import instance

WORKER_ENDED = (
    "a worker process of the environments ended (its error, if it had time for one, is above; else out of memory?);"
    " vec_env dummy needs none"
)


class _Dummy(RowSeeds, DummyVecEnv):
    pass


class _Subproc(RowSeeds, SubprocVecEnv):
    """SB3's ``close`` waits forever for the answer of a worker process that has ended; this one
    ends the others.
    """

    def close(self) -> None:
        if not self.closed and (
            self.waiting or not all(process.is_alive() for process in self.processes)
        ):
            for process in self.processes:
                process.terminate()
                process.join()
            for remote in self.remotes:
                remote.close()
            self.closed = True
        super().close()


def make_environments(
    config: TrainingConfig, n_envs: int, seed: int, staggered: bool = False
) -> VecEnv:
    """``n_envs`` environments as the settings describe them; their rows fly by ``row_seeds`` of
    ``seed``.

    Each gives ``info["episode"]`` where an episode ends, as SB3's Monitor does.

    :param staggered: whether the first episodes end at different times, as of
        :class:`QuadcopterVecEnv`.
    :raises ConfigError: keywords that the environment does not take.
    :raises TrainingError: a worker process that ended.
    """
    env: VecEnv
    try:
        if config.vec_env == "batch":
            if config.env_wrapper:
                raise ConfigError(
                    "env_wrapper: the batched environment has no single environments to wrap; use vec_env dummy"
                )
            env = QuadcopterVecEnv(
                n_envs, seed=seed, staggered=staggered, **{"task": config.task, **config.env_kwargs}
            )
        else:
            if (
                config.task is not None
            ):  # here, where a worker process could not say what is missing
                importlib.import_module("sb3_quad.base.bullet")
            makers: list[Callable[[], gymnasium.Env[Any, Any]]] = [
                partial(_make_one, config, row, n_envs if staggered else 1) for row in range(n_envs)
            ]
            env = _Subproc(makers) if config.vec_env == "subproc" else _Dummy(makers)
            env.seed(seed)
    except SB3QuadError:
        raise
    except (EOFError, ConnectionError):
        raise TrainingError(WORKER_ENDED) from None
    except (TypeError, ValueError, AssertionError) as error:
        raise ConfigError(
            f"{config.env_id}: cannot be made with env_kwargs {config.env_kwargs} ({error})"
        ) from error
    for path, kwargs in config.vec_env_wrapper:
        env = instance(path, "vec_env_wrapper", env, **kwargs)
    return env


def _make_one(config: TrainingConfig, row: int, phases: int) -> gymnasium.Env[Any, Any]:
    """The environment of a row; where keywords are lists of what rows fly, they are counted round.

    :param phases: of this many, evenly spread over an episode, the row begins in its own.
    """
    if config.vec_env == "subproc":
        ignore_interrupts()
    kwargs = dict(config.env_kwargs)
    for name in ("vehicle", "max_episode_steps"):
        if isinstance(given := kwargs.get(name), (list, tuple)) and given:
            kwargs[name] = given[row % len(given)]
    env: gymnasium.Env[Any, Any] = gymnasium.make(config.env_id, **kwargs)
    limit = env.spec and env.spec.max_episode_steps
    if limit and row % phases:
        env = _FirstEpisode(env, limit - row * limit // phases)
    env = Monitor(env)
    for path, wrapper_kwargs in config.env_wrapper:
        env = instance(path, "env_wrapper", env, **wrapper_kwargs)
    return env


class _FirstEpisode(TimeLimit):
    """Truncates the first episode after so many steps, and no other."""

    def reset(self, **kwargs: Any) -> Any:
        elapsed: Any = self._elapsed_steps
        if elapsed:
            self._max_episode_steps = ENDLESS
        return super().reset(**kwargs)
