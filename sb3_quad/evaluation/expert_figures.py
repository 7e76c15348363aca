"""What an expert that sees the true state reaches: the metrics beside its gains, and its recoveries by how they begin."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from sb3_quad.base.arrays import BoolArray
from sb3_quad.evaluation.flights import fly
from sb3_quad.simulation.batch import QuadcopterBatch
from sb3_quad.simulation.state import QuadcopterState
from sb3_quad.vehicles.gains import GeometricMetrics
from sb3_quad.vehicles.vehicle import Vehicle

NEAR = 0.1  # m
_GROUPS = {
    "tilt": ("below 60°", "60° to 120°", "above 120°"),
    "falling": ("below 2 m/s", "2 to 4 m/s", "above 4 m/s"),
    "body rate": ("below 5 rad/s", "5 to 10 rad/s", "above 10 rad/s"),
}


class Recoveries(NamedTuple):
    """Recovery episodes by their start: of each group of each quantity, how many were flown and how many were lost."""

    flown: Mapping[str, Mapping[str, int]]
    lost: Mapping[str, Mapping[str, int]]


def measure_expert(
    expert: Any, vehicle: Vehicle, seeds: Sequence[int], episodes: int = 960, time_limit: int = 1500
) -> tuple[GeometricMetrics, Recoveries]:
    """Fly ``episodes`` recoveries per seed, and as many targets 10 m away with the first seed.

    A tracking flight that never comes within 0.1 m counts as ``time_limit`` control steps.
    """
    keywords: dict[str, Any] = {"vehicle": vehicle, "noise": 0.0, "max_steps": time_limit}
    recovered = np.concatenate([fly(expert, "state_recovery", episodes, seed, **keywords).success for seed in seeds])
    starts = QuadcopterState.concatenate([start_states("state_recovery", episodes, seed, vehicle) for seed in seeds])
    tracking = fly(expert, "target_tracking", episodes, seeds[0], **keywords)
    times = np.nan_to_num(tracking.time_to[NEAR], nan=time_limit * vehicle.control_step)
    metrics = GeometricMetrics(
        recovery_success=round(float(recovered.mean()), 5),
        recovery_episodes=recovered.size,
        tracking_success=round(float(tracking.success.mean()), 5),
        tracking_episodes=tracking.n,
        time_to_0_1_m=round(float(times.mean()), 3),
        tracking_reward=round(float(tracking.reward.mean()), 3),
        observation_noise=0.0,
        seeds=tuple(seeds),
    )
    return metrics, by_start(recovered, starts)


def start_states(task: str, episodes: int, seed: int, vehicle: Vehicle) -> QuadcopterState:
    """The states in which the episodes of :func:`~sb3_quad.evaluation.flights.fly` with the same arguments begin."""
    batch = QuadcopterBatch(episodes, task=task, vehicle=vehicle, noise=0.0, seed=seed)
    batch.reset()
    return batch.true_state()


def by_start(recovered: BoolArray, state: QuadcopterState) -> Recoveries:
    """Count flights by how they began.

    :param recovered: (n,), whether each was.
    :param state: the n states they began in.
    """
    tilt = np.degrees(np.arccos(np.clip(state.rotation[:, 2, 2], -1.0, 1.0)))
    group = {
        "tilt": np.digitize(tilt, (60, 120)),
        "falling": np.digitize(-state.velocity[:, 2], (2, 4)),
        "body rate": np.digitize(np.linalg.norm(state.body_rates, axis=1), (5, 10)),
    }

    def count(rows: BoolArray) -> dict[str, dict[str, int]]:
        return {
            name: {label: int((rows & (group[name] == k)).sum()) for k, label in enumerate(labels)}
            for name, labels in _GROUPS.items()
        }

    return Recoveries(count(np.ones_like(recovered)), count(~recovered))
