"""A zip to hand on: the policy of a trained agent as a stock PPO model that several versions of SB3 read."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from stable_baselines3 import PPO

from sb3_quad.base.errors import ConfigError
from sb3_quad.experts.models import load_model
from sb3_quad.export.network import check_policy


def slim_bytes(path: str | Path) -> bytes:
    """The zip of a PPO model with the policy of an on-policy agent's zip; SB3 2.4 and later read it.

    Gone are the optimizer's moments, the last observations and the episodes' statistics; the settings are PPO's own, as plain
    numbers, since SB3's classes of schedules differ from version to version. The weights are the same.

    :raises ConfigError: a file that cannot be read, or whose policy is not ``MlpPolicy`` of an on-policy algorithm.
    """
    source: Any = load_model(path)
    check_policy(source.policy, f"model {path}")
    if source.use_sde:
        raise ConfigError(f"model {path}: was trained with gSDE (use_sde), which is not handed on")
    kwargs = {key: value for key, value in source.policy_kwargs.items() if key in ("net_arch", "activation_fn")}
    model: Any = PPO("MlpPolicy", None, policy_kwargs=kwargs, device="cpu", _init_setup_model=False)  # type: ignore[arg-type]
    model.observation_space, model.action_space, model.n_envs = source.observation_space, source.action_space, 1
    model._setup_model()
    model.policy.load_state_dict(source.policy.state_dict())
    model.num_timesteps = source.num_timesteps
    model.clip_range = 0.2  # plain numbers, of which loading makes the schedules of its own version
    buffer = io.BytesIO()
    model.save(buffer, exclude=["lr_schedule", "clip_range_vf", "start_time"])
    return buffer.getvalue()
