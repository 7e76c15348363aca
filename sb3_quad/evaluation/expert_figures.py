"""What an expert that sees the true state reaches: the figures beside its gains, and its recoveries by how they begin."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sb3_quad.evaluation.flights import fly
from sb3_quad.simulation.state import QuadcopterState
from sb3_quad.vehicles.gains import GeometricFigures
from sb3_quad.vehicles.vehicle import Vehicle

Groups = Mapping[str, Mapping[str, npt.NDArray[np.bool_]]]
NEAR = 0.1  # m


class Recoveries(NamedTuple):
    """Recovery episodes by their start: of each group of each quantity, how many were flown and how many were lost."""

    flown: Mapping[str, Mapping[str, int]]
    lost: Mapping[str, Mapping[str, int]]


def measure_expert(
    expert: Any, vehicle: Vehicle, seeds: Sequence[int], episodes: int = 960, time_limit: int = 1500
) -> tuple[GeometricFigures, Recoveries]:
    """Fly ``episodes`` recoveries per seed, and as many targets 10 m away with the first seed.

    A tracking flight that never comes within 0.1 m counts as ``time_limit`` control steps.
    """
    success, states = [], []
    for seed in seeds:
        success.append(fly(expert, "state_recovery", episodes, seed, vehicle, noise=0.0, max_steps=time_limit).success)
        states.append(start_states("state_recovery", episodes, seed, vehicle))
    tracking = fly(expert, "target_tracking", episodes, seeds[0], vehicle, noise=0.0, max_steps=time_limit)
    recovered = np.concatenate(success)
    times = np.nan_to_num(tracking.time_to[NEAR], nan=time_limit * vehicle.control_step)
    figures = GeometricFigures(
        recovery_success=round(float(recovered.mean()), 5),
        recovery_episodes=recovered.size,
        tracking_success=round(float(tracking.success.mean()), 5),
        tracking_episodes=tracking.n,
        time_to_0_1_m=round(float(times.mean()), 3),
        tracking_reward=round(float(tracking.reward.mean()), 3),
        observation_noise=0.0,
        seeds=tuple(seeds),
    )
    return figures, by_start(recovered, QuadcopterState.concatenate(states))


def start_states(task: str, episodes: int, seed: int, vehicle: Vehicle) -> QuadcopterState:
    """The states in which the episodes of :func:`~sb3_quad.evaluation.flights.fly` with the same arguments begin."""
    from sb3_quad.simulation.batch import QuadcopterBatch

    batch = QuadcopterBatch(episodes, task=task, vehicle=vehicle, noise=0.0, seed=seed)
    batch.reset()
    return batch.true_state()


def start_groups(state: QuadcopterState) -> Groups:
    """Which starts belong to which group of tilt, falling speed and body rate; of shape (n,) each."""
    upright = state.rotation[:, 2, 2]
    falling = -state.velocity[:, 2]
    rate = np.linalg.norm(state.body_rates, axis=1)
    return {
        "tilt": {"below 60°": upright > 0.5, "60° to 120°": np.abs(upright) <= 0.5, "above 120°": upright < -0.5},
        "falling": {"below 2 m/s": falling < 2, "2 to 4 m/s": (falling >= 2) & (falling < 4), "above 4 m/s": falling >= 4},
        "body rate": {"below 5 rad/s": rate < 5, "5 to 10 rad/s": (rate >= 5) & (rate < 10), "above 10 rad/s": rate >= 10},
    }


def by_start(recovered: npt.NDArray[np.bool_], state: QuadcopterState) -> Recoveries:
    """Count flights by how they began.

    :param recovered: (n,), whether each was.
    :param state: the n states they began in.
    """
    groups = start_groups(state)
    flown = {name: {group: int(rows.sum()) for group, rows in parts.items()} for name, parts in groups.items()}
    lost = {name: {group: int((rows & ~recovered).sum()) for group, rows in parts.items()} for name, parts in groups.items()}
    return Recoveries(flown, lost)
