"""What an expert that sees the true state reaches: the metrics beside its gains."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from sb3_quad.evaluation.flights import Flights, fly
from sb3_quad.vehicles.gains import GeometricMetrics
from sb3_quad.vehicles.vehicle import Vehicle

NEAR = 0.1  # m


def measure_expert(
    expert: Any, vehicle: Vehicle, seeds: Sequence[int], episodes: int = 960, time_limit: int = 1500
) -> GeometricMetrics:
    """Fly ``episodes`` recoveries per seed, and as many targets 10 m away with the first seed.

    A tracking flight that never comes within 0.1 m counts as ``time_limit`` control steps.
    """
    keywords: dict[str, Any] = {"vehicle": vehicle, "noise": 0.0, "max_steps": time_limit}
    recovery = Flights.concatenate([fly(expert, "state_recovery", episodes, seed, **keywords) for seed in seeds])
    tracking = fly(expert, "target_tracking", episodes, seeds[0], **keywords)
    times = np.nan_to_num(tracking.time_to[NEAR], nan=time_limit * vehicle.control_step)
    return GeometricMetrics(
        recovery_survival=round(float(recovery.survival.mean()), 5),
        recovery_episodes=recovery.n,
        tracking_survival=round(float(tracking.survival.mean()), 5),
        tracking_episodes=tracking.n,
        time_to_0_1_m=round(float(times.mean()), 3),
        tracking_reward=round(float(tracking.reward.mean()), 3),
        observation_noise=0.0,
        seeds=tuple(seeds),
    )
