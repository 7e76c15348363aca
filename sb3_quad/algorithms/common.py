"""What DAgger, PPO and SAC with behavioural cloning share: the terms of Eqs. 4.3 and 4.4, forward passes, being taught.

In shapes, ``b`` is the mini-batch, ``a`` the action dimension. The forward passes leave out what a training step does not
need, and agree with the policy's own methods to rounding.
"""

import inspect
import math
from typing import Any, Literal, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.distributions import DiagGaussianDistribution
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.torch_layers import FlattenExtractor, MlpExtractor
from stable_baselines3.common.type_aliases import Schedule
from torch.nn import functional as F

from sb3_quad.algorithms.networks import LOSS, Perceptron
from sb3_quad.base.arrays import Arrays, Float32Array
from sb3_quad.controllers.controller import Controller

CloningLoss = Literal["mse", "nll", "huber", "huber_mse"]
CLONING_LOSSES: tuple[CloningLoss, ...] = ("mse", "nll", "huber", "huber_mse")
PARTS: tuple[Literal["actor", "critic"], ...] = ("actor", "critic")
HUBER_DELTA = 0.05  # error of an action from which "huber" grows linearly; the range of an action is 2
MSE_WEIGHT = 3.0  # of the squared error in "huber_mse"
AGREEMENT = 0.3  # root mean squared difference of actions up to which "agreement" clones; the range of an action is 2


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


