"""The algorithms that can be trained, imported when first needed."""

import inspect
import pkgutil
import typing
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_quad.base.errors import ConfigError, unknown

ALGORITHMS = {
    "dagger": "sb3_quad.algorithms.dagger:DAgger",
    "ppo_bc": "sb3_quad.algorithms.ppo_bc:PPOBC",
    "sac_bc": "sb3_quad.algorithms.sac_bc:SACBC",
    "ppo": "stable_baselines3.ppo.ppo:PPO",
    "sac": "stable_baselines3.sac.sac:SAC",
    "td3": "stable_baselines3.td3.td3:TD3",
}
# Set by a training job rather than by the settings of an algorithm.
_SET_BY_JOB = {
    "self",
    "policy",
    "env",
    "expert",
    "policy_kwargs",
    "verbose",
    "tensorboard_log",
    "device",
    "seed",
}


def get_algorithm(name: str) -> type[BaseAlgorithm]:
    """The class of an algorithm by its name.

    :raises ConfigError: an unknown name.
    """
    if name not in ALGORITHMS:
        raise ConfigError(unknown("algorithm", name, ALGORITHMS))
    return pkgutil.resolve_name(ALGORITHMS[name])  # type: ignore[no-any-return]


def constructor_parameters(algorithm: type[BaseAlgorithm]) -> dict[str, inspect.Parameter]:
    """What an algorithm's settings may give: its constructor's keywords, less those that a training
    job sets.

    The annotation of each is a type; Any where there is none, or where a name in the annotations
    cannot be resolved.
    """
    try:
        types = typing.get_type_hints(
            algorithm.__init__, localns={"VecEnv": VecEnv}
        )  # a forward reference of GymEnv
    except NameError:
        types = {}
    return {
        name: parameter.replace(annotation=types.get(name, Any))
        for name, parameter in inspect.signature(algorithm.__init__).parameters.items()
        if name not in _SET_BY_JOB
        and not name.startswith("_")
        and parameter.kind is not parameter.VAR_KEYWORD
    }


def is_off_policy(algorithm: type[BaseAlgorithm]) -> bool:
    """Whether the algorithm learns from a replay buffer, such as SAC: its rollouts are
    ``train_freq`` steps long.
    """
    return issubclass(algorithm, OffPolicyAlgorithm)


def takes_expert(algorithm: type[BaseAlgorithm]) -> bool:
    """Whether the algorithm learns from an expert."""
    return "expert" in inspect.signature(algorithm.__init__).parameters
