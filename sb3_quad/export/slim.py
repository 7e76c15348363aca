"""A zip to hand on: the policy of a trained agent as a stock PPO model that several versions of SB3 read."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from sb3_quad.base.errors import ConfigError
from sb3_quad.experts.models import load_model

KEPT_KWARGS = ("net_arch", "activation_fn")


def slim_model(path: str | Path) -> Any:
    """The policy in the zip of an on-policy agent, as a PPO model without what its training left in it.

    Gone are the optimizer's moments, the last observations and the episodes' statistics; the settings are PPO's own, as plain
    numbers, since SB3's classes of schedules differ from version to version. The weights are the same.

    :raises ConfigError: a file that cannot be read, or whose policy is not ``MlpPolicy`` of an on-policy algorithm.
    """
    from stable_baselines3 import PPO
    from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
    from stable_baselines3.common.policies import ActorCriticPolicy

    source: Any = load_model(path)
    if not isinstance(source, OnPolicyAlgorithm) or type(source.policy) is not ActorCriticPolicy or source.use_sde:
        raise ConfigError(
            f"model {path}: only MlpPolicy of an on-policy algorithm (PPO, A2C, DAgger, PPOBC) can be handed on so"
        )
    kwargs = {key: source.policy_kwargs[key] for key in KEPT_KWARGS if key in (source.policy_kwargs or {})}
    model: Any = PPO("MlpPolicy", None, policy_kwargs=kwargs, device="cpu", _init_setup_model=False)  # type: ignore[arg-type]
    model.observation_space, model.action_space, model.n_envs = source.observation_space, source.action_space, 1
    model._setup_model()
    try:
        model.policy.load_state_dict(source.policy.state_dict())
    except RuntimeError as error:
        raise ConfigError(f"model {path}: its policy has settings beyond {', '.join(KEPT_KWARGS)} ({error})") from None
    model.num_timesteps = source.num_timesteps
    return model


def slim_bytes(path: str | Path) -> bytes:
    """The zip of :func:`slim_model`; SB3 2.4 and later read it.

    :raises ConfigError: as :func:`slim_model`.
    """
    model = slim_model(path)
    model.clip_range = 0.2  # plain numbers, of which loading makes the schedules of its own version
    buffer = io.BytesIO()
    model.save(buffer, exclude=["lr_schedule", "clip_range_vf", "start_time"])
    return buffer.getvalue()
