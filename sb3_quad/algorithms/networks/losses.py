"""The losses of Eqs. 4.3 and 4.4: tensors for autograd, and the same compiled with derivatives.

In shapes, ``b`` is the mini-batch, ``a`` the action dimension. Compiled losses read their targets
from rows of numbers. A row for an actor holds, for the terms that the loss has:

- the cloning term: the expert's action (a);
- the policy term: the action flown (a), its log-probability then, its advantage.

A row for a critic holds V at the time of the rollout, and the return.
"""

import math
from typing import Literal, NamedTuple, get_args

import numpy as np
import torch as th
from numba import float32
from torch.nn import functional as F

from sb3_quad.base.compiled import compiled

CloningLoss = Literal["mse", "nll", "huber", "huber_mse"]
CLONING_LOSSES: tuple[CloningLoss, ...] = get_args(CloningLoss)
MSE, NLL, HUBER, HUBER_MSE = range(4)
CloningFilter = Literal["none", "agreement", "q"]
BC_FILTERS: tuple[CloningFilter, ...] = get_args(CloningFilter)
"""Where to clone. ``"q"`` needs critics of actions, which only SACBC has."""
AGREEMENT = BC_FILTERS.index("agreement")
# Actions span 2. "huber" is linear beyond this error.
HUBER_DELTA = 0.05
# Weight of the squared error in "huber_mse".
MSE_WEIGHT = 3.0
# Weight of the squared error in MSE, NLL, HUBER and HUBER_MSE.
_SQUARED = (1.0, 0.0, 0.0, MSE_WEIGHT)
# "agreement" clones up to this root mean squared difference of actions.
NEAR = 0.3
CLONING, POLICY, KL, CLIPPED, TERMS = range(5)
"""Indices of the sums of a compiled actor's loss. A critic's has only one, ``VALUE``."""
VALUE = 0
_HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)


class Loss(NamedTuple):
    """Weights and constants of a compiled loss, under the names of the algorithms' arguments.

    ``policy_coef`` weighs PPO's clipped surrogate. ``bc_loss`` and ``bc_filter`` are indices of
    ``CLONING_LOSSES`` and ``BC_FILTERS``. An infinite ``clip_range_vf`` clips nothing. A normalised
    advantage is (advantage - ``advantage_shift``) * ``advantage_scale``.
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
    advantage_shift: float = 0.0
    advantage_scale: float = 1.0


WEIGHTS = {
    "policy_gradient_loss": "policy_coef",
    "bc_loss": "bc_coef",
    "value_loss": "vf_coef",
    "entropy_loss": "ent_coef",
    "l2_loss": "l2_coef",
}
"""The weight of each term, by the term's logged name."""


def cloning_errors(
    kind: CloningLoss, mean: th.Tensor, log_std: th.Tensor, actions: th.Tensor
) -> th.Tensor:
    """Return how far the policy is from the expert's ``actions`` (b, a), for each row, (b,).

    L_BC is the mean over the rows. ``"nll"`` is Eq. 3.12, the negative log-likelihood, a sum over
    the action's dimensions; it also shrinks the standard deviation towards the remaining error. The
    others are means over the dimensions and leave the deviation alone. ``"mse"``: squared.
    ``"huber"``: half the squared error up to 0.05, linear beyond, in units of 0.05. Tumbling, where
    errors are large and mostly noise, then dominates the gradient less. ``"huber_mse"``: the same
    plus three times the squared error.
    """
    if kind == "nll":
        return gaussian_nll(mean, log_std, actions)
    squared = (mean - actions).square().mean(dim=1)
    if kind == "mse":
        return squared
    errors = F.huber_loss(mean, actions, delta=HUBER_DELTA, reduction="none")
    huber = errors.mean(dim=1) / HUBER_DELTA
    return huber if kind == "huber" else huber + MSE_WEIGHT * squared


@compiled
def cloning_error(kind, error, log_std):
    """Return the error of one dimension of an action, and its derivatives with respect to mean and
    log_std.

    It is :func:`cloning_errors` compiled. For all kinds but ``"nll"``, the caller divides the three
    by the action's dimension.
    """
    if kind == NLL:
        z = error * math.exp(-log_std)
        return 0.5 * z * z + log_std + _HALF_LOG_2PI, z * math.exp(-log_std), 1.0 - z * z
    weight = _SQUARED[int(kind)]
    value = weight * error * error
    slope = 2.0 * weight * error
    if kind != MSE:
        steep = error / HUBER_DELTA
        value += 0.5 * error * steep if abs(steep) <= 1.0 else abs(error) - 0.5 * HUBER_DELTA
        slope += min(max(steep, -1.0), 1.0)
    return value, slope, 0.0


