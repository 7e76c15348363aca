"""The vectorised environment of a job: batched, one process, or one process each; the same learning problem in all."""

from functools import partial
from typing import Any

import gymnasium
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

import sb3_quad  # noqa: F401  (registers the environments, also in a worker process)
from sb3_quad.base.errors import ConfigError, SB3QuadError, TrainingError
from sb3_quad.base.signals import ignore_interrupts
from sb3_quad.envs.vec_env import QuadcopterVecEnv, RowSeeds
from sb3_quad.training.config import TrainingConfig
from sb3_quad.training.values import instance

WORKER_ENDED = (
    "a worker process of the environments ended (its error, if it had time for one, is above; else out of memory?);"
    " vec_env dummy needs none"
)


class _Dummy(RowSeeds, DummyVecEnv):
    pass


class _Subproc(RowSeeds, SubprocVecEnv):
    """SB3's ``close`` waits forever for the answer of a worker process that has ended; this one ends the others."""

    def close(self) -> None:
        if not self.closed and (self.waiting or not all(process.is_alive() for process in self.processes)):
            for process in self.processes:
                process.terminate()
                process.join()
            for remote in self.remotes:
                remote.close()
            self.closed = True
        super().close()


def make_environments(config: TrainingConfig, n_envs: int, seed: int, staggered: bool = False) -> VecEnv:
    """``n_envs`` environments as the settings describe them; their rows fly by ``row_seeds`` of ``seed``.

    Each gives ``info["episode"]`` where an episode ends, as SB3's Monitor does.

    :param staggered: whether the first episodes end at different times, as of :class:`QuadcopterVecEnv`.
    :raises ConfigError: keywords that the environment does not take.
    :raises TrainingError: a worker process that ended.
    """
    env: VecEnv
    try:
        if config.vec_env == "batch":
            if config.env_wrapper:
                raise ConfigError("env_wrapper: the batched environment has no single environments to wrap; use vec_env dummy")
            env = QuadcopterVecEnv(n_envs, seed=seed, staggered=staggered, **{"task": config.task, **config.env_kwargs})
        else:
            in_worker = config.vec_env == "subproc"
            keywords = [_of_row(config.env_kwargs, row) for row in range(n_envs)]
            rows = range(n_envs) if staggered else [0] * n_envs
            make = partial(_make_one, config.env_id, config.env_wrapper, in_worker, n_envs)
            env = (_Subproc if in_worker else _Dummy)([partial(make, *each) for each in zip(keywords, rows, strict=True)])
            env.seed(seed)
    except SB3QuadError:
        raise
    except (EOFError, ConnectionError):
        raise TrainingError(WORKER_ENDED) from None
    except (TypeError, ValueError, AssertionError) as error:
        raise ConfigError(f"{config.env_id}: cannot be made with env_kwargs {config.env_kwargs} ({error})") from error
    for path, kwargs in config.vec_env_wrapper:
        env = instance(path, "vec_env_wrapper", env, **kwargs)
    return env


def _of_row(env_kwargs: dict[str, Any], row: int) -> dict[str, Any]:
    """The keywords of one row, where lists are counted round."""
    lists = {name: env_kwargs.get(name) for name in ("vehicle", "max_episode_steps")}
    own = {name: given[row % len(given)] for name, given in lists.items() if isinstance(given, (list, tuple)) and given}
    return {**env_kwargs, **own}


def _make_one(
    env_id: str, wrappers: list[tuple[str, dict[str, Any]]], in_worker: bool, n_envs: int, kwargs: dict[str, Any], row: int
) -> gymnasium.Env[Any, Any]:
    if in_worker:
        ignore_interrupts()
    made = gymnasium.make(env_id, **kwargs)
    limit = (made.spec and made.spec.max_episode_steps) or 0
    env: gymnasium.Env[Any, Any] = Monitor(_FirstEpisode(made, limit - row * limit // n_envs) if row and limit else made)
    for path, wrapper_kwargs in wrappers:
        env = instance(path, "env_wrapper", env, **wrapper_kwargs)
    return env


class _FirstEpisode(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Truncates the first episode after so many steps."""

    def __init__(self, env: gymnasium.Env[Any, Any], steps: int) -> None:
        super().__init__(env)
        self._left = steps

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._left -= 1
        truncated = truncated or self._left == 0
        if terminated or truncated:
            self._left = 0
        return observation, reward, terminated, truncated, info
