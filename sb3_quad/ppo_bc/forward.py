"""One forward pass for PPO's terms and the cloning term together."""

from __future__ import annotations

import torch as th
from stable_baselines3.common.distributions import Distribution
from stable_baselines3.common.policies import ActorCriticPolicy


def evaluate(
    policy: ActorCriticPolicy, observations: th.Tensor, actions: th.Tensor
) -> tuple[th.Tensor, th.Tensor, th.Tensor | None, Distribution]:
    """``policy.evaluate_actions`` (the same numbers) and the action distribution, for B observations.

    :return: values (B, 1), log-probabilities (B,), entropies (B,) or None, and the distribution.
    """
    features = policy.extract_features(observations)
    if policy.share_features_extractor:
        latent_pi, latent_vf = policy.mlp_extractor(features)
    else:
        latent_pi = policy.mlp_extractor.forward_actor(features[0])
        latent_vf = policy.mlp_extractor.forward_critic(features[1])
    distribution = policy._get_action_dist_from_latent(latent_pi)
    return policy.value_net(latent_vf), distribution.log_prob(actions), distribution.entropy(), distribution
