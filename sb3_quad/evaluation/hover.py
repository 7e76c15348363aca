"""How calm flights are once they hover at their targets."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from sb3_quad.base.types import BoolArray, Float32Array
from sb3_quad.envs.simulation.state import (
    BODY_RATES,
    POSITION,
    QUATERNION,
    TARGET,
    QuadcopterState,
)
from sb3_quad.envs.vehicles.vehicle import Vehicle
from sb3_quad.evaluation.hooks import NEAR, Course, Hook

BRAKING = 2.0  # time within NEAR after which a flight counts as hovering, s
LEAST = 1.0  # shortest hover that is measured, s
KEPT = 50  # most steps that are counted at once
ROWS = 2**16  # most states that are kept until then
HOVERED = ("hover_body_rates", "hover_tilt", "hover_command_change")


class Hover(Hook):
    """How calm n flights are at their targets.

    A flight hovers from 2 s after it has come within 0.1 m of its last target until it ends there;
    before that it still brakes. If it leaves the 0.1 m, all begins again. Of the hover these are
    root mean squares: ``hover_body_rates`` of the length of the body rates, rad/s, ``hover_tilt``
    of the tilt, degrees, and ``hover_command_change`` of the change of the four commands, which
    reach from -1 to 1, per second.

    All are NaN if a flight was lost, ended elsewhere, or hovered for less than 1 s.

    :param course: sees each step before this hook does.
    """

    def __init__(self, course: Course) -> None:
        self._course = course

    def on_start(self, state: QuadcopterState, vehicle: Vehicle) -> None:
        self._control_step = vehicle.control_step
        self._braking = round(BRAKING / vehicle.control_step)
        # Control steps since a flight has come near, and sums since its start and until it hovered
        self._steps = np.zeros(state.n, np.int64)
        self._totals = np.zeros((3, state.n))
        self._before = np.zeros((3, state.n))
        # Steps that are not counted yet: to count many at once is faster.
        self._kept = 0
        most = self._most = max(1, min(KEPT, self._braking, ROWS // state.n))
        self._states = np.zeros((most, TARGET.stop, state.n))
        self._on_way = np.zeros((most, state.n), np.bool_)
        # The first action is the last one before.
        self._actions = np.zeros((most + 1, state.n, 4), np.float32)

    def after_step(
        self, step: int, state: QuadcopterState, actions: Float32Array, flying: BoolArray
    ) -> None:
        kept = self._kept
        self._states[kept] = state.array[: TARGET.stop]
        self._on_way[kept] = flying & self._course.on_last
        self._actions[kept + 1] = actions
        self._kept = kept + 1
        if self._kept == self._most:
            self._count()

    def _count(self) -> None:
        """Count the steps that are kept."""
        kept = self._kept
        if kept == 0:
            return
        states = self._states[:kept]
        distance = np.linalg.norm(states[:, POSITION] - states[:, TARGET], axis=1)
        is_near = self._on_way[:kept] & (distance <= NEAR)
        # The last step, from 1 on, at which each flight was elsewhere; 0: it was not
        number = np.arange(1, kept + 1)[:, None]
        left = np.maximum.accumulate(np.where(is_near, 0, number), axis=0)
        steps = np.where(left > 0, number - left, number + self._steps)
        change = np.diff(self._actions[: kept + 1].clip(-1.0, 1.0), axis=0)
        half_tilt = np.arcsin(np.linalg.norm(states[:, QUATERNION][:, 1:3], axis=1).clip(max=1.0))
        squares = (
            np.square(states[:, BODY_RATES]).sum(axis=1),
            np.square(2.0 * half_tilt),
            np.square(change).sum(axis=2),
        )
        totals = self._totals[:, None] + np.cumsum(squares, axis=1)
        # At most one step of each flight is the first of its hover.
        begins = steps == self._braking
        before = np.where(begins, totals, 0.0).sum(axis=1)
        self._before = np.where(begins.any(axis=0), before, self._before)
        self._totals = totals[:, -1]
        self._steps = steps[-1]
        self._actions[0] = self._actions[kept]
        self._kept = 0

    def results(self) -> Mapping[str, Any]:
        self._count()
        steps = self._steps - self._braking
        counts = np.where(steps * self._control_step >= LEAST - 1e-9, steps, np.nan)
        # Rounding may leave a sum a little below zero.
        sums = np.maximum(self._totals - self._before, 0.0)
        rates, tilt, change = np.sqrt(sums / counts)
        per_second = change / (2.0 * self._control_step)  # of one command: the root of a quarter
        return dict(zip(HOVERED, (rates, np.degrees(tilt), per_second), strict=True))
