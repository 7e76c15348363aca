"""One forward pass for PPO's terms and the cloning term together, without what a training step does not need."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch as th
from stable_baselines3.common.distributions import DiagGaussianDistribution
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_quad.common.forward import actor_latent, critic_latent
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
    for_actor, for_critic = (features, features) if policy.share_features_extractor else features
    latent_pi, latent_vf = actor_latent(policy, for_actor), critic_latent(policy, for_critic)
    values = policy.value_net(latent_vf).flatten()
    if type(policy.action_dist) is DiagGaussianDistribution:
        mean = policy.action_net(latent_pi)
        log_std = policy.log_std
        return Evaluation(values, -gaussian_nll(mean, log_std, actions), gaussian_entropy(log_std), mean)
    distribution = policy._get_action_dist_from_latent(latent_pi)
    return Evaluation(values, distribution.log_prob(actions), distribution.entropy(), distribution.mode())
