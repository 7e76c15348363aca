"""An exported file against the policy it came from: the largest difference, and the time of a call."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sb3_quad.base.errors import ExportError
from sb3_quad.export.network import Float32Array, Output, actions_to_result, result_range
from sb3_quad.simulation.batch import QuadcopterBatch
from sb3_quad.simulation.observation import DEFAULT_MEAN, DEFAULT_STD, OBSERVATION_SIZE
from sb3_quad.vehicles.vehicle import Vehicle

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

N_OBSERVATIONS = 10_000  # half of them from flights, half of random states
TOLERANCE = 1e-4  # of the range between least and greatest output: far above rounding, far below any mistake
CALLS = 2000  # of one observation each, that are timed
_FLIGHTS, _EVERY = 50, 5  # flights side by side, and control steps from one kept observation to the next
_WIDE = {"target_distance": 30.0, "nearest_target": 0.0, "velocity_std": 4.0, "body_rates_std": 8.0}


class Samples(NamedTuple):
    """The same observations twice, float32 (n, 18) each, noise and all."""

    physical: Float32Array
    """in m, m/s and rad/s: what an exported file is given"""
    scaled: Float32Array
    """as the environment scales them by Eq. 3.16: what the policy is given"""


@dataclass(frozen=True, eq=False)
class Trial:
    """What a file gave.

    :param results: float32 (n, 4).
    :param microseconds: per call with one observation; None where it could not be run as it will be.
    :param by: what ran it.
    """

    results: Float32Array
    microseconds: float | None
    by: str


def draw_samples(
    model: BaseAlgorithm, vehicle: Vehicle, mean: Any = None, std: Any = None, n: int = N_OBSERVATIONS, seed: int = 0
) -> Samples:
    """Observations of the policy's own flights (recovery and tracking, up to 20 m) and of random states, half each.

    The random states: any attitude, up to 30 m from the target, velocity N(0, 4 m/s) and body rates N(0, 8 rad/s) per
    axis, which is twice what an episode starts with. Both halves carry the environment's observation noise.

    :param mean: μ of Eq. 3.16, (18,); None: zero. ``std`` σ, likewise; None: Table A.2.
    :param n: even, at least 2.
    """
    scaling = (DEFAULT_MEAN if mean is None else mean), (DEFAULT_STD if std is None else std)
    half = n // 2
    rows = min(_FLIGHTS, half)
    flights = QuadcopterBatch(rows, "recovery_and_tracking", vehicle=vehicle, seed=seed, n_threads=1)
    flights.reset()
    parts = []
    for step in range(_EVERY * -(-half // rows)):
        seen = _look(flights, scaling)
        if step % _EVERY == 0:
            parts.append(seen)
        flights.step(model.predict(seen.scaled, deterministic=True)[0])
    thrown = QuadcopterBatch(half, "recovery_and_tracking", _WIDE, vehicle, seed=seed + rows, n_threads=1)
    thrown.reset()
    physical, scaled = (np.concatenate(column)[:half] for column in zip(*parts, strict=True))
    others = _look(thrown, scaling)
    return Samples(np.concatenate([physical, others.physical]), np.concatenate([scaled, others.scaled]))


def largest_error(model: BaseAlgorithm, samples: Samples, trial: Trial, vehicle: Vehicle, output: Output) -> float:
    """The largest difference of any rotor in any observation, N or rad/s.

    :raises ExportError: a difference above ``TOLERANCE`` of the range, or a result that is not finite.
    """
    actions = model.predict(samples.scaled, deterministic=True)[0]
    error = float(np.abs(trial.results - actions_to_result(actions, vehicle, output)).max())
    low, high = result_range(vehicle, output)
    if not error <= TOLERANCE * (high - low):  # also where it is NaN
        raise ExportError(
            f"the exported policy differs from the trained one by {error:.3g}, {TOLERANCE * (high - low):.3g} is allowed "
            f"({trial.by}); nothing was written"
        )
    return error


def time_calls(call: Callable[[Float32Array], Any], observations: Float32Array) -> float:
    """Median time of a call with one observation, (1, 18), in µs."""
    rows = [np.ascontiguousarray(observations[k % len(observations)][None]) for k in range(CALLS)]
    for row in rows[:50]:
        call(row)
    times = np.empty(CALLS)
    for k, row in enumerate(rows):
        start = time.perf_counter()
        call(row)
        times[k] = time.perf_counter() - start
    return float(np.median(times)) * 1e6


def _look(batch: QuadcopterBatch, scaling: tuple[Any, Any]) -> Samples:
    """What the rows observe now; noise belongs to the step, so both views share it."""
    batch.set_observation_scaling(np.zeros(OBSERVATION_SIZE), np.ones(OBSERVATION_SIZE))
    physical = batch.observe()
    batch.set_observation_scaling(*scaling)
    return Samples(physical, batch.observe())
