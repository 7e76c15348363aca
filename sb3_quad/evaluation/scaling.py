"""The scaling of the observation that the thesis adapts while flying (4.3.1): an offset μ and a factor α of σ (Eq. 4.10).

An agent hovers beside its target, by the same vector wherever the target is. Moving the position components of μ by that
vector cancels it; multiplying those of σ by α, below 1 near the target, lets the last metre seem longer than it is.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from sb3_quad.base.arrays import Float32Array, FloatArray
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.seeds import seed_for
from sb3_quad.evaluation.flights import fly
from sb3_quad.simulation.observation import DEFAULT_STD, GROUPS
from sb3_quad.simulation.settings import FlightSettings

N_FLIGHTS = 120  # to random targets, of which the final offset is the mean
ROUNDS = 3  # the offset is measured anew after each correction
_POSITION = GROUPS["position"]


def adaptive_factor(distance: npt.ArrayLike) -> FloatArray:
    """α = 0.5 (1 + |r - r_T| / 10 m) (Eq. 4.10), of any shape; distance in m."""
    return 0.5 * (1.0 + np.asarray(distance, dtype=np.float64) / 10.0)


class AdaptiveScaling:
    """A policy behind the thesis's scaling, asked by ``predict`` as an SB3 model is.

    In the position components it shows the policy (s - μ) / (α σ), where s / σ is what the environment gives. The distance in
    α is the observed one, noise and all, so that a policy needs nothing but its observation.

    :param policy: an SB3 model, or a function of observations.
    :param mean: position components of μ, (3,), m; zero: only α.
    :param std: σ that the environment scales by, (18,); None: Table A.2.
    """

    def __init__(self, policy: Any, mean: npt.ArrayLike = (0.0, 0.0, 0.0), std: npt.ArrayLike | None = None) -> None:
        self.policy, self.observation_space = policy, getattr(policy, "observation_space", None)
        self.mean = np.asarray(mean, dtype=np.float64)
        self.std = np.asarray(DEFAULT_STD if std is None else std, dtype=np.float64)[_POSITION]

    def predict(self, observation: Float32Array, **how: Any) -> tuple[Any, Any]:
        """The policy's answer to scaled observations, (n, 18), in physical terms those that the environment gives.

        :param how: for the policy's own ``predict``.
        """
        position = observation[:, _POSITION] * self.std
        factor = adaptive_factor(np.linalg.norm(position, axis=1, keepdims=True))
        adapted = observation.copy()
        adapted[:, _POSITION] = (position - self.mean) / (factor * self.std)
        if not hasattr(self.policy, "predict"):
            return self.policy(adapted), None
        actions, state, *_ = self.policy.predict(adapted, **how)
        return actions, state


def hover_offset(
    controller: Any, n_flights: int = N_FLIGHTS, seed: int = 0, settings: FlightSettings | None = None
) -> FloatArray:
    """Mean of r - r_T, shape (3,), world frame, m, after 15 s of target tracking, over the flights that last.

    :param settings: how it flies; task and episode length are those of this measurement.
    :raises ConfigError: a controller that crashes on the way in more than half of the flights.
    """
    own = {} if settings is None else settings.in_any_task()
    flights = fly(controller, "target_tracking", n_flights, seed, **own)
    lost = 1.0 - float(flights.survival.mean())
    if lost > 0.5:
        raise ConfigError(
            f"the steady offset from the target cannot be measured: {100 * lost:.0f} % of the flights to targets end early"
        )
    return np.asarray(flights.final_offset[flights.survival].mean(axis=0))


def measure_mean(policy: Any, n_flights: int = N_FLIGHTS, settings: FlightSettings | None = None) -> FloatArray:
    """The position components of μ, (3,), m, with which a policy behind :class:`AdaptiveScaling` stops at its target.

    Eq. 4.10 shrinks the offset, too, so it is measured with α at work, and again after each correction.

    :raises ConfigError: see :func:`hover_offset`.
    """
    mean = np.zeros(3)
    for number in range(ROUNDS):
        seed, std = seed_for("offset", number), None if settings is None else settings.observation_std
        mean = mean - hover_offset(AdaptiveScaling(policy, mean, std), n_flights, seed, settings)
    return mean
