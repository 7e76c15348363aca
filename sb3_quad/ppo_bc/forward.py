"""One forward pass for PPO's terms and the cloning term together, without what a training step does not need."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch as th
from stable_baselines3.common.distributions import DiagGaussianDistribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import MlpExtractor
from torch import nn

from sb3_quad.common.losses import gaussian_entropy, gaussian_nll


class Evaluation(NamedTuple):
    """What a policy says of B observations and the actions that were flown there.

    :param values: (B,).
    :param log_prob: (B,).
    :param entropy: of the action distributions, (B,), or a scalar where it is the same for all, or None without a closed form.
    :param mean: mode of the distributions, (B, action_dim).
    """

    values: th.Tensor
    log_prob: th.Tensor
    entropy: th.Tensor | None
    mean: th.Tensor


def evaluate(policy: ActorCriticPolicy, observations: th.Tensor, actions: th.Tensor) -> Evaluation:
    """``policy.evaluate_actions`` to rounding, and the mode of the action distribution."""
    features: Any = policy.extract_features(observations)
    extractor: Any = policy.mlp_extractor
    if type(extractor) is MlpExtractor:
        for_actor, for_critic = (features, features) if policy.share_features_extractor else features
        latent_pi, latent_vf = _run(extractor.policy_net, for_actor), _run(extractor.value_net, for_critic)
    elif policy.share_features_extractor:
        latent_pi, latent_vf = extractor(features)
    else:
        latent_pi, latent_vf = extractor.forward_actor(features[0]), extractor.forward_critic(features[1])
    values = policy.value_net(latent_vf).flatten()
    if type(policy.action_dist) is DiagGaussianDistribution:
        mean = policy.action_net(latent_pi)
        log_std = policy.log_std
        return Evaluation(values, -gaussian_nll(mean, log_std, actions), gaussian_entropy(log_std), mean)
    distribution = policy._get_action_dist_from_latent(latent_pi)
    return Evaluation(values, distribution.log_prob(actions), distribution.entropy(), distribution.mode())


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
