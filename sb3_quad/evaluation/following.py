"""How well flights follow references that move or turn."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from sb3_quad.base.types import BoolArray, Float32Array
from sb3_quad.envs.simulation.state import QuadcopterState
from sb3_quad.envs.vehicles.vehicle import Vehicle
from sb3_quad.evaluation.hooks import Hook

SETTLED = 2.0  # time after which errors count, s
FOLLOWED = ("rms_error", "greatest_error", "path_error", "heading_error", "lag")


class Following(Hook):
    """How far n flights are from references that move or turn.

    With the error e = r - r_T and the reference's velocity v, over all that is flown after the
    first 2 s: ``rms_error`` is the root mean square of the length of e, ``greatest_error`` its
    greatest length, and ``path_error`` the root mean square of the part of e across v, or of all of
    e where v is zero; m. ``lag`` is -mean(e·v) / mean(v²), s: the delay with which the reference
    fits the flight best, as long as it is short. ``heading_error`` is the root mean square of the
    angle between the body's x axis, seen from above, and the commanded heading, degrees.

    All are NaN if a flight was lost or its target rested.

    ``moves`` (n,) says whose reference has moved or had a heading.

    :param any_moves: whether any may move; otherwise nothing is measured.
    """

    def __init__(self, any_moves: bool) -> None:
        self._any_moves = any_moves

    def on_start(self, state: QuadcopterState, vehicle: Vehicle) -> None:
        self._first = SETTLED / vehicle.control_step
        self.moves = np.zeros(state.n, bool)
        self._flying = np.ones(state.n, bool)
        self._greatest = np.full(state.n, np.nan)
        self._sums = np.zeros((7, state.n))

    def after_step(
        self, step: int, state: QuadcopterState, actions: Float32Array, flying: BoolArray
    ) -> None:
        self._flying = flying
        if not self._any_moves:
            return
        velocity = state.target_velocity
        speed = np.linalg.norm(velocity, axis=1)
        cosine, sine = state.target_heading.T
        # 1 where a heading is commanded, otherwise 0.
        commanded = np.hypot(cosine, sine)
        self.moves |= speed + commanded > 0.0
        if step < self._first:
            return
        error = state.position - state.target
        distance = state.distance
        along = (error * velocity).sum(axis=1)
        on_path = np.divide(along, speed, out=np.zeros_like(along), where=speed > 0.0)
        # The azimuth of the body's x axis, relative to the commanded heading.
        x, y = state.rotation[:, :2, 0].T
        turn = np.arctan2(cosine * y - sine * x, cosine * x + sine * y)
        np.fmax(self._greatest, distance, out=self._greatest, where=flying)
        squared = distance**2
        across = squared - on_path**2
        turns = commanded * turn**2
        counted = np.ones_like(along), squared, across, along, speed**2, commanded, turns
        self._sums += np.where(flying, counted, 0.0)

    def results(self) -> Mapping[str, Any]:
        steps, squares, across, along, speeds, commanded, turns = self._sums
        with np.errstate(divide="ignore", invalid="ignore"):
            errors = (
                np.sqrt(squares / steps),
                self._greatest,
                np.sqrt(np.maximum(across, 0.0) / steps),
                np.degrees(np.sqrt(turns / commanded)),
                -along / speeds,
            )
        return dict(zip(FOLLOWED, np.where(self._flying & self.moves, errors, np.nan), strict=True))
