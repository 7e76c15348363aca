"""What rl_zoo3 looks up by name: algorithms, search spaces, and the class that sets a training up."""

from __future__ import annotations

import importlib
import sys

from sb3_quad.settings.algorithms import get_algorithm
from sb3_quad.zoo.search import CONVERTERS, SAMPLERS

OWN_ALGORITHMS = ("dagger", "ppo_bc")


def register() -> None:
    """Make them known; calling it again changes nothing."""
    from rl_zoo3 import ALGOS
    from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER

    ALGOS.update({name: get_algorithm(name) for name in OWN_ALGORITHMS})
    HYPERPARAMS_SAMPLER.update(SAMPLERS)
    HYPERPARAMS_CONVERTER.update(CONVERTERS)
    module = importlib.import_module("rl_zoo3.exp_manager")
    # rl_zoo3's record_video imports exp_manager, which imports custom_envs, which may import this: too early for a
    # subclass of what it is about to define, and none is needed there.
    if hasattr(module, "ExperimentManager"):
        _replace_manager()


def _replace_manager() -> None:
    from sb3_quad.zoo.manager import QuadExperimentManager

    for name, module in list(sys.modules.items()):
        if name.startswith("rl_zoo3.") and hasattr(module, "ExperimentManager"):
            module.ExperimentManager = QuadExperimentManager  # type: ignore[attr-defined]
