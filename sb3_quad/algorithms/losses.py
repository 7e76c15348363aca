"""The losses of Eqs. 4.3 and 4.4.

In shapes, ``b`` is the mini-batch, ``a`` the action dimension.
"""

import math
from typing import Literal, NamedTuple

import torch as th
from torch.nn import functional as F

CloningLoss = Literal["mse", "nll", "huber_mse"]
CloningFilter = Literal["none", "agreement"]
# Actions span 2. "huber_mse" has a linear part beyond this error.
HUBER_DELTA = 0.05
# Weight of the squared error in "huber_mse".
MSE_WEIGHT = 3.0
# "agreement" clones up to this root mean squared difference of actions.
NEAR = 0.3
HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)


class Loss(NamedTuple):
    """A loss as an accelerator computes it, under the names of the algorithms' arguments.

    ``policy_coef`` weighs PPO's clipped surrogate. An infinite ``clip_range_vf`` clips nothing.
    """

    policy_coef: float = 0.0
    clip_range: float = 0.2
    normalize_advantage: bool = False
    bc_coef: float = 0.0
    bc_loss: CloningLoss = "mse"
    bc_filter: CloningFilter = "none"
    vf_coef: float = 0.0
    clip_range_vf: float = math.inf
    ent_coef: float = 0.0
    l2_coef: float = 0.0


def cloning_errors(
    kind: CloningLoss, mean: th.Tensor, log_std: th.Tensor, actions: th.Tensor
) -> th.Tensor:
    """Return how far the policy is from the expert's ``actions`` (b, a), for each row, (b,).

    L_BC is the mean over the rows. ``"nll"`` is Eq. 3.12, the negative log-likelihood, a sum over
    the action's dimensions; it also shrinks the standard deviation towards the remaining error. The
    others are means over the dimensions and leave the deviation alone. ``"mse"``: squared.
    ``"huber_mse"``: three times that, plus half the squared error up to 0.05, linear beyond, in
    units of 0.05. Tumbling, where errors are large and mostly noise, then dominates the gradient
    less.
    """
    if kind == "nll":
        return gaussian_nll(mean, log_std, actions)
    squared = (mean - actions).square().mean(dim=1)
    if kind == "mse":
        return squared
    huber = F.huber_loss(mean, actions, delta=HUBER_DELTA, reduction="none")
    return huber.mean(dim=1) / HUBER_DELTA + MSE_WEIGHT * squared


def gaussian_nll(mean: th.Tensor, log_std: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """Return -log π(a|s) of a diagonal Gaussian, (b,), summed over the action's dimensions."""
    scaled = (actions - mean) * th.exp(-log_std)
    return (0.5 * scaled.square() + log_std + HALF_LOG_2PI).sum(dim=1)


def gaussian_entropy(log_std: th.Tensor) -> th.Tensor:
    """Return H of a diagonal Gaussian, a scalar.

    It is the same in every state because the standard deviation is (Eq. 4.2).
    """
    return (log_std + 0.5 + HALF_LOG_2PI).sum()


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
