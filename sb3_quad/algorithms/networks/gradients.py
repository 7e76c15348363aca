"""The gradients of a policy's loss, behind one call: compiled where the policy is two perceptrons,
else by PyTorch.

In shapes, ``b`` is the mini-batch, ``a`` the action dimension.
"""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import DiagGaussianDistribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import FlattenExtractor, MlpExtractor

from sb3_quad.algorithms.networks import losses
from sb3_quad.algorithms.networks.losses import Loss
from sb3_quad.algorithms.networks.perceptron import Perceptron
from sb3_quad.base.arrays import Float32Array, IntArray

Terms = dict[str, float]
COEFFICIENTS = {
    "policy_gradient_loss": "policy_coef",
    "bc_loss": "bc_coef",
    "aux_loss": "aux_coef",
    "value_loss": "vf_coef",
    "entropy_loss": "ent_coef",
    "l2_loss": "l2_coef",
}
"""The terms of a loss, as the logger calls them, with their weights."""


class Batch(NamedTuple):
    """A mini-batch as rows of arrays of length m, of which no copy is made.

    :param rows: (b,).
    :param observations: (m, ...).
    :param targets: (m, columns), see :mod:`.losses`.
    """

    rows: IntArray
    observations: npt.NDArray[Any]
    targets: Float32Array

    def tensors(self, device: th.device) -> tuple[th.Tensor, th.Tensor]:
        """The observations (b, ...) and targets (b, columns)."""
        rows = th.from_numpy(
            self.rows
        )  # gathered by PyTorch: in a third of the time of NumPy's indexing and a copy
        observations, targets = (
            th.from_numpy(each).index_select(0, rows) for each in (self.observations, self.targets)
        )
        return observations.to(device), targets.to(device)


class Perceptrons(NamedTuple):
    """A policy that is two perceptrons and a diagonal Gaussian."""

    actor: Perceptron
    critic: Perceptron
    log_std: th.nn.Parameter

    def parameters(self) -> list[th.nn.Parameter]:
        """Those of the policy."""
        return [*self.actor.parameters(), *self.critic.parameters(), self.log_std]


Network = ActorCriticPolicy | Perceptrons


def network_of(policy: ActorCriticPolicy) -> Network:
    """What computes a policy in the least time: compiled perceptrons, or, where it is anything
    else, the policy itself.
    """
    extractor: Any = policy.mlp_extractor
    if (
        type(extractor) is not MlpExtractor
        or type(policy.action_dist) is not DiagGaussianDistribution
    ):
        return policy
    actor, critic = (
        [*extractor.policy_net, policy.action_net],
        [*extractor.value_net, policy.value_net],
    )
    plain = (
        type(policy.features_extractor) is FlattenExtractor
        and policy.observation_space.dtype == np.float32
    )
    n_parameters = 2 * sum(type(layer) is th.nn.Linear for layer in (*actor, *critic)) + 1
    if not (
        plain
        and Perceptron.fits(actor)
        and Perceptron.fits(critic)
        and n_parameters == len([*policy.parameters()])
    ):
        return policy
    return Perceptrons(Perceptron(actor), Perceptron(critic), policy.log_std)


def mean_actions(network: Network, observations: npt.NDArray[Any]) -> Float32Array:
    """The means of a policy's Gaussian, (b, a), without gradients."""
    if isinstance(network, Perceptrons):
        return network.actor(_flat(observations))
    with th.no_grad():
        means = network.get_distribution(th.as_tensor(observations, device=network.device)).mode()
    return np.asarray(means.cpu().numpy())


def state_values(network: Network, observations: npt.NDArray[Any]) -> Float32Array:
    """V of observations, (b,), without gradients."""
    if isinstance(network, Perceptrons):
        return network.critic(_flat(observations))[:, 0]
    with th.no_grad():
        values = network.predict_values(th.as_tensor(observations, device=network.device))
    return np.asarray(values.flatten().cpu().numpy())


