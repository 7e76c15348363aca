"""Sampled trajectories of flights, and the ``.npz`` file that holds them and the metrics of every
flight.

docs/reference/evaluation.md lists the arrays.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sb3_quad.base.files import read_arrays
from sb3_quad.base.types import AnyArray, Arrays, BoolArray, Float32Array, StrPath
from sb3_quad.envs.simulation.state import QuadcopterState
from sb3_quad.envs.vehicles.vehicle import Vehicle
from sb3_quad.evaluation.flights import Flights
from sb3_quad.evaluation.following import FOLLOWED
from sb3_quad.evaluation.hooks import Hook
from sb3_quad.evaluation.hover import HOVERED

SAMPLE_RATE = 50.0  # Hz
OUTCOMES = ("success", "missed", "collision", "out_of_range")
# The outcomes of a lost flight.
LOST = OUTCOMES[2:]
STATES = ("position", "quaternion", "velocity", "body_rates", "target")
# Fields of Flights that become arrays of the same name.
EPISODES = (
    "start",
    "target",
    "flown",
    "reward",
    "final_error",
    "final_offset",
    "recovery_time",
    "cross_track_error",
    *HOVERED,
    *FOLLOWED,
)


class Recorder(Hook):
    """Samples the first ``m`` flights at about 50 Hz, as float32, which is enough for plots."""

    def __init__(self, m: int) -> None:
        self._m = m

    def on_start(self, state: QuadcopterState, vehicle: Vehicle) -> None:
        self._control_step = vehicle.control_step
        self._stride = max(1, round(1.0 / (SAMPLE_RATE * vehicle.control_step)))
        self._log: list[Arrays] = []
        self._samples = np.zeros(min(self._m, state.n), dtype=np.int64)
        # There is no action at the start.
        self._sample(state, np.full((state.n, 4), np.nan), np.ones(state.n, bool))

    def after_step(
        self, step: int, state: QuadcopterState, actions: Float32Array, flying: BoolArray
    ) -> None:
        if step % self._stride == 0:
            self._sample(state, actions, flying)

    def _sample(self, state: QuadcopterState, actions: AnyArray, flying: BoolArray) -> None:
        rows = flying[: self._m]
        values = {name: getattr(state, name) for name in STATES}
        values["action"] = actions
        for name, array in values.items():
            values[name] = np.where(rows[:, None], array[: self._m], np.nan)
        self._log.append(values)
        self._samples[rows] = len(self._log)

    def arrays(self) -> Arrays:
        """Return the arrays of trajectories, as long as the longest flight."""
        log = self._log[: self._samples.max(initial=1)]
        arrays: Arrays = {
            "time": np.arange(len(log)) * (self._stride * self._control_step),
            "samples": self._samples,
        }
        for name in log[0]:
            arrays[name] = np.stack([sample[name] for sample in log], axis=1).astype(np.float32)
        return arrays


def episode_arrays(flights: Flights, seeds: Sequence[int]) -> Arrays:
    """Return the ``episode_`` arrays of all flights."""
    # The first condition that is true decides.
    conditions = [flights.success, flights.survival, flights.collision]
    arrays = {name: getattr(flights, name) for name in EPISODES}
    arrays |= {
        "seed": np.array(seeds, np.int64),
        "outcome": np.select(conditions, OUTCOMES[:3], OUTCOMES[3]),
        "path": flights.path_length,
        "tolerances": np.array([*flights.time_to]),
        "time_to": np.stack([*flights.time_to.values()], axis=1),
        "settling_time": np.stack([*flights.settling_time.values()], axis=1),
        "waypoints": flights.waypoint_times,
    }
    return {f"episode_{name}": array for name, array in arrays.items()}


read_flights = read_arrays  # by name; with the prefix ``episode_`` only the metrics


class Track(NamedTuple):
    """One flight, k samples."""

    position: Float32Array  # (k, 3), world frame, m
    targets: Float32Array  # (n, 3), one after the other, likewise
    lost: bool


def read_tracks(path: StrPath) -> list[Track]:
    """Read the flights of a file whose trajectories were kept.

    :raises ConfigError: a missing or damaged file.
    """
    arrays = read_arrays(path)
    tracks = []
    for number, samples in enumerate(arrays["samples"]):
        target = arrays["target"][number, :samples]
        # The first target counts as a change, from NaN.
        changes = np.diff(target, axis=0, prepend=np.nan).any(axis=1)
        lost = str(arrays["episode_outcome"][number]) in LOST
        tracks.append(Track(arrays["position"][number, :samples], target[changes], lost))
    return tracks
