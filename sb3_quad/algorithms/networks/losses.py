"""The losses of Eqs. 4.3 and 4.4, each as tensors for PyTorch's autograd and, beside it, compiled
with its derivatives.

In shapes, ``b`` is the mini-batch, ``a`` the action dimension. A target is a row of numbers. Of an
actor: the expert's action, if there is a cloning term; then, if there is a policy term, the action
flown, its log-probability then, and its advantage; or then, if there is an auxiliary term, what the
first units of a hidden layer are to say. Of a critic: V when the rollout was flown, and the return.
"""

import math
from typing import Literal, NamedTuple

import numpy as np
import torch as th
from numba import float32
from torch.nn import functional as F

from sb3_quad.simulation.compiled import compiled

CloningLoss = Literal["mse", "nll", "huber", "huber_mse"]
CLONING_LOSSES: tuple[CloningLoss, ...] = ("mse", "nll", "huber", "huber_mse")
MSE, NLL, HUBER, HUBER_MSE = range(4)
BC_FILTERS = ("none", "agreement")
AGREEMENT = 1
HUBER_DELTA = (
    0.05  # error of an action from which "huber" grows linearly; the range of an action is 2
)
MSE_WEIGHT = 3.0  # of the squared error in "huber_mse"
# Root mean squared difference of actions up to which "agreement" clones; the range of an action
# is 2
NEAR = 0.3
CLONING, POLICY, KL, CLIPPED, AUXILIARY, TERMS = range(6)
"""What compiled losses add up: terms of the actor. A critic has one only, ``VALUE``."""
VALUE = 0
_HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)


class Loss(NamedTuple):
    """Weights and constants of a loss, under the names of the algorithms' arguments.

    ``policy_coef`` weighs PPO's clipped surrogate. ``bc_loss`` and ``bc_filter`` are places in
    ``CLONING_LOSSES`` and ``BC_FILTERS``. ``aux_layer`` counts hidden layers from 1; 0: no
    auxiliary term. An infinite ``clip_range_vf`` clips nothing. Normalised, an advantage is
    (advantage - ``advantage_shift``) * ``advantage_scale``.
    """

    policy_coef: float = 0.0
    clip_range: float = 0.2
    normalize_advantage: bool = False
    bc_coef: float = 0.0
    bc_loss: int = MSE
    bc_filter: int = 0
    vf_coef: float = 0.0
    clip_range_vf: float = math.inf
    max_clipped_value: bool = True
    ent_coef: float = 0.0
    l2_coef: float = 0.0
    aux_coef: float = 0.0
    aux_layer: int = 0
    advantage_shift: float = 0.0
    advantage_scale: float = 1.0


def cloning_errors(
    kind: CloningLoss, mean: th.Tensor, log_std: th.Tensor, actions: th.Tensor
) -> th.Tensor:
    """How far the policy is from the expert's ``actions`` (b, a), by row, (b,); L_BC is the mean
    over the rows.

    ``"nll"``: Eq. 3.12, the negative log-likelihood, a sum over the action's dimensions; it also
    shrinks the standard deviation towards the error that is left. The others are means over the
    dimensions and leave the deviation alone. ``"mse"``: squared. ``"huber"``: half the squared
    error up to 0.05, linear beyond, in units of 0.05: a tumble, where little can be learnt from
    noise, takes less of the gradient. ``"huber_mse"``: that and three times the squared error.
    """
    if kind == "nll":
        return gaussian_nll(mean, log_std, actions)
    squared = (mean - actions).square().mean(dim=1)
    if kind == "mse":
        return squared
    huber = (
        F.huber_loss(mean, actions, delta=HUBER_DELTA, reduction="none").mean(dim=1) / HUBER_DELTA
    )
    return huber if kind == "huber" else huber + MSE_WEIGHT * squared


@compiled
def cloning_error(kind, error, log_std):
    """The same compiled, for one dimension of an action: its error, and the derivatives of that by
    mean and by log_std.

    But for ``"nll"``, all three are yet to be divided by the action's dimension.
    """
    if kind == NLL:
        z = error * math.exp(-log_std)
        return 0.5 * z * z + log_std + _HALF_LOG_2PI, z * math.exp(-log_std), 1.0 - z * z
    weight = 1.0 if kind == MSE else MSE_WEIGHT if kind == HUBER_MSE else 0.0
    value, slope = weight * error * error, 2.0 * weight * error
    if kind in (HUBER, HUBER_MSE):
        steep = error / HUBER_DELTA
        value += 0.5 * error * steep if abs(steep) <= 1.0 else abs(error) - 0.5 * HUBER_DELTA
        slope += min(max(steep, -1.0), 1.0)
    return value, slope, 0.0


