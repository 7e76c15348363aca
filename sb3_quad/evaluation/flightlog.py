"""Sampled trajectories of flights, and the ``.npz`` file that holds them beside the figures of every flight.

====================  =================  ============================================================================
array                 shape              meaning; m flights, k samples (50 Hz), n episodes, T tolerances, W waypoints
====================  =================  ============================================================================
time                  (k,)               s, of the samples; sample 0 is the start
position              (m, k, 3)          r, world frame, m; NaN after the end of a flight, as in all of these
quaternion            (m, k, 4)          body to world, (w, x, y, z)
velocity              (m, k, 3)          v, world frame, m/s
body_rates            (m, k, 3)          body frame, rad/s
action                (m, k, 4)          the last action given before the sample; NaN at the start
target                (m, k, 3)          r_T, world frame, m
wrench                (m, k, 6)          mean since the sample before: force, world frame, N; torque, body frame, N m
samples               (m,)               how many samples each flight has
episode_seed          (n,)
episode_outcome       (n,) text          success, collision or out_of_range
episode_start         (n, 13)            position, quaternion, velocity, body rates, in the units above
episode_target        (n, 3)             first target, m
episode_flown         (n,)               s until lost or the end
episode_reward        (n,)
episode_path          (n,)               m
episode_final_error   (n,)               |r - r_T|, m
episode_final_offset  (n, 3)             r - r_T, world frame, m; NaN where the flight was lost
episode_time_to       (n, T)             s until |r - r_T| was first within the tolerance; NaN: never
episode_tolerances    (T,)               m
episode_waypoints     (n, W)             s until each waypoint was reached; NaN: never; W = 0 without a course
====================  =================  ============================================================================

Trajectory i is that of episode i: all episodes of a scenario that is the same each time, the first few of others.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

TRAJECTORIES = ("position", "quaternion", "velocity", "body_rates", "action", "target", "wrench")
SAMPLE_RATE = 50.0  # Hz


def read_flights(path: str | Path) -> dict[str, npt.NDArray[np.generic]]:
    """All arrays of a flight file, by the names of this module's table."""
    with np.load(path, allow_pickle=False) as file:
        return {name: file[name] for name in file.files}
