"""The vectorised environment of a job: batched, one process, or one process each; the same learning problem in all."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from sb3_quad.base.errors import ConfigError, SB3QuadError
from sb3_quad.base.signals import ignore_interrupts
from sb3_quad.settings.config import TrainingConfig
from sb3_quad.settings.values import import_class

if TYPE_CHECKING:
    import gymnasium
    import numpy as np
    import numpy.typing as npt
    from stable_baselines3.common.vec_env import VecEnv


def make_environments(config: TrainingConfig, n_envs: int, seed: int) -> VecEnv:
    """``n_envs`` environments as the settings describe them; number i is seeded with ``seed + i``.

    Each gives ``info["episode"]`` where an episode ends, as SB3's Monitor does.

    :raises ConfigError: keywords that the environment does not take.
    """
    try:
        env = _batch(config, n_envs, seed) if config.vec_env == "batch" else _separate(config, n_envs)
    except SB3QuadError:
        raise
    except (TypeError, ValueError, AssertionError) as error:
        raise ConfigError(f"{config.env_id}: cannot be made with env_kwargs {config.env_kwargs} ({error})") from error
    if config.vec_env != "batch":
        env.seed(seed)
    for path, kwargs in config.vec_env_wrapper:
        env = import_class(path, "vec_env_wrapper")(env, **kwargs)
    return env


def _batch(config: TrainingConfig, n_envs: int, seed: int) -> VecEnv:
    from sb3_quad.envs.vec_env import QuadcopterVecEnv

    if config.env_wrapper:
        raise ConfigError("env_wrapper: the batched environment has no single environments to wrap; use vec_env dummy")
    return QuadcopterVecEnv(n_envs, seed=seed, **{"task": config.task, **config.env_kwargs})


def _separate(config: TrainingConfig, n_envs: int) -> VecEnv:
    from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

    wrappers = config.env_wrapper
    if config.vec_env == "dummy":
        return DummyVecEnv([partial(_make_one, config.env_id, config.env_kwargs, wrappers)] * n_envs)
    makers: list[Callable[[], gymnasium.Env[Any, Any]]]
    makers = [partial(_make_in_worker, config.env_id, config.env_kwargs, wrappers)] * n_envs
    return SubprocVecEnv(makers)


def _make_one(env_id: str, kwargs: dict[str, Any], wrappers: list[tuple[str, dict[str, Any]]]) -> gymnasium.Env[Any, Any]:
    import gymnasium
    from stable_baselines3.common.monitor import Monitor

    import sb3_quad  # noqa: F401  (registers the environments, also in a worker process)

    env: gymnasium.Env[Any, Any] = Monitor(gymnasium.make(env_id, **kwargs))
    for path, wrapper_kwargs in wrappers:
        env = import_class(path, "env_wrapper")(env, **wrapper_kwargs)
    return env


def _make_in_worker(
    env_id: str, kwargs: dict[str, Any], wrappers: list[tuple[str, dict[str, Any]]]
) -> gymnasium.Env[Any, Any]:
    ignore_interrupts()
    return _make_one(env_id, kwargs, wrappers)


def set_environment_state(env: VecEnv, state: dict[str, npt.NDArray[np.generic]]) -> None:
    """Undo what has happened since the state was taken (:mod:`sb3_quad.callbacks.last_good`).

    :raises ConfigError: a state of other environments.
    """
    batch = getattr(env.unwrapped, "batch", None)
    for name, array in state.items():
        current = getattr(batch, name, None)
        if current is None or current.shape != array.shape:
            raise ConfigError(f"the saved state of the environments does not fit these ({name}); use the run's own settings")
        current[...] = array
