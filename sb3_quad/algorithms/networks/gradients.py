"""Policies of two perceptrons, whose losses compiled code differentiates.

In shapes, ``b`` is the mini-batch and ``a`` the action dimension.
"""

from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.distributions import DiagGaussianDistribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor, MlpExtractor

from sb3_quad.algorithms.networks import losses
from sb3_quad.algorithms.networks.losses import Loss
from sb3_quad.algorithms.networks.perceptron import Batch, Perceptron
from sb3_quad.base.types import AnyArray, Float32Array, FloatArray

Terms = dict[str, float]
"""The terms of a loss without their weights, and ``loss``, their weighted sum, by logged name."""


class Perceptrons(NamedTuple):
    """A policy that consists of two perceptrons and a diagonal Gaussian."""

    actor: Perceptron
    critic: Perceptron
    log_std: th.nn.Parameter

    def parameters(self) -> list[th.nn.Parameter]:
        """Return the policy's parameters."""
        return [*self.actor.parameters(), *self.critic.parameters(), self.log_std]

    def gradients(self, loss: Loss, actor: Batch, critic: Batch | None) -> Terms:
        """Set ``.grad`` of every parameter to the gradient of a loss.

        It equals what ``loss.backward()`` computes in ``PPOBC.train`` and ``DAgger.train``.

        :param critic: mini-batch of the value loss. None: no value loss.
        :return: the terms that were computed; NaN for a policy that is no longer finite.
        """
        n = len(actor.rows)
        if loss.policy_coef != 0.0 and loss.normalize_advantage and n > 1:
            advantages = actor.targets[actor.rows, -1]
            scale = 1.0 / (float(advantages.std(ddof=1)) + 1e-8)
            loss = loss._replace(advantage_shift=float(advantages.mean()), advantage_scale=scale)
        means = self.actor.gradient(actor, loss, self.log_std)
        terms: Terms = {}
        if loss.bc_coef != 0.0:
            terms["bc_loss"] = means[losses.CLONING]
        if loss.policy_coef != 0.0:
            terms["policy_gradient_loss"] = means[losses.POLICY]
            terms["approx_kl"] = means[losses.KL]
            terms["clip_fraction"] = means[losses.CLIPPED]
        if critic is None:
            # The gradient of the L2 term is added below.
            for parameter in self.critic.parameters():
                parameter.grad = th.zeros_like(parameter)
        else:
            terms["value_loss"] = self.critic.gradient(critic, loss)[losses.VALUE]
        # The gradients of the entropy and of the L2 term are written out here.
        with th.no_grad():
            terms["entropy_loss"] = -float(losses.gaussian_entropy(self.log_std))
            self.log_std.grad -= loss.ent_coef  # type: ignore[operator, assignment]
            if loss.l2_coef != 0.0:
                terms["l2_loss"] = float(losses.l2_loss(self.parameters()))
                for weights in self.parameters():
                    if weights.ndim > 1:
                        weights.grad += loss.l2_coef * weights  # type: ignore[operator]
        total = sum(
            getattr(loss, coefficient) * terms.get(name, 0.0)
            for name, coefficient in losses.WEIGHTS.items()
        )
        return {"loss": total, **terms}


Network = ActorCriticPolicy | Perceptrons


def network_of(policy: ActorCriticPolicy) -> Network:
    """Return the fastest implementation of a policy.

    That is compiled perceptrons if it consists of two of them on the CPU, otherwise the policy
    itself.
    """
    extractor: Any = policy.mlp_extractor
    # A subclass may compute something else.
    if (
        type(policy) is not ActorCriticPolicy
        or type(extractor) is not MlpExtractor
        or type(policy.action_dist) is not DiagGaussianDistribution
        or type(policy.features_extractor) is not FlattenExtractor
        or policy.observation_space.dtype != np.float32
    ):
        return policy
    actor = [*extractor.policy_net, policy.action_net]
    critic = [*extractor.value_net, policy.value_net]
    if not (Perceptron.fits(actor) and Perceptron.fits(critic) and policy.log_std.requires_grad):
        return policy
    network = Perceptrons(Perceptron(actor), Perceptron(critic), policy.log_std)
    # PyTorch computes a policy with further parameters, or with layers that actor and critic share.
    if len(network.parameters()) != len([*policy.parameters()]):
        return policy
    return network


