"""The algorithms that can be trained, imported when first needed."""

import inspect
import pkgutil
import typing
from types import SimpleNamespace
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

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
_SET_BY_JOB = {"self", "policy", "env", "expert", "policy_kwargs", "verbose", "tensorboard_log", "device", "seed"}


def get_algorithm(name: str) -> type[BaseAlgorithm]:
    """The class of an algorithm by its name.

    :raises ConfigError: an unknown name.
    """
    if name not in ALGORITHMS:
        raise ConfigError(unknown("algorithm", name, ALGORITHMS))
    return pkgutil.resolve_name(ALGORITHMS[name])  # type: ignore[no-any-return]


def constructor_parameters(algorithm: type[BaseAlgorithm]) -> dict[str, inspect.Parameter]:
    """What an algorithm's settings may give: its constructor's keywords, less those that a training job sets.

    The annotation of each is a type; Any where there is none, or where its names cannot be resolved.
    """
    constructor = inspect.unwrap(algorithm.__init__)
    return {
        name: parameter.replace(annotation=_resolve(parameter.annotation, constructor.__globals__))
        for name, parameter in inspect.signature(constructor).parameters.items()
        if name not in _SET_BY_JOB and not name.startswith("_") and parameter.kind is not parameter.VAR_KEYWORD
    }


def _resolve(annotation: Any, names: dict[str, Any]) -> Any:
    if annotation is inspect.Parameter.empty:
        return Any
    alone = SimpleNamespace(__annotations__={"value": annotation})  # a name that is missing spoils all others otherwise
    try:
        return typing.get_type_hints(alone, names)["value"]
    except Exception:  # an annotation is any expression, and fails as it likes
        return Any


def is_off_policy(algorithm: type[BaseAlgorithm]) -> bool:
    """Whether the algorithm learns from a replay buffer, such as SAC: its rollouts are ``train_freq`` steps long."""
    return issubclass(algorithm, OffPolicyAlgorithm)


def takes_expert(algorithm: type[BaseAlgorithm]) -> bool:
    """Whether the algorithm learns from an expert."""
    return "expert" in inspect.signature(algorithm.__init__).parameters
