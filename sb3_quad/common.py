"""What DAgger and PPO with behavioural cloning share: the terms of Eqs. 4.3 and 4.4, and forward passes.

Every function takes and gives tensors; ``b`` is the mini-batch, ``a`` the action dimension. The forward passes leave out what
a training step does not need, and agree with the policy's own methods to rounding.
"""

import math
from typing import Any, Literal

import torch as th
from stable_baselines3.common.distributions import DiagGaussianDistribution
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.torch_layers import MlpExtractor
from torch.nn import functional as F

from sb3_quad import networks

CloningLoss = Literal["mse", "nll", "huber", "huber_mse"]
CLONING_LOSSES: tuple[CloningLoss, ...] = ("mse", "nll", "huber", "huber_mse")
HUBER_DELTA = 0.05  # error of an action from which "huber" grows linearly; the range of an action is 2
MSE_WEIGHT = 3.0  # of the squared error in "huber_mse"


def gaussian_nll(mean: th.Tensor, log_std: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """-log π(a|s) of a diagonal Gaussian, (b,), summed over the action's dimensions."""
    scaled = (actions - mean) * th.exp(-log_std)
    return (0.5 * scaled.square() + log_std + 0.5 * math.log(2.0 * math.pi)).sum(dim=1)


def gaussian_entropy(log_std: th.Tensor) -> th.Tensor:
    """H of a diagonal Gaussian, a scalar: the same in every state, because the standard deviation is (Eq. 4.2)."""
    return (log_std + 0.5 * math.log(2.0 * math.pi * math.e)).sum()


def cloning_errors(kind: CloningLoss, mean: th.Tensor, log_std: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """How far the policy is from the expert's ``actions`` (b, a), by row, (b,); L_BC is the mean over the rows.

    ``"nll"``: Eq. 3.12, the negative log-likelihood, a sum over the action's dimensions; it also shrinks the standard
    deviation towards the error that is left. The others are means over the dimensions and leave the deviation alone.
    ``"mse"``: squared. ``"huber"``: half the squared error up to 0.05, linear beyond, in units of 0.05. In a tumble, the
    expert's action cannot be told from a noisy observation: squared errors are large there and take most of the gradient,
    though nothing can be learnt. Linear ones leave more of it to the approach and the hover, where a hundredth is
    centimetres. ``"huber_mse"``: that and three times the squared error, for policies that must do both.
    """
    if kind == "nll":
        return gaussian_nll(mean, log_std, actions)
    squared = (mean - actions).square().mean(dim=1)
    if kind == "mse":
        return squared
    huber = F.huber_loss(mean, actions, delta=HUBER_DELTA, reduction="none").mean(dim=1) / HUBER_DELTA
    return huber if kind == "huber" else huber + MSE_WEIGHT * squared


def cloning_loss(kind: CloningLoss, mean: th.Tensor, log_std: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """L_BC, a scalar: the mean of :func:`cloning_errors` over the rows, in a third of the time."""
    if kind == "nll":
        return gaussian_nll(mean, log_std, actions).mean()
    loss: th.Tensor | float = 0.0 if kind == "huber" else F.mse_loss(mean, actions) * (1.0 if kind == "mse" else MSE_WEIGHT)
    if kind != "mse":
        loss = loss + F.huber_loss(mean, actions, delta=HUBER_DELTA) / HUBER_DELTA
    return th.as_tensor(loss)


def value_loss(values: th.Tensor, old_values: th.Tensor, returns: th.Tensor, clip_range: float | None) -> th.Tensor:
    """The critic's loss, a scalar: Eq. 3.8 averaged over the rows, or plain mean squared error without ``clip_range``.

    Eq. 3.8 takes the larger of the two errors, so leaving the clip range is never rewarded; SB3's own clipping takes
    the clipped one alone.

    :param values: v(s) now, (b,)
    :param old_values: v(s) when the rollout was flown, (b,)
    :param returns: Ĝ of Eq. 3.11, (b,)
    """
    error = (values - returns).square()
    if clip_range is not None:
        clipped = old_values + (values - old_values).clamp(-clip_range, clip_range)
        error = th.max(error, (clipped - returns).square())
    return error.mean()


def l2_loss(policy: ActorCriticPolicy) -> th.Tensor:
    """½ Σ w² over the weight matrices of actor and critic (Eq. 2.25), a scalar; biases and log_std are left out."""
    return 0.5 * th.stack([weights.square().sum() for weights in policy.parameters() if weights.ndim > 1]).sum()


def actor_mean(policy: ActorCriticPolicy, observations: th.Tensor) -> th.Tensor:
    """Mean of the policy's Gaussian, (b, a), by the actor alone; ``evaluate_actions`` would run the critic too."""
    features = BasePolicy.extract_features(policy, observations, policy.pi_features_extractor)
    return _through(policy, "actor", features)


def critic_values(policy: ActorCriticPolicy, observations: th.Tensor) -> th.Tensor:
    """``policy.predict_values``, (b,)."""
    features = BasePolicy.extract_features(policy, observations, policy.vf_features_extractor)
    return _through(policy, "critic", features).flatten()


def evaluate_actions(
    policy: ActorCriticPolicy, observations: th.Tensor, actions: th.Tensor
) -> tuple[th.Tensor, th.Tensor, th.Tensor | None, th.Tensor]:
    """``policy.evaluate_actions`` in less time, and the mode of the action distribution.

    :return: values (b,); log-probabilities of ``actions`` (b,); entropy, (b,), or a scalar where it is the same for all, or
        None without a closed form; modes (b, a).
    """
    features: Any = policy.extract_features(observations)
    for_actor, for_critic = (features, features) if policy.share_features_extractor else features
    values = _through(policy, "critic", for_critic).flatten()
    if type(policy.action_dist) is DiagGaussianDistribution:
        mean, log_std = _through(policy, "actor", for_actor), policy.log_std
        return values, -gaussian_nll(mean, log_std, actions), gaussian_entropy(log_std), mean
    distribution = policy._get_action_dist_from_latent(policy.mlp_extractor.forward_actor(for_actor))
    return values, distribution.log_prob(actions), distribution.entropy(), distribution.mode()


def is_compiled(policy: ActorCriticPolicy) -> bool:
    """Whether actor and critic are perceptrons that :mod:`sb3_quad.networks` computes."""
    return all(networks.fits(_modules(policy, part)) for part in ("actor", "critic"))


def _modules(policy: ActorCriticPolicy, part: str) -> list[th.nn.Module]:
    """The layers of the ``actor`` or the ``critic`` behind the features; none where they are not a sequence."""
    extractor: Any = policy.mlp_extractor
    if type(extractor) is not MlpExtractor:
        return []
    return [*extractor.policy_net, policy.action_net] if part == "actor" else [*extractor.value_net, policy.value_net]


def _through(policy: ActorCriticPolicy, part: str, features: th.Tensor) -> th.Tensor:
    """The output of the ``actor`` or the ``critic``, (b, outputs)."""
    modules, extractor = _modules(policy, part), policy.mlp_extractor
    if networks.fits(modules) and features.dtype == th.float32 and not features.requires_grad:
        return networks.apply(modules, features)
    if part == "actor":
        return policy.action_net(extractor.forward_actor(features))  # type: ignore[no-any-return]
    return policy.value_net(extractor.forward_critic(features))  # type: ignore[no-any-return]
