"""Policies of two perceptrons, whose losses compiled code differentiates.

In shapes, ``b`` is the mini-batch and ``a`` the action dimension.
"""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.distributions import DiagGaussianDistribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor, MlpExtractor

from sb3_quad.algorithms.buffers import Batch
from sb3_quad.algorithms.losses import Loss, gaussian_entropy, gaussian_nll, l2_loss
from sb3_quad.algorithms.networks import Network, RecordedPolicy, Terms
from sb3_quad.base.types import AnyArray, Float32Array, FloatArray
from sb3_quad.fast import losses
from sb3_quad.fast.perceptron import Perceptron, one_torch_thread

WEIGHTS = {
    "policy_gradient_loss": "policy_coef",
    "bc_loss": "bc_coef",
    "value_loss": "vf_coef",
    "entropy_loss": "ent_coef",
    "l2_loss": "l2_coef",
}
"""The weight of each term, by the term's logged name."""


def accelerate(policy: Any) -> "Perceptrons | None":
    """Return a compiled implementation of a policy, or None if there is none.

    There is one if an ``MlpPolicy`` on the CPU consists of two separate perceptrons with tanh or
    ReLU and a diagonal Gaussian, and observes a Box of float32.

    :param policy: a policy of PPO or A2C, whose parameters stay PyTorch's.
    """
    # A subclass may compute something else.
    if (
        type(policy) is not ActorCriticPolicy
        or type(policy.mlp_extractor) is not MlpExtractor
        or type(policy.action_dist) is not DiagGaussianDistribution
        or type(policy.features_extractor) is not FlattenExtractor
        or policy.observation_space.dtype != np.float32
    ):
        return None
    extractor: Any = policy.mlp_extractor
    actor = [*extractor.policy_net, policy.action_net]
    critic = [*extractor.value_net, policy.value_net]
    if not (Perceptron.fits(actor) and Perceptron.fits(critic) and policy.log_std.requires_grad):
        return None
    network = Perceptrons(policy, Perceptron(actor), Perceptron(critic))
    # PyTorch computes a policy with further parameters, or with layers that actor and critic share.
    if len(network.parameters()) != len([*policy.parameters()]):
        return None
    return network


class Perceptrons(Network):
    """A policy that consists of two perceptrons and a diagonal Gaussian."""

    def __init__(self, policy: ActorCriticPolicy, actor: Perceptron, critic: Perceptron) -> None:
        super().__init__(policy)
        self.actor = actor
        self.critic = critic
        self.log_std: Any = policy.log_std

    def parameters(self) -> list[th.nn.Parameter]:
        """Return the policy's parameters."""
        return [*self.actor.parameters(), *self.critic.parameters(), self.log_std]

    def means(self, observations: AnyArray) -> Float32Array:
        return self.actor(observations)

    def values(self, observations: AnyArray) -> Float32Array:
        return self.critic(observations)[:, 0]

    def gradients(self, loss: Loss, actor: Batch, critic: Batch | None) -> Terms:
        """Set ``.grad`` of every parameter to what ``loss.backward()`` computes in ``PPOBC.train``
        and ``DAgger.train``, to rounding.

        :return: the terms that were computed; NaN for a policy that is no longer finite.
        """
        numbers = losses.numbers(loss)
        if loss.policy_coef != 0.0 and loss.normalize_advantage and len(actor.rows) > 1:
            advantages = actor.targets[actor.rows, -1]
            scale = 1.0 / (float(advantages.std(ddof=1)) + 1e-8)
            numbers = losses.numbers(loss, float(advantages.mean()), scale)
        means = self.actor.gradient(actor, numbers, self.log_std)
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
            terms["value_loss"] = self.critic.gradient(critic, numbers)[losses.VALUE]
        # The gradients of the entropy and of the L2 term are written out here.
        with th.no_grad():
            terms["entropy_loss"] = -float(gaussian_entropy(self.log_std))
            self.log_std.grad -= loss.ent_coef
            if loss.l2_coef != 0.0:
                terms["l2_loss"] = float(l2_loss(self.parameters()))
                for weights in self.parameters():
                    if weights.ndim > 1:
                        weights.grad += loss.l2_coef * weights  # type: ignore[operator]
        total = sum(
            getattr(loss, coefficient) * terms.get(name, 0.0)
            for name, coefficient in WEIGHTS.items()
        )
        return {"loss": total, **terms}

    def recorded(self, n_steps: int, n: int) -> "RecordedPerceptron":
        return RecordedPerceptron(self, n_steps, n)

    @contextmanager
    def acting(self) -> Iterator[None]:
        self.policy.forward = _Forward(self)  # type: ignore[method-assign, assignment]
        try:
            yield
        finally:
            del self.policy.forward

    def learning(self) -> AbstractContextManager[None]:
        return one_torch_thread()


class _Forward:
    """Stands in for the ``forward`` of a policy, and draws the same random numbers."""

    def __init__(self, network: Perceptrons) -> None:
        self._network = network
        self._stock: Any = network.policy.forward

    def __call__(
        self, observations: th.Tensor, deterministic: bool = False
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """Return sampled actions (b, ...), values (b, 1) and log-probabilities (b,)."""
        if deterministic:
            return self._stock(observations, True)  # type: ignore[no-any-return]
        network = self._network
        array = observations.numpy()
        mean = th.from_numpy(network.means(array))
        values = th.from_numpy(network.values(array))[:, None]
        noise = th.normal(th.zeros_like(mean), th.ones_like(mean))
        actions = mean + th.exp(network.log_std) * noise
        log_prob = -gaussian_nll(mean, network.log_std, actions)
        shape: Any = network.policy.action_space.shape
        return actions.reshape(-1, *shape), values, log_prob

    def __reduce_ex__(self, protocol: Any) -> Any:
        # If a callback copies or saves the policy, the copy has the stock forward pass.
        return self._stock.__reduce_ex__(protocol)


class RecordedPerceptron(RecordedPolicy):
    """Keeps the activations of each step: computing them again would take a third of the backward
    pass.

    :param n_steps: steps of a flight.
    :param n: rows of each step.
    """

    def __init__(self, network: Perceptrons, n_steps: int, n: int) -> None:
        super().__init__(network.policy)
        self._actor = network.actor
        self._activations, self._sums = network.actor.allocate(n_steps, n)

    def forward(self, step: int, observations: AnyArray) -> Float32Array:
        if step == 0:
            self._actor.pack()
            self._sums.fill(0.0)
        return self._actor(observations, self._activations[step])

    def backward(self, step: int, grad_actions: FloatArray) -> Float32Array:
        given = grad_actions.astype(np.float32)
        grad_observations = self._actor.pullback(self._activations[step], given, self._sums)
        if step == 0:
            self._actor.set_gradients(self._sums)
        shape: Any = self._policy.observation_space.shape
        return grad_observations.reshape(-1, *shape)
