"""The sampled flights that a report shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sb3_quad.base.arrays import FloatArray
from sb3_quad.evaluation.flightlog import read_flights
from sb3_quad.evaluation.records import Entry

OUTCOMES = {"success": "", "collision": "touches the ground", "out_of_range": "leaves the range"}


@dataclass(frozen=True, eq=False)
class Track:
    """One flight, k samples.

    :param times: (k,), s; ``position`` and ``target``: (k, 3), world frame, m.
    :param wrench: (k, 6), mean since the sample before: force, world frame, N; torque, body frame, N m.
    :param lost: how it was lost, empty if it was not.
    """

    times: FloatArray
    position: FloatArray
    target: FloatArray
    wrench: FloatArray
    lost: str

    @property
    def error(self) -> FloatArray:
        """|r - r_T|, (k,), m."""
        return np.asarray(np.linalg.norm(self.position - self.target, axis=1))

    @property
    def targets(self) -> FloatArray:
        """The targets, one after the other, (n, 3), m."""
        changed = np.flatnonzero((np.diff(self.target, axis=0) != 0).any(axis=1)) + 1
        return np.asarray(self.target[[0, *changed]])


@dataclass(frozen=True, eq=False)
class Flown:
    """One controller in one scenario: its colour, its metrics, its sampled flights."""

    label: str
    colour: str
    entry: Entry
    tracks: Sequence[Track]


def read_tracks(folder: str | Path, entry: Entry) -> list[Track]:
    """The flights of an entry whose trajectories were kept.

    :raises ConfigError: a missing or damaged file.
    """
    arrays = read_flights(Path(folder) / entry.flights)
    tracks = []
    for number, samples in enumerate(arrays.get("samples", np.array([], dtype=np.int64)).tolist()):
        position, target, wrench = (
            np.asarray(arrays[name][number, :samples], dtype=np.float64) for name in ("position", "target", "wrench")
        )
        lost = OUTCOMES.get(str(arrays["episode_outcome"][number]), "lost")
        tracks.append(Track(np.asarray(arrays["time"][:samples], dtype=np.float64), position, target, wrench, lost))
    return tracks
