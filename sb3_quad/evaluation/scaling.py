"""The scaling of the observation that the thesis adapts while flying (4.3.1): an offset μ and a factor α of σ (Eq. 4.10).

An agent hovers beside its target, by the same vector wherever the target is. Moving the position components of μ by that
vector cancels it; multiplying those of σ by α, below 1 near the target, lets the last metre seem longer than it is.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from sb3_quad.base.errors import ConfigError
from sb3_quad.evaluation.flights import fly
from sb3_quad.simulation.observation import DEFAULT_STD

FloatArray = npt.NDArray[np.float64]
Observation = npt.NDArray[np.float32]
N_FLIGHTS = 120  # to random targets, of which the final offset is the mean
STEPS = 1500  # control steps until the offset is read: 15 s, as an episode
ROUNDS = 3  # the offset is measured anew after each correction
OFFSET_SEED = 2**21  # of the flights that measure; those of the figures are others
_POSITION = slice(0, 3)


def adaptive_factor(distance: npt.ArrayLike) -> FloatArray:
    """α = 0.5 (1 + |r - r_T| / 10 m) (Eq. 4.10), of any shape; distance in m."""
    return 0.5 * (1.0 + np.asarray(distance, dtype=np.float64) / 10.0)


def adapt_observation(observation: Observation, mean: FloatArray, std: FloatArray) -> Observation:
    """Observations scaled anew: (s - μ) / (α σ) in the position components, where s / σ is what the environment gives.

    The distance in Eq. 4.10 is the observed one, noise and all, so that a policy needs nothing but its observation.

    :param observation: (n, 18), as the environment scales it by μ = 0 and σ (Eq. 3.16).
    :param mean: position components of μ, (3,), m.
    :param std: position components of σ, (3,), m.
    """
    position = observation[:, _POSITION] * std
    factor = adaptive_factor(np.linalg.norm(position, axis=1, keepdims=True))
    adapted = observation.copy()
    adapted[:, _POSITION] = (position - mean) / (factor * std)
    return adapted


class AdaptiveScaling:
    """A controller behind the thesis's scaling: asked by ``predict(observation)`` as the policy inside is.

    :param policy: an SB3 model, or anything else with its ``predict``.
    :param mean: position components of μ, (3,), m; zero: only α.
    :param std: position components of the σ the environment scales by, (3,), m; None: Table A.2.
    """

    def __init__(self, policy: Any, mean: npt.ArrayLike = (0.0, 0.0, 0.0), std: npt.ArrayLike | None = None) -> None:
        self.policy = policy
        self.mean = np.asarray(mean, dtype=np.float64)
        self.std = np.asarray(DEFAULT_STD[_POSITION] if std is None else std, dtype=np.float64)

    def predict(self, observation: Observation, deterministic: bool = True) -> tuple[Any, Any]:
        """Actions (n, 4) for observations (n, 18), and None as SB3 has it."""
        adapted = adapt_observation(np.asarray(observation), self.mean, self.std)
        return self.policy.predict(adapted, deterministic=deterministic)[0], None


def hover_offset(controller: Any, n_flights: int = N_FLIGHTS, seed: int = 0, **keywords: Any) -> FloatArray:
    """Mean of r - r_T, shape (3,), world frame, m, after 15 s of target tracking, over the flights that last.

    :param keywords: further arguments of :func:`~sb3_quad.evaluation.flights.fly`: ``vehicle``, ``noise``,
        ``observation_std``.
    :raises ConfigError: a controller that crashes on the way in more than half of the flights.
    """
    flights = fly(controller, "target_tracking", n_flights, seed, max_steps=STEPS, **keywords)
    lost = 1.0 - float(flights.success.mean())
    if lost > 0.5:
        raise ConfigError(
            f"the steady offset from the target cannot be measured: {100 * lost:.0f} % of the flights to targets end early"
        )
    return np.asarray(flights.final_offset[flights.success].mean(axis=0))


def measure_mean(policy: Any, **keywords: Any) -> FloatArray:
    """The position components of μ, (3,), m, with which a policy behind :class:`AdaptiveScaling` stops at its target.

    Eq. 4.10 shrinks the offset, too, so it is measured with α at work, and again after each correction.

    :param keywords: see :func:`hover_offset`.
    :raises ConfigError: see :func:`hover_offset`.
    """
    mean = np.zeros(3)
    for number in range(ROUNDS):
        mean = mean - hover_offset(AdaptiveScaling(policy, mean), seed=OFFSET_SEED + number * N_FLIGHTS, **keywords)
    return mean
