"""Our algorithms' settings as rl_zoo3 wants them: keywords of a constructor, and what a search varies."""

from collections.abc import Mapping
from typing import Any

from rl_zoo3 import ALGOS
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER

from sb3_quad.base.literals import parse_mapping
from sb3_quad.training.algorithms import constructor_parameters
from sb3_quad.training.values import convert
from sb3_quad.tuning.space import load_space

Settings = dict[str, Any]
OWN_ALGORITHMS = ("dagger", "ppo_bc", "sac_bc")


def register_space(algo: str, settings: Mapping[str, Any]) -> None:
    """Have ``-optimize`` and ``--trial-id`` search as ``tune`` does, around some settings of an algorithm.

    rl_zoo3 wants a sampler, which asks a trial for values and gives keywords of the algorithm; and a converter, which gives
    the settings that the values kept by a study stand for, as plain as YAML holds them.
    """

    def convert_parameters(parameters: Mapping[str, Any]) -> Settings:
        parse_mapping(settings.get("policy_kwargs"), "policy_kwargs")  # an expression would be lost, so it is refused
        found = load_space(algo, settings).settings(parameters)
        return {name: value for name, value in found.items() if name not in settings or settings[name] != value}

    def sample(trial: Any, *_: Any) -> Settings:
        load_space(algo, settings).suggest(trial)
        return to_keywords(algo, convert_parameters(trial.params), "search space")

    HYPERPARAMS_SAMPLER[algo] = sample
    HYPERPARAMS_CONVERTER[algo] = convert_parameters


def to_keywords(algo: str, settings: Settings, where: str) -> Settings:
    """Settings with those that the algorithm's constructor takes converted to what it takes."""
    parameters = constructor_parameters(ALGOS[algo])
    found = {
        name: convert(each, parameters[name], f"{where}: {name}") for name, each in settings.items() if name in parameters
    }
    if isinstance(settings.get("policy_kwargs"), dict):
        found["policy_kwargs"] = parse_mapping(settings["policy_kwargs"], f"{where}: policy_kwargs")
    return {**settings, **found}
