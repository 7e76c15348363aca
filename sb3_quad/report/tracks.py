"""The sampled flights that a report shows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sb3_quad.base.arrays import FloatArray
from sb3_quad.evaluation.flightlog import read_flights
from sb3_quad.evaluation.records import Entry

OUTCOMES = {"success": "", "collision": "touches the ground", "out_of_range": "leaves the range"}


class Track(NamedTuple):
    """One flight, k samples."""

    times: FloatArray  # (k,), s
    position: FloatArray  # (k, 3), world frame, m; target likewise
    target: FloatArray
    wrench: FloatArray  # (k, 6), mean since the sample before: force, world frame, N; torque, body frame, N m
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


class Flown(NamedTuple):
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
    for number, samples in enumerate(arrays.get("samples", ())):
        rows = {name: arrays[name][number, :samples].astype(np.float64) for name in ("position", "target", "wrench")}
        lost = OUTCOMES.get(str(arrays["episode_outcome"][number]), "lost")
        tracks.append(Track(times=arrays["time"][:samples], lost=lost, **rows))
    return tracks