def gaussian_nll(mean: th.Tensor, log_std: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """-log π(a|s) of a diagonal Gaussian, (b,), summed over the action's dimensions."""
    scaled = (actions - mean) * th.exp(-log_std)
    return (0.5 * scaled.square() + log_std + _HALF_LOG_2PI).sum(dim=1)


def gaussian_entropy(log_std: th.Tensor) -> th.Tensor:
    """H of a diagonal Gaussian, a scalar: the same in every state, because the standard deviation
    is (Eq. 4.2).
    """
    return (log_std + 0.5 + _HALF_LOG_2PI).sum()


def agree(mean: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """Where policy and expert are near enough to one another for the filter ``"agreement"``, bool
    (b,).
    """
    return (mean - actions).square().mean(dim=1) < NEAR**2


def value_loss(
    values: th.Tensor, old_values: th.Tensor, returns: th.Tensor, loss: Loss
) -> th.Tensor:
    """The critic's loss, a scalar, of (b,) each: V(s) now, V(s) when the rollout was flown, and Ĝ
    of Eq. 3.11.

    Clipped by ``clip_range_vf``, it is SB3's. With ``max_clipped_value`` it is Eq. 3.8, the larger
    of the clipped and the unclipped error, so that leaving the clip range is never rewarded.
    """
    if math.isinf(loss.clip_range_vf):
        return F.mse_loss(returns, values)
    clipped = old_values + (values - old_values).clamp(-loss.clip_range_vf, loss.clip_range_vf)
    if not loss.max_clipped_value:
        return F.mse_loss(returns, clipped)
    return th.max((values - returns).square(), (clipped - returns).square()).mean()


def l2_loss(parameters: list[th.nn.Parameter]) -> th.Tensor:
    """½ Σ w² over the weight matrices of actor and critic (Eq. 2.25), a scalar; biases and log_std
    are left out.
    """
    return (
        0.5 * th.stack([weights.square().sum() for weights in parameters if weights.ndim > 1]).sum()
    )


@compiled
def actor_loss(mean, index, first, count, targets, loss, log_std, g, g_log_std, terms):
    """Of ``count`` rows of a mini-batch from ``first`` on: adds to the gradient by the means and by
    log_std, and to the terms.

    :param mean: (a, ROWS), and so is ``g``.
    """
    n, a = len(index), len(log_std)
    flown = targets.shape[1] - a - 2  # the first of the policy term's columns
    for i in range(count):
        target = targets[index[first + i]]
        if loss.bc_coef != 0.0:
            squares = 0.0
            for k in range(a):
                squares += (mean[k, i] - target[k]) ** 2
            if loss.bc_filter != AGREEMENT or squares / a < NEAR**2:
                share = 1.0 if loss.bc_loss == NLL else float(a)
                for k in range(a):
                    error = np.float64(mean[k, i]) - target[k]
                    value, slope, slope_log_std = cloning_error(loss.bc_loss, error, log_std[k])
                    terms[CLONING] += value / share
                    g[k, i] += float32(loss.bc_coef / n * slope / share)
                    g_log_std[k] += loss.bc_coef / n * slope_log_std
        if loss.policy_coef != 0.0:
            log_prob = 0.0
            for k in range(a):
                z = (np.float64(target[flown + k]) - mean[k, i]) * math.exp(-log_std[k])
                log_prob -= 0.5 * z * z + log_std[k] + _HALF_LOG_2PI
            change = log_prob - target[flown + a]
            ratio = math.exp(change)
            advantage = (target[flown + a + 1] - loss.advantage_shift) * loss.advantage_scale
            bounded = min(max(ratio, 1.0 - loss.clip_range), 1.0 + loss.clip_range)
            terms[POLICY] -= min(advantage * ratio, advantage * bounded)
            terms[KL] += ratio - 1.0 - change
            terms[CLIPPED] += abs(ratio - 1.0) > loss.clip_range
            if not advantage * ratio > advantage * bounded:  # NaN, too, goes on
                slope = -loss.policy_coef / n * advantage * ratio
                for k in range(a):
                    z = (np.float64(target[flown + k]) - mean[k, i]) * math.exp(-log_std[k])
                    g[k, i] += float32(slope * z * math.exp(-log_std[k]))
                    g_log_std[k] += slope * (z * z - 1.0)


@compiled
def auxiliary_loss(hidden, index, first, count, targets, loss, a, g, terms):
    """As :func:`actor_loss`, for a hidden layer (width, ROWS), whose first units are to say what
    follows the action.
    """
    k = targets.shape[1] - a
    for i in range(count):
        target = targets[index[first + i]]
        for j in range(k):
            value, slope, _ = cloning_error(
                HUBER_MSE, np.float64(hidden[j, i]) - target[a + j], 0.0
            )
            terms[AUXILIARY] += value / k
            g[j, i] += float32(loss.aux_coef / len(index) * slope / k)


@compiled
def critic_loss(value, index, first, count, targets, loss, g, terms):
    """As :func:`actor_loss`, for values (1, ROWS)."""
    n = len(index)
    for i in range(count):
        target = targets[index[first + i]]
        old, goal, now = np.float64(target[0]), np.float64(target[1]), np.float64(value[0, i])
        bounded = old + min(max(now - old, -loss.clip_range_vf), loss.clip_range_vf)
        error, clipped = now - goal, bounded - goal
        inside = 1.0 if abs(now - old) <= loss.clip_range_vf else 0.0
        if loss.max_clipped_value and not clipped * clipped > error * error:
            clipped, inside = error, 1.0
        if not math.isfinite(loss.clip_range_vf):
            clipped, inside = error, 1.0
        terms[VALUE] += clipped * clipped
        g[0, i] += float32(loss.vf_coef / n * 2.0 * clipped * inside)
