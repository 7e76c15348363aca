"""Sampled trajectories of flights, and the ``.npz`` file that holds them beside the metrics of
every flight.

docs/reference/evaluation.md lists the arrays.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sb3_quad.base.arrays import Arrays, BoolArray, Float32Array, FloatArray
from sb3_quad.base.files import read_arrays
from sb3_quad.evaluation.flights import Flights, Hook
from sb3_quad.simulation.state import (
    FORCE_BODY,
    FORCE_WORLD,
    TORQUE_BODY,
    TORQUE_WORLD,
    QuadcopterState,
)
from sb3_quad.vehicles.vehicle import Vehicle

SAMPLE_RATE = 50.0  # Hz
OUTCOMES = {
    "success": "",
    "missed": "",
    "collision": "touches the ground",
    "out_of_range": "leaves the range",
}  # in words
STATES = ("position", "quaternion", "velocity", "body_rates", "target")


class Recorder(Hook):
    """Samples the first ``m`` flights at 50 Hz, or nearly so; float32, since it is for looking at."""

    def __init__(self, m: int) -> None:
        self._m = m

    def on_start(self, state: QuadcopterState, vehicle: Vehicle) -> None:
        self._control_step = vehicle.control_step
        self._stride = max(1, round(1.0 / (SAMPLE_RATE * vehicle.control_step)))
        m = min(self._m, state.n)
        self._log: list[Arrays] = []
        self._samples = np.zeros(m, dtype=np.int64)
        self._wrench = np.zeros((m, 6))
        self._sample(
            state, np.full((state.n, 4), np.nan, np.float32), np.ones(state.n, dtype=np.bool_)
        )

    def before_step(
        self,
        state: QuadcopterState,
        observation: Float32Array,
        wrench: FloatArray,
        flying: BoolArray,
    ) -> None:
        if wrench.any():
            rows = wrench[: self._m]
            rotation = QuadcopterState(state.array[:, : self._m]).rotation
            self._wrench[:, :3] += rows[:, FORCE_WORLD] + np.einsum(
                "nij,nj->ni", rotation, rows[:, FORCE_BODY]
            )
            self._wrench[:, 3:] += rows[:, TORQUE_BODY] + np.einsum(
                "nji,nj->ni", rotation, rows[:, TORQUE_WORLD]
            )

    def after_step(
        self, step: int, state: QuadcopterState, actions: Float32Array, flying: BoolArray
    ) -> None:
        if step % self._stride == 0:
            self._sample(state, actions, flying)

    def _sample(self, state: QuadcopterState, actions: Float32Array, flying: BoolArray) -> None:
        rows = flying[: self._m]
        values = {name: getattr(state, name)[: self._m] for name in STATES}
        values |= {"action": actions[: self._m], "wrench": self._wrench / self._stride}
        self._log.append(
            {
                name: np.where(rows[:, None], each, np.nan).astype(np.float32)
                for name, each in values.items()
            }
        )
        self._samples[rows] = len(self._log)
        self._wrench[:] = 0.0

    def arrays(self) -> Arrays:
        """The arrays of trajectories, as long as the longest flight."""
        log = self._log[: self._samples.max(initial=1)]
        time = np.arange(len(log)) * (self._stride * self._control_step)
        trajectories = {name: np.stack([sample[name] for sample in log], axis=1) for name in log[0]}
        return {"time": time, "samples": self._samples, **trajectories}


def episode_arrays(flights: Flights, seeds: npt.ArrayLike) -> Arrays:
    """The ``episode_`` arrays, of all flights."""
    as_they_are = (
        "start",
        "target",
        "flown",
        "reward",
        "final_error",
        "final_offset",
        "recovery_time",
        "cross_track_error",
        "overshoot",
    )
    return {
        "episode_seed": np.asarray(seeds, dtype=np.int64),
        "episode_outcome": np.select(
            [flights.success, flights.survival, flights.collision], [*OUTCOMES][:3], [*OUTCOMES][3]
        ),
        **{f"episode_{name}": getattr(flights, name) for name in as_they_are},
        "episode_path": flights.path_length,
        "episode_time_to": np.stack(list(flights.time_to.values()), axis=1),
        "episode_settling_time": np.stack(list(flights.settling_time.values()), axis=1),
        "episode_tolerances": np.array(list(flights.time_to)),
        "episode_waypoints": flights.waypoint_times,
    }


read_flights = read_arrays  # by name; of episodes alone with the prefix ``episode_``


class Track(NamedTuple):
    """One flight, k samples."""

    times: FloatArray  # (k,), s
    position: FloatArray  # (k, 3), world frame, m; target likewise
    target: FloatArray
    # (k, 6), mean since the sample before: force, world frame, N; torque, body frame, N m
    wrench: FloatArray
    lost: str  # how it was lost, empty if it was not

    @property
    def error(self) -> FloatArray:
        """|r - r_T|, (k,), m."""
        return np.asarray(np.linalg.norm(self.position - self.target, axis=1))

    @property
    def targets(self) -> FloatArray:
        """The targets, one after the other, (n, 3), m."""
        changed = np.flatnonzero((np.diff(self.target, axis=0) != 0).any(axis=1)) + 1
        return np.asarray(self.target[[0, *changed]])


def read_tracks(path: str | Path) -> list[Track]:
    """The flights of a file whose trajectories were kept.

    :raises ConfigError: a missing or damaged file.
    """
    arrays = read_arrays(path)
    tracks = []
    for number, samples in enumerate(arrays.get("samples", ())):
        rows = {
            name: arrays[name][number, :samples].astype(np.float64)
            for name in ("position", "target", "wrench")
        }
        lost = OUTCOMES.get(str(arrays["episode_outcome"][number]), "lost")
        tracks.append(Track(times=arrays["time"][:samples], lost=lost, **rows))
    return tracks
