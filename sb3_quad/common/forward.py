"""Forward passes through a policy's parts, without what a training step does not need."""

from __future__ import annotations

from typing import Any

import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.torch_layers import MlpExtractor
from torch import nn


def actor_mean(policy: ActorCriticPolicy, observations: th.Tensor) -> th.Tensor:
    """Mean of the policy's Gaussian, (b, action_dim), by the actor alone; ``evaluate_actions`` would run the critic too."""
    features = BasePolicy.extract_features(policy, observations, policy.pi_features_extractor)
    mean: th.Tensor = policy.action_net(actor_latent(policy, features))
    return mean


def critic_values(policy: ActorCriticPolicy, observations: th.Tensor) -> th.Tensor:
    """``policy.predict_values`` to rounding, (b,)."""
    features = BasePolicy.extract_features(policy, observations, policy.vf_features_extractor)
    values: th.Tensor = policy.value_net(critic_latent(policy, features))
    return values.flatten()


def actor_latent(policy: ActorCriticPolicy, features: th.Tensor) -> th.Tensor:
    """Input of the actor's last layer, (b, latent_dim_pi)."""
    extractor: Any = policy.mlp_extractor
    if type(extractor) is MlpExtractor:
        return _run(extractor.policy_net, features)
    latent: th.Tensor = extractor.forward_actor(features)
    return latent


def critic_latent(policy: ActorCriticPolicy, features: th.Tensor) -> th.Tensor:
    """Input of the critic's last layer, (b, latent_dim_vf)."""
    extractor: Any = policy.mlp_extractor
    if type(extractor) is MlpExtractor:
        return _run(extractor.value_net, features)
    latent: th.Tensor = extractor.forward_critic(features)
    return latent


class _Tanh(th.autograd.Function):
    """tanh(x) = 2 σ(2x) - 1. PyTorch's CPU code computes σ three to four times as fast as tanh; they agree to 1e-7."""

    @staticmethod
    def forward(ctx: Any, x: th.Tensor) -> th.Tensor:
        y = th.sigmoid(x + x).mul_(2.0).sub_(1.0)
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx: Any, *gradients: th.Tensor) -> th.Tensor:
        (y,) = ctx.saved_tensors
        result: th.Tensor = th.ops.aten.tanh_backward(gradients[0], y)
        return result


def _run(network: nn.Sequential, x: th.Tensor) -> th.Tensor:
    for layer in network:
        x = _Tanh.apply(x) if type(layer) is nn.Tanh else layer(x)  # type: ignore[no-untyped-call]
    return x