def mean_actions(network: Network, observations: AnyArray) -> Float32Array:
    """Return the means of a policy's Gaussian, (b, a), without gradients."""
    if isinstance(network, Perceptrons):
        return network.actor(observations)
    with th.no_grad():
        means = network.get_distribution(th.as_tensor(observations, device=network.device)).mode()
    return np.asarray(means.cpu().numpy())


def state_values(network: Network, observations: AnyArray) -> Float32Array:
    """Return V of observations, (b,), without gradients."""
    if isinstance(network, Perceptrons):
        return network.critic(observations)[:, 0]
    with th.no_grad():
        values = network.predict_values(th.as_tensor(observations, device=network.device))
    return np.asarray(values.flatten().cpu().numpy())


def act(network: Perceptrons, observations: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
    """Return what ``policy(observations)`` returns, using the same random numbers.

    :return: sampled actions (b, a), values (b, 1), log-probabilities (b,).
    """
    array = observations.numpy()
    mean = th.from_numpy(mean_actions(network, array))
    values = th.from_numpy(state_values(network, array))[:, None]
    log_std = network.log_std
    actions = mean + th.exp(log_std) * th.normal(th.zeros_like(mean), th.ones_like(mean))
    return actions, values, -losses.gaussian_nll(mean, log_std, actions)


class RecordedPolicy:
    """Computes a policy's mean actions step by step, and carries gradients with respect to them
    back to the observations and to the policy's parameters.

    Compiled perceptrons keep the activations of each step: computing them again would take a third
    of the backward pass.

    :param n_steps: steps of a flight.
    :param n: rows of each step.
    """

    def __init__(self, policy: ActorCriticPolicy, n_steps: int, n: int) -> None:
        network = network_of(policy)
        self._policy = policy
        self._actor = network.actor if isinstance(network, Perceptrons) else None
        # What the backward pass needs from each step: the activations, or the observations.
        self._activations: Any = {}
        if self._actor:
            self._activations, self._sums = self._actor.allocate(n_steps, n)

    def forward(self, step: int, observations: AnyArray) -> Float32Array:
        """Return the mean actions (n, a) for the observations (n, ...) of a step.

        Step 0 begins a flight, with the parameters as they are then.
        """
        if self._actor:
            if step == 0:
                self._actor.pack()
                self._sums.fill(0.0)
            return self._actor(observations, self._activations[step])
        # A tape may write the next step's observations into the same array.
        self._activations[step] = observations.copy()
        return mean_actions(self._policy, observations)

    def backward(self, step: int, grad_actions: FloatArray) -> Float32Array:
        """Return the gradient with respect to the observations of a step.

        :param grad_actions: the gradient with respect to the actions of the step, (n, a).

        The last step comes first. After step 0, the actor's parameters have their ``.grad``.
        """
        given = grad_actions.astype(np.float32)
        if self._actor:
            grad_observations = self._actor.pullback(self._activations[step], given, self._sums)
            if step == 0:
                self._actor.set_gradients(self._sums)
            shape: Any = self._policy.observation_space.shape
            return grad_observations.reshape(-1, *shape)
        inputs: Any = th.as_tensor(self._activations[step], device=self._policy.device)
        inputs.requires_grad_()
        means = self._policy.get_distribution(inputs).mode()
        means.backward(th.as_tensor(given, device=means.device))  # type: ignore[no-untyped-call]
        return np.asarray(inputs.grad.cpu().numpy())
