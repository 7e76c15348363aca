"""Sampled flights as a report draws them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from sb3_quad.evaluation.flightlog import read_flights
from sb3_quad.evaluation.records import Entry

FloatArray = npt.NDArray[np.float64]
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
        """The targets flown to, one after the other, (n, 3), m."""
        changed = np.flatnonzero((np.diff(self.target, axis=0) != 0).any(axis=1)) + 1
        return np.asarray(self.target[[0, *changed]])


def read_tracks(folder: str | Path, entry: Entry) -> list[Track]:
    """The flights of an entry whose trajectories were kept.

    :raises ConfigError: a missing or damaged file.
    """
    arrays = read_flights(Path(folder) / entry.flights)
    if "samples" not in arrays:
        return []
    tracks = []
    for number, samples in enumerate(arrays["samples"].tolist()):
        position, target, wrench = (
            np.asarray(arrays[name][number, :samples], dtype=np.float64) for name in ("position", "target", "wrench")
        )
        lost = OUTCOMES.get(str(arrays["episode_outcome"][number]), "lost")
        tracks.append(Track(np.asarray(arrays["time"][:samples], dtype=np.float64), position, target, wrench, lost))
    return tracks
