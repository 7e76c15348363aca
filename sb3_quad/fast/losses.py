"""The losses of :mod:`sb3_quad.algorithms.losses` compiled, with their derivatives.

They read their targets from rows of numbers. A row for an actor holds, for the terms that the loss
has:

- the cloning term: the expert's action (a);
- the policy term: the action flown (a), its log-probability then, its advantage.

A row for a critic holds V at the time of the rollout, and the return.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import float32

from sb3_quad.algorithms.losses import HUBER_DELTA, MSE_WEIGHT, NEAR, Loss
from sb3_quad.base.compiled import inner

CLONING, POLICY, KL, CLIPPED, TERMS = range(5)
"""Indices of the sums of a compiled actor's loss. A critic's has only one, ``VALUE``."""
VALUE = 0
_HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)


class Numbers(NamedTuple):
    """The weights and constants of a :class:`~sb3_quad.algorithms.losses.Loss`, floats all of them:
    numba would compile again for an int.

    The error of an action is its squared error times ``squared``, plus ``huber`` times the Huber
    loss, or the negative log-likelihood if ``nll`` is not 0. Where the mean squared difference is
    ``nearest`` or more, nothing is cloned. A normalised advantage is (advantage -
    ``advantage_shift``) * ``advantage_scale``.
    """

    policy_coef: float
    clip_range: float
    bc_coef: float
    nll: float
    squared: float
    huber: float
    huber_delta: float
    nearest: float
    vf_coef: float
    clip_range_vf: float
    advantage_shift: float
    advantage_scale: float


def numbers(loss: Loss, advantage_shift: float = 0.0, advantage_scale: float = 1.0) -> Numbers:
    """Return the numbers of a loss."""
    return Numbers(
        policy_coef=float(loss.policy_coef),
        clip_range=float(loss.clip_range),
        bc_coef=float(loss.bc_coef),
        nll=float(loss.bc_loss == "nll"),
        squared=MSE_WEIGHT if loss.bc_loss == "huber_mse" else 1.0,
        huber=float(loss.bc_loss == "huber_mse"),
        huber_delta=HUBER_DELTA,
        nearest=NEAR**2 if loss.bc_filter == "agreement" else math.inf,
        vf_coef=float(loss.vf_coef),
        clip_range_vf=float(loss.clip_range_vf),
        advantage_shift=advantage_shift,
        advantage_scale=advantage_scale,
    )


@inner
def cloning_error(loss, error, log_std):
    """Return the error of one dimension of an action, and its derivatives with respect to mean and
    log_std.

    For all kinds but ``"nll"``, the caller divides the three by the action's dimension.
    """
    if loss.nll != 0.0:
        z = error * math.exp(-log_std)
        return 0.5 * z * z + log_std + _HALF_LOG_2PI, z * math.exp(-log_std), 1.0 - z * z
    value = loss.squared * error * error
    slope = 2.0 * loss.squared * error
    if loss.huber != 0.0:
        delta = loss.huber_delta
        steep = error / delta
        value += 0.5 * error * steep if abs(steep) <= 1.0 else abs(error) - 0.5 * delta
        slope += min(max(steep, -1.0), 1.0)
    return value, slope, 0.0


@inner
def actor_loss(mean, index, first, count, targets, loss, log_std, g, g_log_std, terms):
    """Add an actor's loss over ``count`` rows of a mini-batch, from ``first`` on, to ``terms``.

    Its gradient with respect to the means is added to ``g``, that with respect to log_std to
    ``g_log_std``.

    :param mean: (rows, a or more), and so is ``g``.
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
                squares += (mean[i, k] - target[k]) ** 2
            # Written so that NaN passes through.
            if not squares / a >= loss.nearest:
                share = float(a)
                if loss.nll != 0.0:
                    share = 1.0
                weight = loss.bc_coef / n
                for k in range(a):
                    error = np.float64(mean[i, k]) - target[k]
                    value, slope, slope_log_std = cloning_error(loss, error, log_std[k])
                    terms[CLONING] += value / share
                    g[i, k] += float32(weight * slope / share)
                    g_log_std[k] += weight * slope_log_std
        if loss.policy_coef != 0.0:
            log_prob = 0.0
            for k in range(a):
                z = (np.float64(target[flown + k]) - mean[i, k]) * math.exp(-log_std[k])
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
                    z = (np.float64(target[flown + k]) - mean[i, k]) * inverse
                    g[i, k] += float32(slope * z * inverse)
                    g_log_std[k] += slope * (z * z - 1.0)


@inner
def critic_loss(value, index, first, count, targets, loss, g, terms):
    """Add a critic's loss for values (rows, 1 or more), as :func:`actor_loss` does."""
    n = len(index)
    for i in range(count):
        target = targets[index[first + i]]
        old = np.float64(target[0])
        goal = np.float64(target[1])
        now = np.float64(value[i, 0])
        error = now - goal
        slope = 1.0
        if math.isfinite(loss.clip_range_vf):
            change = now - old
            bounded = min(max(change, -loss.clip_range_vf), loss.clip_range_vf)
            clipped = old + bounded - goal
            if clipped * clipped > error * error:
                error = clipped
                slope = 1.0 if bounded == change else 0.0
        terms[VALUE] += error * error
        g[i, 0] += float32(loss.vf_coef / n * 2.0 * error * slope)
