"""The terms of Eq. 4.4 on one mini-batch."""

from __future__ import annotations

from typing import NamedTuple

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from torch.nn import functional as F

from sb3_quad.common.losses import CloningLoss, gaussian_nll, l2_loss, mean_errors
from sb3_quad.common.losses import value_loss as max_clipped_value_loss
from sb3_quad.ppo_bc.buffer import ExpertRolloutBufferSamples
from sb3_quad.ppo_bc.forward import Evaluation, evaluate

BC_FILTERS = ("none", "negative_advantage", "agreement")
AGREEMENT = 0.3  # root mean squared difference of actions up to which "agreement" clones; the range of an action is 2


class Weights(NamedTuple):
    """What the terms are weighted with in one update; :class:`~sb3_quad.PPOBC` says what each means."""

    clip_range: float
    clip_range_vf: float | None
    max_clipped_value: bool
    normalize_advantage: bool
    vf_coef: float
    ent_coef: float
    bc_coef: float
    bc_loss: CloningLoss
    bc_filter: str
    l2_coef: float


class LossTerms(NamedTuple):
    """A mini-batch's loss in parts.

    :param weighted: by name: the terms whose sum is the loss.
    :param monitored: by name: scalars for the logger, under SB3's names, without gradients.
    """

    weighted: dict[str, th.Tensor]
    monitored: dict[str, th.Tensor]


def loss_terms(policy: ActorCriticPolicy, samples: ExpertRolloutBufferSamples, weights: Weights) -> LossTerms:
    """PPO-clip, value loss, entropy, cloning and L2 terms of Eq. 4.4; terms of no weight are left out."""
    discrete = isinstance(policy.action_space, spaces.Discrete)
    actions = samples.actions.long().flatten() if discrete else samples.actions
    evaluation = evaluate(policy, samples.observations, actions)
    advantages = samples.advantages
    if weights.normalize_advantage and len(advantages) > 1:
        advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
    log_ratio = evaluation.log_prob - samples.old_log_prob
    ratio = log_ratio.exp()
    clipped = ratio.clamp(1 - weights.clip_range, 1 + weights.clip_range)
    policy_loss = -th.min(advantages * ratio, advantages * clipped).mean()
    value_loss = _value_loss(evaluation.values, samples, weights)
    entropy = -evaluation.log_prob if evaluation.entropy is None else evaluation.entropy
    entropy_loss = -entropy.mean()

    weighted = {"policy": policy_loss, "value": weights.vf_coef * value_loss}
    if weights.ent_coef != 0.0:
        weighted["entropy"] = weights.ent_coef * entropy_loss
    with th.no_grad():
        monitored = {
            "policy_gradient_loss": policy_loss.detach(),
            "value_loss": value_loss.detach(),
            "entropy_loss": entropy_loss.detach(),
            "approx_kl": (ratio - 1 - log_ratio).mean(),
            "clip_fraction": ((ratio - 1).abs() > weights.clip_range).float().mean(),
        }
    if weights.bc_coef != 0.0:
        # The filter looks at the advantages' sign before they are normalised.
        bc_loss = _bc_loss(policy, evaluation, samples, weights)
        weighted["bc"] = weights.bc_coef * bc_loss
        monitored["bc_loss"] = bc_loss.detach()
    if weights.l2_coef > 0.0:
        l2 = l2_loss(policy)
        weighted["l2"] = weights.l2_coef * l2
        monitored["l2_loss"] = l2.detach()
    return LossTerms(weighted, monitored)


def _value_loss(values: th.Tensor, samples: ExpertRolloutBufferSamples, weights: Weights) -> th.Tensor:
    if weights.clip_range_vf is None:
        return F.mse_loss(samples.returns, values)
    if weights.max_clipped_value:  # Eq. 3.8
        return max_clipped_value_loss(values, samples.old_values, samples.returns, weights.clip_range_vf)
    change = (values - samples.old_values).clamp(-weights.clip_range_vf, weights.clip_range_vf)
    return F.mse_loss(samples.returns, samples.old_values + change)


def _bc_loss(
    policy: ActorCriticPolicy, evaluation: Evaluation, samples: ExpertRolloutBufferSamples, weights: Weights
) -> th.Tensor:
    """L_BC of Eq. 3.12 over the mini-batch; rows that the filter leaves out count as zero."""
    mean, expert_actions = evaluation.mean, samples.expert_actions
    if weights.bc_loss == "nll":
        per_sample = gaussian_nll(mean, policy.log_std, expert_actions) / expert_actions.shape[1]
    else:
        per_sample = mean_errors(weights.bc_loss, mean, expert_actions)
    if weights.bc_filter == "none":
        return per_sample.mean()
    if weights.bc_filter == "negative_advantage":
        mask = samples.advantages < 0
    else:
        mask = mean_errors("mse", mean, expert_actions) < AGREEMENT**2
    return (per_sample * mask).mean()
