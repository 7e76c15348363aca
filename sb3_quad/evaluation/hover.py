"""How calm flights are once they hover at their targets."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from sb3_quad.base.types import BoolArray, Float32Array
from sb3_quad.envs.simulation.state import QuadcopterState
from sb3_quad.envs.vehicles.vehicle import Vehicle
from sb3_quad.evaluation.hooks import NEAR, Course, Hook

BRAKING = 2.0  # time within NEAR after which a flight counts as hovering, s
LEAST = 1.0  # shortest hover that is measured, s
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
        # Control steps since a flight has come near, and sums over those in which it hovers
        self._steps = np.zeros(state.n, np.int64)
        self._sums = np.zeros((3, state.n))
        self._actions = np.zeros((state.n, 4))

    def after_step(
        self, step: int, state: QuadcopterState, actions: Float32Array, flying: BoolArray
    ) -> None:
        is_near = flying & self._course.on_last & (state.distance <= NEAR)
        self._steps = np.where(is_near, self._steps + 1, 0)
        commands = actions.clip(-1.0, 1.0)
        half_tilt = np.arcsin(np.linalg.norm(state.quaternion[:, 1:3], axis=1).clip(max=1.0))
        squares = (
            np.square(state.body_rates).sum(axis=1),
            np.square(2.0 * half_tilt),
            np.square(commands - self._actions).sum(axis=1),
        )
        self._actions = commands
        self._sums = np.where(self._steps > self._braking, self._sums + squares, 0.0)

    def results(self) -> Mapping[str, Any]:
        steps = self._steps - self._braking
        counts = np.where(steps * self._control_step >= LEAST - 1e-9, steps, np.nan)
        rates, tilt, change = np.sqrt(self._sums / counts)
        per_second = change / (2.0 * self._control_step)  # of one command: the root of a quarter
        return dict(zip(HOVERED, (rates, np.degrees(tilt), per_second), strict=True))
