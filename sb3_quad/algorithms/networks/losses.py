"""The losses of Eqs. 4.3 and 4.4, row by row and compiled, with their derivatives: those of :mod:`..common` and of PPO.

A target is a row of numbers: for a critic its ``VALUE_COLUMNS``; for an actor the expert's action if there is a cloning term,
then, if there is a policy term, the action flown, its log-probability then, and its advantage.
"""

import math

import numpy as np
from numba import float32

from sb3_quad.simulation.compiled import compiled

KINDS = ("mse", "nll", "huber", "huber_mse")
FILTERS = ("none", "negative_advantage", "agreement")
LOSS = np.dtype(
    [
        *(("kind", "i8"), ("filter", "i8")),  # of the cloning term, a row of the tuples above
        *(("cloning", "f8"), ("labelled", "?")),  # its weight, 0 for none; and whether there are labels, even so
        *(("delta", "f8"), ("mse_weight", "f8"), ("agreement", "f8")),  # constants of it
        *(("policy", "f8"), ("clip_range", "f8")),  # weight of PPO's term, 0 for none; ε of an actor or a critic, inf for none
        *(("shift", "f8"), ("scale", "f8")),  # what normalises advantages: (advantage - shift) * scale
        *(("value", "f8"), ("larger", "i8")),  # weight of a critic's loss; whether it is clipped as in Eq. 3.8, or as SB3 does
    ]
)
VALUE_COLUMNS = ("old_value", "return")
CLONING, POLICY, KL, CLIPPED, TERMS = range(5)
VALUE = 0
"""What is added up: terms of the actor, or the critic's only one. Losses without their weights; approximate KL divergence."""
_HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)


@compiled
def actor_loss(mean, index, first, count, targets, loss, log_std, g, g_log_std, terms):
    """Of ``count`` rows of a mini-batch from ``first`` on: adds to the gradient by the means and by log_std, and to the terms.

    :param mean: (a, ROWS), and so is ``g``; :param loss: of dtype LOSS, (1,).
    """
    c, n, a = loss[0], len(index), len(log_std)
    flown = a if c.labelled else 0
    for i in range(count):
        target = targets[index[first + i]]
        if c.cloning != 0.0:
            squares = 0.0
            for k in range(a):
                squares += (mean[k, i] - target[k]) ** 2
            if c.filter == 1:
                taken = target[flown + a + 1] < 0.0
            else:
                taken = c.filter == 0 or squares / a < c.agreement**2
            if taken:
                for k in range(a):
                    error = np.float64(mean[k, i]) - target[k]
                    if c.kind == 1:  # nll, a sum
                        z = error * math.exp(-log_std[k])
                        terms[CLONING] += 0.5 * z * z + log_std[k] + _HALF_LOG_2PI
                        g[k, i] += float32(c.cloning / n * z * math.exp(-log_std[k]))
                        g_log_std[k] += c.cloning / n * (1.0 - z * z)
                        continue
                    weight = 1.0 if c.kind == 0 else c.mse_weight if c.kind == 3 else 0.0
                    slope, value = 2.0 * weight * error, weight * error * error
                    if c.kind >= 2:
                        steep = error / c.delta
                        value += 0.5 * error * steep if abs(steep) <= 1.0 else abs(error) - 0.5 * c.delta
                        slope += min(max(steep, -1.0), 1.0)
                    terms[CLONING] += value / a
                    g[k, i] += float32(c.cloning / n * slope / a)
        if c.policy != 0.0:
            log_prob = 0.0
            for k in range(a):
                z = (np.float64(target[flown + k]) - mean[k, i]) * math.exp(-log_std[k])
                log_prob -= 0.5 * z * z + log_std[k] + _HALF_LOG_2PI
            change = log_prob - target[flown + a]
            ratio = math.exp(change)
            advantage = (target[flown + a + 1] - c.shift) * c.scale
            bounded = min(max(ratio, 1.0 - c.clip_range), 1.0 + c.clip_range)
            terms[POLICY] -= min(advantage * ratio, advantage * bounded)
            terms[KL] += ratio - 1.0 - change
            terms[CLIPPED] += abs(ratio - 1.0) > c.clip_range
            if not advantage * ratio > advantage * bounded:  # NaN, too, goes on
                slope = -c.policy / n * advantage * ratio
                for k in range(a):
                    z = (np.float64(target[flown + k]) - mean[k, i]) * math.exp(-log_std[k])
                    g[k, i] += float32(slope * z * math.exp(-log_std[k]))
                    g_log_std[k] += slope * (z * z - 1.0)


@compiled
def critic_loss(value, index, first, count, targets, loss, g, terms):
    """As :func:`actor_loss`, for values (1, ROWS); :param loss: of dtype LOSS, (1,)."""
    c, n = loss[0], len(index)
    for i in range(count):
        target = targets[index[first + i]]
        old, goal, now = np.float64(target[0]), np.float64(target[1]), np.float64(value[0, i])
        bounded = old + min(max(now - old, -c.clip_range), c.clip_range)
        error, clipped = now - goal, bounded - goal
        inside = 1.0 if abs(now - old) <= c.clip_range else 0.0
        if c.larger != 0 and not clipped * clipped > error * error:
            clipped, inside = error, 1.0
        if not math.isfinite(c.clip_range):
            clipped, inside = error, 1.0
        terms[VALUE] += clipped * clipped
        g[0, i] += float32(c.value / n * 2.0 * clipped * inside)
