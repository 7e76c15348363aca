"""Search spaces for rl_zoo3's ``train -optimize``, in its form: a sampler and a converter per algorithm.

A sampler asks a trial for values and gives keywords of the algorithm. A converter gives the same from the values that a
study has kept (``--trial-id``), as plain as YAML holds them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from stable_baselines3.common.utils import LinearSchedule

from sb3_quad.common.losses import CLONING_LOSSES

if TYPE_CHECKING:
    from optuna import Trial

Settings = dict[str, Any]


def _suggest_shared(trial: Trial) -> None:
    trial.suggest_int("n_steps", 32, 512, log=True)
    trial.suggest_int("batch_size_pow", 8, 14)  # 2 to the power of it: 256 to 16384
    trial.suggest_float("one_minus_gamma", 0.001, 0.03, log=True)
    trial.suggest_float("one_minus_gae_lambda", 0.01, 0.1, log=True)
    trial.suggest_categorical("bc_loss", sorted(CLONING_LOSSES))


def _suggest_ppo_bc(trial: Trial) -> None:
    _suggest_shared(trial)
    trial.suggest_float("learning_rate", 5e-5, 2e-3, log=True)
    trial.suggest_int("n_epochs", 2, 12)
    trial.suggest_float("clip_range", 0.1, 0.4)
    trial.suggest_float("ent_coef", 1e-8, 1e-3, log=True)
    trial.suggest_float("max_grad_norm", 0.3, 2.0)
    trial.suggest_float("bc_coef", 0.01, 10.0, log=True)
    trial.suggest_categorical("bc_filter", ["none", "negative_advantage", "agreement"])
    trial.suggest_int("critic_warmup", 0, 8)


def _suggest_dagger(trial: Trial) -> None:
    _suggest_shared(trial)
    trial.suggest_float("learning_rate", 5e-4, 1e-2, log=True)
    trial.suggest_int("gradient_steps", 20, 300, log=True)
    trial.suggest_float("beta", 0.3, 1.0)
    trial.suggest_float("beta_decay", 0.001, 0.3, log=True)
    trial.suggest_float("beta_final", 0.0, 0.3)


def convert(parameters: Mapping[str, Any]) -> Settings:
    """The settings that a trial's parameters stand for; the learning rate falls linearly to 0, ``lin_x``."""
    settings = dict(parameters)
    settings["batch_size"] = 2 ** settings.pop("batch_size_pow")
    settings["gamma"] = 1.0 - settings.pop("one_minus_gamma")
    settings["gae_lambda"] = 1.0 - settings.pop("one_minus_gae_lambda")
    settings["learning_rate"] = f"lin_{settings['learning_rate']}"
    return settings


def _sampler(suggest: Callable[[Trial], None]) -> Callable[[Trial, int, int, Settings], Settings]:
    def sample(trial: Trial, n_actions: int, n_envs: int, additional_args: Settings) -> Settings:
        suggest(trial)
        settings = convert(trial.params)
        return {**settings, "learning_rate": LinearSchedule(trial.params["learning_rate"], 0.0, 1.0)}

    return sample


SAMPLERS = {"dagger": _sampler(_suggest_dagger), "ppo_bc": _sampler(_suggest_ppo_bc)}
CONVERTERS = {"dagger": convert, "ppo_bc": convert}
