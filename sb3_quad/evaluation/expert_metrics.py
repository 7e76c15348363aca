"""What an expert that sees the true state reaches: the metrics beside its gains, and its recoveries by how they begin."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from sb3_quad.evaluation.flights import Flights, fly
from sb3_quad.simulation.state import BODY_RATES, QUATERNION, VELOCITY
from sb3_quad.vehicles.gains import GeometricMetrics
from sb3_quad.vehicles.vehicle import Vehicle

NEAR = 0.1  # m
ByStart = dict[str, tuple[int, int]]  # from each kind of start to how many flights began so, and how many of these were lost


def measure_expert(
    expert: Any, vehicle: Vehicle, seeds: Sequence[int], episodes: int = 960, time_limit: int = 1500
) -> tuple[GeometricMetrics, ByStart]:
    """Fly ``episodes`` recoveries per seed, and as many targets 10 m away with the first seed.

    A tracking flight that never comes within 0.1 m counts as ``time_limit`` control steps.
    """
    keywords: dict[str, Any] = {"vehicle": vehicle, "noise": 0.0, "max_steps": time_limit}
    recovery = Flights.concatenate([fly(expert, "state_recovery", episodes, seed, **keywords) for seed in seeds])
    tracking = fly(expert, "target_tracking", episodes, seeds[0], **keywords)
    times = np.nan_to_num(tracking.time_to[NEAR], nan=time_limit * vehicle.control_step)
    metrics = GeometricMetrics(
        recovery_survival=round(float(recovery.survival.mean()), 5),
        recovery_episodes=recovery.n,
        tracking_survival=round(float(tracking.survival.mean()), 5),
        tracking_episodes=tracking.n,
        time_to_0_1_m=round(float(times.mean()), 3),
        tracking_reward=round(float(tracking.reward.mean()), 3),
        observation_noise=0.0,
        seeds=tuple(seeds),
    )
    return metrics, by_start(recovery)


def by_start(flights: Flights) -> ByStart:
    """Count flights by tilt, fall and body rate at their start."""
    _, x, y, _ = flights.start[:, QUATERNION].T
    tilt = np.degrees(np.arccos(np.clip(1.0 - 2.0 * (x * x + y * y), -1.0, 1.0)))
    falling, rate = -flights.start[:, VELOCITY][:, 2], np.linalg.norm(flights.start[:, BODY_RATES], axis=1)
    quantities = (("tilt", tilt, 60, 120, "°"), ("falling", falling, 2, 4, " m/s"), ("body rate", rate, 5, 10, " rad/s"))
    counts = {}
    for name, values, low, high, unit in quantities:
        for group, label in enumerate((f"below {low}{unit}", f"{low} to {high}{unit}", f"above {high}{unit}")):
            rows = np.digitize(values, (low, high)) == group
            counts[f"{name} {label}"] = int(rows.sum()), int((rows & ~flights.survival).sum())
    return counts