def gaussian_nll(mean: th.Tensor, log_std: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """Return -log π(a|s) of a diagonal Gaussian, (b,), summed over the action's dimensions."""
    scaled = (actions - mean) * th.exp(-log_std)
    return (0.5 * scaled.square() + log_std + _HALF_LOG_2PI).sum(dim=1)


def gaussian_entropy(log_std: th.Tensor) -> th.Tensor:
    """Return H of a diagonal Gaussian, a scalar.

    It is the same in every state because the standard deviation is (Eq. 4.2).
    """
    return (log_std + 0.5 + _HALF_LOG_2PI).sum()


def agree(mean: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """Return where policy and expert are near enough for the filter ``"agreement"``, bool (b,)."""
    return (mean - actions).square().mean(dim=1) < NEAR**2


def max_clipped_value_loss(
    values: th.Tensor, old_values: th.Tensor, returns: th.Tensor, clip_range: float
) -> th.Tensor:
    """Return the critic's loss by Eq. 3.8, a scalar: the larger of clipped and unclipped error.

    Leaving the clip range is thus never rewarded.

    :param values: V(s) now, (b,).
    :param old_values: V(s) when the rollout was flown, (b,).
    :param returns: Ĝ of Eq. 3.11, (b,).
    """
    clipped = old_values + th.clamp(values - old_values, -clip_range, clip_range)
    return th.max((values - returns).square(), (clipped - returns).square()).mean()


def l2_loss(parameters: list[th.nn.Parameter]) -> th.Tensor:
    """Return ½ Σ w² over the weight matrices of actor and critic (Eq. 2.25), a scalar.

    Biases and log_std are excluded.
    """
    sums = [weights.square().sum() for weights in parameters if weights.ndim > 1]
    return 0.5 * th.stack(sums).sum()


@compiled
def actor_loss(mean, index, first, count, targets, loss, log_std, g, g_log_std, terms):
    """Add an actor's loss over ``count`` rows of a mini-batch, from ``first`` on, to ``terms``.

    Its gradient with respect to the means is added to ``g``, that with respect to log_std to
    ``g_log_std``.

    :param mean: (a, ROWS), and so is ``g``.
    """
    n = len(index)
    a = len(log_std)
    # The first column of the policy term.
    flown = targets.shape[1] - a - 2
    for i in range(count):
        target = targets[index[first + i]]
        if loss.bc_coef != 0.0:
            squares = 0.0
            for k in range(a):
                squares += (mean[k, i] - target[k]) ** 2
            if loss.bc_filter != AGREEMENT or squares / a < NEAR**2:
                share = 1.0 if loss.bc_loss == NLL else float(a)
                weight = loss.bc_coef / n
                for k in range(a):
                    error = np.float64(mean[k, i]) - target[k]
                    value, slope, slope_log_std = cloning_error(loss.bc_loss, error, log_std[k])
                    terms[CLONING] += value / share
                    g[k, i] += float32(weight * slope / share)
                    g_log_std[k] += weight * slope_log_std
        if loss.policy_coef != 0.0:
            log_prob = 0.0
            for k in range(a):
                z = (np.float64(target[flown + k]) - mean[k, i]) * math.exp(-log_std[k])
                log_prob -= 0.5 * z * z + log_std[k] + _HALF_LOG_2PI
            change = log_prob - target[flown + a]
            ratio = math.exp(change)
            advantage = (target[flown + a + 1] - loss.advantage_shift) * loss.advantage_scale
            bounded = min(max(ratio, 1.0 - loss.clip_range), 1.0 + loss.clip_range)
            gain = advantage * ratio
            least = min(gain, advantage * bounded)
            terms[POLICY] -= least
            terms[KL] += ratio - 1.0 - change
            terms[CLIPPED] += abs(ratio - 1.0) > loss.clip_range
            # Written so that NaN passes through, too.
            if not gain > least:
                slope = -loss.policy_coef / n * advantage * ratio
                for k in range(a):
                    inverse = math.exp(-log_std[k])
                    z = (np.float64(target[flown + k]) - mean[k, i]) * inverse
                    g[k, i] += float32(slope * z * inverse)
                    g_log_std[k] += slope * (z * z - 1.0)


@compiled
def critic_loss(value, index, first, count, targets, loss, g, terms):
    """Add a critic's loss for values (1, ROWS), as :func:`actor_loss` does."""
    n = len(index)
    for i in range(count):
        target = targets[index[first + i]]
        old = np.float64(target[0])
        goal = np.float64(target[1])
        now = np.float64(value[0, i])
        error = now - goal
        slope = 1.0
        if math.isfinite(loss.clip_range_vf):
            change = now - old
            bounded = min(max(change, -loss.clip_range_vf), loss.clip_range_vf)
            clipped = old + bounded - goal
            if not loss.max_clipped_value or clipped * clipped > error * error:
                error = clipped
                slope = 1.0 if bounded == change else 0.0
        terms[VALUE] += error * error
        g[0, i] += float32(loss.vf_coef / n * 2.0 * error * slope)
