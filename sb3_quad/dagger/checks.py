"""Bad arguments of DAgger, each refused in one line that says what is allowed.

:raises ConfigError: by every function
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from gymnasium import spaces

from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.common.losses import CLONING_LOSSES

if TYPE_CHECKING:
    from sb3_quad.dagger.dagger import DAgger


def check_arguments(model: DAgger) -> None:
    """Every number and choice of a model whose ``n_envs`` is known."""
    for name in ("n_steps", "batch_size", "n_epochs", "gradient_steps"):
        value = getattr(model, name)
        if value is not None and value < 1:
            raise ConfigError(f"{name} {value}: must be at least 1")
    for name in ("beta", "beta_final"):
        if not 0.0 <= getattr(model, name) <= 1.0:
            raise ConfigError(f"{name} {getattr(model, name)}: a probability, from 0 to 1")
    if model.beta_decay < 0.0:
        raise ConfigError(f"beta_decay {model.beta_decay}: must not be negative")
    if model.beta_final > model.beta:
        raise ConfigError(f"beta {model.beta}: is below beta_final {model.beta_final}; lower beta_final with it")
    if isinstance(model.clip_range_vf, (float, int)) and model.clip_range_vf <= 0:
        raise ConfigError(f"clip_range_vf {model.clip_range_vf}: must be positive, or None for no clipping")
    if (model.policy_kwargs or {}).get("use_sde"):
        raise ConfigError("policy_kwargs: DAgger needs a diagonal Gaussian policy, so no use_sde")
    if model.bc_loss not in CLONING_LOSSES:
        raise ConfigError(unknown("bc_loss", model.bc_loss, CLONING_LOSSES))
    rollout = model.n_steps * model.n_envs
    if model.dataset_capacity != 0 and model.dataset_capacity < rollout:
        raise ConfigError(
            f"dataset_capacity {model.dataset_capacity}: must be 0 (the current rollout only) or at least "
            f"n_steps * n_envs = {rollout}"
        )


def check_spaces(observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> None:
    """Box actions, and observations that are one array."""
    if isinstance(observation_space, spaces.Dict):
        raise ConfigError(
            f"observation space {observation_space}: DAgger does not support Dict; wrap the environment in "
            "gymnasium.wrappers.FlattenObservation"
        )
    if not isinstance(action_space, spaces.Box):
        raise ConfigError(f"action space {action_space}: DAgger supports Box only")
