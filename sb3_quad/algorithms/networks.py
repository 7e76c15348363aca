"""A policy as an algorithm asks it: mean actions, values and gradients.

PyTorch is the definition. An accelerator may compute the same faster: see
:mod:`sb3_quad.base.plugins`. In shapes, ``b`` is the mini-batch and ``a`` the action dimension.
"""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_quad.algorithms.buffers import Batch
from sb3_quad.algorithms.losses import Loss
from sb3_quad.base.plugins import plugin
from sb3_quad.base.process import available_cpus
from sb3_quad.base.types import AnyArray, Float32Array, FloatArray

Terms = dict[str, float]
"""The terms of a loss without their weights, and ``loss``, their weighted sum, by logged name."""


class Network:
    """A policy, computed by PyTorch. An accelerator is a subclass that gives the same numbers."""

    def __init__(self, policy: ActorCriticPolicy) -> None:
        self.policy = policy

    def means(self, observations: AnyArray) -> Float32Array:
        """Return the means of the policy's Gaussian, (b, a), without gradients."""
        inputs = th.as_tensor(observations, device=self.policy.device)
        with th.no_grad(), one_thread_by_default():
            means = self.policy.get_distribution(inputs).mode()
        return np.asarray(means.cpu().numpy())

    def values(self, observations: AnyArray) -> Float32Array:
        """Return V of observations, (b,), without gradients."""
        inputs = th.as_tensor(observations, device=self.policy.device)
        with th.no_grad(), one_thread_by_default():
            values = self.policy.predict_values(inputs)
        return np.asarray(values.flatten().cpu().numpy())

    def gradients(self, loss: Loss, actor: Batch, critic: Batch | None) -> Terms | None:
        """Set ``.grad`` of every parameter to the gradient of a loss; return the loss's terms.

        None: nothing was computed. The algorithm then differentiates its own loss by PyTorch, as
        always in this class.

        :param critic: mini-batch of the value loss. None: no value loss.
        """
        return None

    def recorded(self, n_steps: int, n: int) -> "RecordedPolicy":
        """Return what flies ``n_steps`` steps of n rows and carries gradients back through them."""
        return RecordedPolicy(self.policy)

    def acting(self) -> AbstractContextManager[None]:
        """Return a context in which the accelerator computes ``policy(observations)``, or PyTorch
        with one thread, unless it was given another number.
        """
        return one_thread_by_default()

    def learning(self) -> AbstractContextManager[None]:
        """Return a context in which an accelerator may use the threads that are PyTorch's."""
        return nullcontext()


class RecordedPolicy:
    """Computes a policy's mean actions step by step, and carries gradients with respect to them
    back to the observations and to the policy's parameters.
    """

    def __init__(self, policy: ActorCriticPolicy) -> None:
        self._policy = policy
        self._network = Network(policy)
        self._observations: dict[int, AnyArray] = {}

    def forward(self, step: int, observations: AnyArray) -> Float32Array:
        """Return the mean actions (n, a) for the observations (n, ...) of a step.

        Step 0 begins a flight, with the parameters as they are then.
        """
        # A tape may write the next step's observations into the same array.
        self._observations[step] = observations.copy()
        return self._network.means(observations)

    def backward(self, step: int, grad_actions: FloatArray) -> Float32Array:
        """Return the gradient with respect to the observations of a step.

        :param grad_actions: the gradient with respect to the actions of the step, (n, a).

        The last step comes first. After step 0, the actor's parameters have their ``.grad``.
        """
        inputs: Any = th.as_tensor(self._observations[step], device=self._policy.device)
        inputs.requires_grad_()
        means = self._policy.get_distribution(inputs).mode()
        given = th.as_tensor(grad_actions.astype(np.float32), device=means.device)
        means.backward(given)  # type: ignore[no-untyped-call]
        return np.asarray(inputs.grad.cpu().numpy())


def network_of(policy: Any) -> Network:
    """Return the fastest implementation of a policy."""
    accelerated: Network | None = plugin("accelerate")(policy)
    return accelerated or Network(policy)


@contextmanager
def one_thread() -> Iterator[None]:
    """Give PyTorch one thread for the duration of the block.

    Its threads wait for one another at every operation: over networks of 64 to 256 units that is
    hardly faster than one, and while another process runs it takes several times as long.
    """
    threads = th.get_num_threads()
    th.set_num_threads(1)
    try:
        yield
    finally:
        th.set_num_threads(threads)


def one_thread_by_default() -> AbstractContextManager[None]:
    """Like :func:`one_thread`, but leave a number that ``torch.set_num_threads`` was given.

    By itself PyTorch takes a thread for each CPU, or for each core, which may be half as many.
    """
    cpus = available_cpus()
    return one_thread() if th.get_num_threads() in (cpus, cpus // 2) else nullcontext()