def agree(mean: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """Where policy and expert are near enough to one another for the filter ``"agreement"``, bool (b,)."""
    return (mean - actions).square().mean(dim=1) < AGREEMENT**2


def is_ever_nonzero(schedule: Schedule) -> bool:
    """Whether a schedule gives its term a weight anywhere, as far as a hundred samples of it tell."""
    return any(schedule(progress) for progress in np.linspace(1.0, 0.0, 101).tolist())


def full_signature(stock: type, extended: type) -> inspect.Signature:
    """The parameters of a constructor that hands all but its own keywords on: those of ``stock``, then its own."""
    theirs, ours = (inspect.signature(each.__init__).parameters for each in (stock, extended))  # type: ignore[misc]
    own = [parameter for parameter in ours.values() if parameter.kind is parameter.KEYWORD_ONLY]
    return inspect.Signature([each for name, each in theirs.items() if name not in ours or name == "self"] + own)


class Taught:
    """What an expert teaches, mixed into an algorithm: what the expert remembers from rollout to rollout."""

    expert: Any
    _labeller: Controller | None = None  # the expert, with what it remembers

    def set_expert(self, expert: Any) -> None:
        """Learn from ``expert`` from now on, as a model must that was loaded without one."""
        self.expert = expert

    def _excluded_save_params(self) -> list[str]:
        # Nothing of this package may be pickled: PPO.load must work where it is not installed.
        return [*super()._excluded_save_params(), "expert", "_labeller"]  # type: ignore[misc]

    def memory(self) -> Arrays:
        """What is remembered from rollout to rollout and is in no zip, as :meth:`restore_memory` takes it: by the expert."""
        return {} if self._labeller is None else self._labeller.memory()

    def restore_memory(self, memory: Arrays) -> None:
        """Go back to a :meth:`memory`; the model needs its expert and environment.

        :raises ExpertError: an expert whose memory could not be saved.
        """
        if memory:
            self._labeller = Controller.for_env(self.expert, self.get_env(), self._labeller)  # type: ignore[attr-defined]
            self._labeller.restore(memory)


class Perceptrons(NamedTuple):
    """What a policy consists of, where it is no more than that."""

    actor: Perceptron
    critic: Perceptron
    log_std: th.nn.Parameter


def perceptrons(policy: ActorCriticPolicy) -> Perceptrons | None:
    """The networks of a policy that :mod:`.networks` computes: two perceptrons of their own, a diagonal Gaussian."""
    extractor: Any = policy.mlp_extractor
    if type(extractor) is not MlpExtractor or type(policy.action_dist) is not DiagGaussianDistribution:
        return None
    actor, critic = [*extractor.policy_net, policy.action_net], [*extractor.value_net, policy.value_net]
    plain = type(policy.features_extractor) is FlattenExtractor and policy.observation_space.dtype == np.float32
    n_parameters = 2 * sum(type(layer) is th.nn.Linear for layer in (*actor, *critic)) + 1
    if not (plain and Perceptron.fits(actor) and Perceptron.fits(critic) and n_parameters == len([*policy.parameters()])):
        return None
    return Perceptrons(Perceptron(actor), Perceptron(critic), policy.log_std)


def outputs(
    networks: Perceptrons | None, policy: ActorCriticPolicy, part: Literal["actor", "critic"], observations: Any
) -> Float32Array:
    """What :func:`actor_mean` or :func:`critic_values` give, without gradients; by the ``networks`` if there are any."""
    if networks is not None:
        given = np.ascontiguousarray(observations, dtype=np.float32).reshape(len(observations), -1)
        return networks.actor(given) if part == "actor" else networks.critic(given)[:, 0]
    with th.no_grad():
        tensor = th.as_tensor(observations, device=policy.device)
        result = actor_mean(policy, tensor) if part == "actor" else critic_values(policy, tensor)
        return np.asarray(result.cpu().numpy())


def act(
    networks: Perceptrons, policy: ActorCriticPolicy, observations: th.Tensor, deterministic: bool = False
) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
    """``policy.forward`` in less time: actions (b, a), values (b, 1), log-probabilities (b,); the same random numbers."""
    given = observations.numpy()
    mean, values = (th.from_numpy(outputs(networks, policy, part, given)) for part in PARTS)
    noise = th.zeros_like(mean) if deterministic else th.normal(th.zeros_like(mean), th.ones_like(mean))
    actions = mean + th.exp(policy.log_std.detach()) * noise
    log_prob = -gaussian_nll(mean, policy.log_std.detach(), actions)
    return actions.reshape(-1, *(policy.action_space.shape or ())), values[:, None], log_prob


def actor_terms(kind: CloningLoss, cloning: float, **ppo: float) -> Any:
    """What :meth:`Perceptron.gradient` minimises for an actor.

    :param cloning: weight of the cloning term; :param ppo: those of PPO's term, fields of ``LOSS``.
    """
    return _loss(kind=CLONING_LOSSES.index(kind), cloning=cloning, delta=HUBER_DELTA, mse_weight=MSE_WEIGHT, **ppo)


def critic_terms(weight: float, clip_range: float | None, larger: bool = True) -> Any:
    """The same for a critic: ``weight`` times :func:`value_loss`, or, without ``larger``, SB3's clipped error."""
    return _loss(value=weight, clip_range=np.inf if clip_range is None else clip_range, larger=larger)


def _loss(**fields: float) -> Any:
    loss = np.zeros(1, dtype=LOSS)
    for name, value in fields.items():
        loss[name] = value
    return loss


def add_penalties(policy: ActorCriticPolicy, ent_coef: float, l2_coef: float) -> tuple[float, float]:
    """Add to the gradients those of ``-ent_coef`` H + ``l2_coef`` ½ Σw². Returns -H and ½ Σw²."""
    with th.no_grad():
        if ent_coef != 0.0 and policy.log_std.grad is not None:
            policy.log_std.grad -= ent_coef
        for weights in policy.parameters() if l2_coef != 0.0 else ():
            if weights.ndim > 1 and weights.grad is not None:
                weights.grad += l2_coef * weights
        return -float(gaussian_entropy(policy.log_std)), float(l2_loss(policy))


def actor_mean(policy: ActorCriticPolicy, observations: th.Tensor) -> th.Tensor:
    """Mean of the policy's Gaussian, (b, a), by the actor alone; ``evaluate_actions`` would run the critic too."""
    features = BasePolicy.extract_features(policy, observations, policy.pi_features_extractor)
    mean: th.Tensor = policy.action_net(_latent(policy, "actor", features))
    return mean


def critic_values(policy: ActorCriticPolicy, observations: th.Tensor) -> th.Tensor:
    """``policy.predict_values``, (b,)."""
    features = BasePolicy.extract_features(policy, observations, policy.vf_features_extractor)
    values: th.Tensor = policy.value_net(_latent(policy, "critic", features))
    return values.flatten()


def evaluate_actions(
    policy: ActorCriticPolicy, observations: th.Tensor, actions: th.Tensor
) -> tuple[th.Tensor, th.Tensor, th.Tensor | None, th.Tensor]:
    """``policy.evaluate_actions`` in less time, and the mode of the action distribution.

    :return: values (b,); log-probabilities of ``actions`` (b,); entropy, (b,), or a scalar where it is the same for all, or
        None without a closed form; modes (b, a).
    """
    features: Any = policy.extract_features(observations)
    for_actor, for_critic = (features, features) if policy.share_features_extractor else features
    latent_pi, latent_vf = _latent(policy, "actor", for_actor), _latent(policy, "critic", for_critic)
    values = policy.value_net(latent_vf).flatten()
    if type(policy.action_dist) is DiagGaussianDistribution:
        mean, log_std = policy.action_net(latent_pi), policy.log_std
        return values, -gaussian_nll(mean, log_std, actions), gaussian_entropy(log_std), mean
    distribution = policy._get_action_dist_from_latent(latent_pi)
    return values, distribution.log_prob(actions), distribution.entropy(), distribution.mode()


def _latent(policy: ActorCriticPolicy, part: str, features: th.Tensor) -> th.Tensor:
    """Input of the last layer of the ``actor`` or the ``critic``, (b, latent_dim)."""
    extractor: Any = policy.mlp_extractor
    if type(extractor) is not MlpExtractor:
        return extractor.forward_actor(features) if part == "actor" else extractor.forward_critic(features)  # type: ignore[no-any-return]
    for layer in extractor.policy_net if part == "actor" else extractor.value_net:
        features = _Tanh.apply(features) if type(layer) is th.nn.Tanh else layer(features)  # type: ignore[no-untyped-call]
    return features


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