def act(network: Network, observations: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
    """``policy(observations)``: sampled actions (b, a), values (b, 1), log-probabilities (b,); the
    same random numbers.
    """
    if not isinstance(network, Perceptrons):
        actions, values, log_prob = network(observations)
        return actions, values, log_prob
    array = observations.numpy()
    mean, values, log_std = (
        th.from_numpy(mean_actions(network, array)),
        state_values(network, array),
        network.log_std,
    )
    actions = mean + th.exp(log_std) * th.normal(th.zeros_like(mean), th.ones_like(mean))
    return actions, th.from_numpy(values)[:, None], -losses.gaussian_nll(mean, log_std, actions)


def gradients(network: Network, loss: Loss, actor: Batch, critic: Batch | None) -> Terms:
    """Set ``.grad`` of every parameter to the gradient of a loss, averaged over mini-batches of
    actor and critic.

    :param critic: of the same rows as ``actor`` where the loss has PPO's term. None: the critic
        takes no part.
    :return: the terms that were computed, without their weights, and their weighted sum, as the
        logger calls them; NaN for a policy that is no longer finite.
    """
    if isinstance(network, Perceptrons):
        terms = _compiled(network, loss, actor, critic)
    else:
        terms = _by_autograd(network, loss, actor, critic)
    weighted = (
        getattr(loss, coefficient) * terms.get(name, 0.0)
        for name, coefficient in COEFFICIENTS.items()
    )
    return {"loss": sum(weighted), **terms}


def _by_autograd(
    policy: ActorCriticPolicy, loss: Loss, actor: Batch, critic: Batch | None
) -> Terms:
    observations, targets = actor.tensors(policy.device)
    kind, a = losses.CLONING_LOSSES[loss.bc_loss], get_action_dim(policy.action_space)
    terms: dict[str, th.Tensor] = {}
    values: th.Tensor | None = None
    log_prob: th.Tensor | None = None
    try:
        if loss.policy_coef != 0.0:
            actions, old_log_prob = (
                targets[:, -a - 2 : -2].contiguous(),
                targets[:, -2].contiguous(),
            )
            if isinstance(policy.action_space, spaces.Discrete):
                actions = actions.long().flatten()
            values, log_prob, entropy = policy.evaluate_actions(observations, actions)
        else:
            entropy = policy.get_distribution(observations).entropy()
            if critic is not None:
                values = policy.predict_values(critic.tensors(policy.device)[0])
    except ValueError:  # of a distribution whose mean is not finite
        return dict.fromkeys((*COEFFICIENTS, "approx_kl"), np.nan)

    if loss.policy_coef != 0.0 and log_prob is not None:
        advantages = targets[
            :, -1
        ].contiguous()  # as SB3 has it: strided, a sum may round differently
        if loss.normalize_advantage and len(advantages) > 1:
            advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        # The clipped surrogate loss; the ratio of new and old policy is one at first.
        log_ratio = log_prob - old_log_prob
        ratio = th.exp(log_ratio)
        clipped = th.clamp(ratio, 1 - loss.clip_range, 1 + loss.clip_range)
        terms["policy_gradient_loss"] = -th.min(advantages * ratio, advantages * clipped).mean()
        with th.no_grad():
            terms["approx_kl"] = (ratio - 1 - log_ratio).mean()
            terms["clip_fraction"] = ((ratio - 1).abs() > loss.clip_range).float().mean()
    if loss.bc_coef != 0.0:
        mean, labels = policy.action_dist.mode(), targets[:, :a]
        errors = losses.cloning_errors(kind, mean, policy.log_std, labels)
        if loss.bc_filter == losses.AGREEMENT:
            errors = errors * losses.agree(mean, labels)
        terms["bc_loss"] = errors.mean()
    if loss.aux_layer:
        latent = policy.extract_features(observations, policy.pi_features_extractor)
        said, right = policy.mlp_extractor.policy_net[: 2 * loss.aux_layer](latent), targets[:, a:]
        terms["aux_loss"] = losses.cloning_errors(
            "huber_mse", said[:, : right.shape[1]], policy.log_std, right
        ).mean()
    if critic is not None and values is not None:
        old_values, returns = critic.tensors(policy.device)[1].T.contiguous()
        terms["value_loss"] = losses.value_loss(values.flatten(), old_values, returns, loss)
    terms["entropy_loss"] = -entropy.mean() if entropy is not None else log_prob.mean()  # type: ignore[union-attr]
    if loss.l2_coef != 0.0:
        terms["l2_loss"] = losses.l2_loss([*policy.parameters()])

    policy.optimizer.zero_grad()
    weights = {
        name: getattr(loss, coefficient)
        for name, coefficient in COEFFICIENTS.items()
        if name in terms
    }
    th.stack(
        [weight * terms[name] for name, weight in weights.items() if weight != 0.0]
    ).sum().backward()  # type: ignore[no-untyped-call]
    return dict(zip(terms, th.stack([*terms.values()]).tolist(), strict=True))


def _compiled(network: Perceptrons, loss: Loss, actor: Batch, critic: Batch | None) -> Terms:
    """As :func:`_by_autograd`. The entropy's gradient and the weights' are added here."""
    terms: Terms = {}
    for parameter in network.parameters():
        parameter.grad = None
    if loss.policy_coef != 0.0 or loss.bc_coef != 0.0:
        n = len(actor.rows)
        if loss.policy_coef != 0.0 and loss.normalize_advantage and n > 1:
            advantages = actor.targets[actor.rows, -1]
            scale = 1.0 / (float(advantages.std(ddof=1)) + 1e-8)
            loss = loss._replace(advantage_shift=float(advantages.mean()), advantage_scale=scale)
        sums = (
            network.actor.gradient(
                _flat(actor.observations), actor.rows, actor.targets, loss, network.log_std
            )
            / n
        )
        if loss.bc_coef != 0.0:
            terms["bc_loss"] = sums[losses.CLONING]
        if loss.aux_layer:
            terms["aux_loss"] = sums[losses.AUXILIARY]
        if loss.policy_coef != 0.0:
            places = {
                "policy_gradient_loss": losses.POLICY,
                "approx_kl": losses.KL,
                "clip_fraction": losses.CLIPPED,
            }
            terms |= {name: sums[place] for name, place in places.items()}
    if critic is not None:
        sums = network.critic.gradient(
            _flat(critic.observations), critic.rows, critic.targets, loss
        )
        terms["value_loss"] = sums[losses.VALUE] / len(critic.rows)
    with th.no_grad():
        terms["entropy_loss"] = -float(losses.gaussian_entropy(network.log_std))
        if loss.ent_coef != 0.0:
            _add(network.log_std, th.full_like(network.log_std, -loss.ent_coef))
        if loss.l2_coef != 0.0:
            terms["l2_loss"] = float(losses.l2_loss(network.parameters()))
            for weights in network.parameters():
                if weights.ndim > 1:
                    _add(weights, loss.l2_coef * weights)
    return terms


def _add(parameter: th.nn.Parameter, gradient: th.Tensor) -> None:
    parameter.grad = gradient if parameter.grad is None else parameter.grad + gradient


def _flat(observations: npt.NDArray[Any]) -> Float32Array:
    return np.ascontiguousarray(observations, dtype=np.float32).reshape(len(observations), -1)
