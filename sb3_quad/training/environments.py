"""The vectorised environment of a job: batched, in one process, or in one process each.

The learning problem is the same in all of them.
"""

from functools import partial
from typing import Any

import gymnasium
from gymnasium.wrappers import TimeLimit
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from sb3_quad.base.errors import ConfigError, SB3QuadError, TrainingError
from sb3_quad.base.process import ignore_interrupts
from sb3_quad.envs.simulation.settings import ENDLESS
from sb3_quad.envs.vec_env import QuadcopterVecEnv, RowSeeds
from sb3_quad.training.algorithms import as_list, instance
from sb3_quad.training.config import TrainingConfig

Env = gymnasium.Env[Any, Any]
WORKER_ENDED = (
    "a worker process of the environments ended (its error, if it had time for one, is above; "
    "otherwise, out of memory?); vec_env dummy needs no worker processes"
)


class _Dummy(RowSeeds, DummyVecEnv):
    pass


class _Subproc(RowSeeds, SubprocVecEnv):
    """Ends its worker processes even if one of them has already ended.

    SB3's ``close`` would wait forever for that one to answer.
    """

    def close(self) -> None:
        all_alive = all(process.is_alive() for process in self.processes)
        if not self.closed and (self.waiting or not all_alive):
            for process in self.processes:
                process.terminate()
                process.join()
            for remote in self.remotes:
                remote.close()
            self.closed = True
        super().close()


SINGLE = {"dummy": _Dummy, "subproc": _Subproc}


def make_environments(
    config: TrainingConfig, n_envs: int, seed: int, staggered: bool = False
) -> VecEnv:
    """Make ``n_envs`` environments; their rows use ``row_seeds`` of ``seed``.

    When an episode ends, its info has ``"episode"``, as with SB3's Monitor.

    :param staggered: whether the first episodes end at different times, as those of
        :class:`QuadcopterVecEnv` do.
    :raises ConfigError: keywords that the environment does not take.
    :raises TrainingError: a worker process that ended.
    """
    env: Any
    try:
        if config.vec_env == "batch":
            if config.env_wrapper:
                raise ConfigError(
                    "env_wrapper: the batched environment has no single environments to wrap; "
                    "use vec_env dummy"
                )
            env = QuadcopterVecEnv(
                n_envs,
                seed=seed,
                staggered=staggered,
                **{"task": config.task, **config.env_kwargs},
            )
        else:
            if config.algo == "apg":
                raise ConfigError(
                    f"--vec-env {config.vec_env}: apg differentiates the batched environment; "
                    "remove --vec-env, or see docs/apg.md for an environment of your own"
                )
            # A worker process could not say that PyBullet is missing.
            if config.task:
                from sb3_quad.envs.rendering import bullet_client  # noqa: F401
            phases = n_envs if staggered else 1
            env = SINGLE[config.vec_env](
                [partial(_make_row, config, row, phases) for row in range(n_envs)]
            )
            env.seed(seed)
    except SB3QuadError:
        raise
    except (EOFError, ConnectionError):
        raise TrainingError(WORKER_ENDED) from None
    except (TypeError, ValueError, AssertionError) as error:
        raise ConfigError(
            f"{config.env_id}: cannot be made with env_kwargs {config.env_kwargs} ({error})"
        ) from error
    for path, kwargs in config.vec_env_wrappers:
        env = instance(path, "vec_env_wrapper", env, **kwargs)
    return env  # type: ignore[no-any-return]


def _make_row(config: TrainingConfig, row: int, phases: int) -> Env:
    """Make the environment of a row.

    Keywords that are lists have a value for each row, and start over at the end of the list.

    :param phases: number of phases that divide an episode evenly; row i begins in the i-th.
    """
    if config.vec_env == "subproc":
        ignore_interrupts()
    # A single environment takes one value; the batched one takes a list.
    keywords = dict(config.env_kwargs)
    for name in keywords.keys() & {"vehicle", "noise", "max_episode_steps"}:
        values = as_list(keywords[name]) or [None]
        keywords[name] = values[row % len(values)]
    env: Env = gymnasium.make(config.env_id, **keywords)
    limit = env.spec and env.spec.max_episode_steps
    # The rows would otherwise end all their episodes in the same step.
    if limit and row % phases:
        env = _FirstEpisode(env, limit - row * limit // phases)
    env = Monitor(env)
    for path, wrapper_kwargs in config.env_wrapper:
        env = instance(path, "env_wrapper", env, **wrapper_kwargs)
    return env


class _FirstEpisode(TimeLimit):
    """Truncates only the first episode, after a number of steps."""

    def reset(self, **kwargs: Any) -> Any:
        elapsed: Any = self._elapsed_steps
        if elapsed:
            self._max_episode_steps = ENDLESS
        return super().reset(**kwargs)
