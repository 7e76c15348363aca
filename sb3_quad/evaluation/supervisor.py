"""A hook: whether the supervisor in a Crazyflie's firmware would have cut the motors of flights.

The rule is the Crazyflie's: ``isTumbledCheck`` in ``src/modules/src/supervisor.c`` of
bitcraze/crazyflie-firmware (commit 2a18fc2, 2026), with the constants ``SUPERVISOR_TUMBLE_CHECK_…``
of ``src/platform/interface/platform_defaults.h``.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from sb3_quad.base.types import BoolArray, Float32Array
from sb3_quad.envs.simulation.state import QuadcopterState
from sb3_quad.envs.vehicles.vehicle import GRAVITY, Vehicle
from sb3_quad.evaluation.hooks import Hook

# Specific forces in g, and the times in s that they may last
LOW = 0.5
LOW_TIME = 1.0
UPSIDE_DOWN = -0.2
UPSIDE_DOWN_TIME = 0.1
FREE_FALL = 0.1


class Supervisor(Hook):
    """Watches the specific force of n flights, which is what an accelerometer shows.

    The motors are cut once its component along body z has stayed below 0.5 g for more than 1.0 s,
    or has done so for more than 0.1 s and is below -0.2 g. Free fall, where no component reaches
    0.1 g, does not count, and restarts the time. A flight that would be cut continues here.

    >>> from sb3_quad import fly
    >>> from sb3_quad.evaluation.supervisor import Supervisor
    >>> supervisor = Supervisor()
    >>> flights = fly("pid", n_episodes=2, vehicle="crazyflie", hooks=[supervisor])
    >>> int(supervisor.results()["cut_by_supervisor"].sum())
    0

    ``cut_by_supervisor`` (n,) says which flights were cut, and ``low_force_time`` (n,) is the
    longest time below 0.5 g, s.

    The firmware checks every 40 ms, with a sensor filtered at 30 Hz; here every control step is
    checked, and the sensor has no noise.
    """

    def on_start(self, state: QuadcopterState, vehicle: Vehicle) -> None:
        self._control_step = vehicle.control_step
        self._steps = np.zeros(state.n)
        self._cut = np.zeros(state.n, bool)
        self._longest = np.zeros(state.n)

    def after_step(
        self, step: int, state: QuadcopterState, actions: Float32Array, flying: BoolArray
    ) -> None:
        force = state.specific_force / GRAVITY
        along_z = force[:, 2]
        falls = (np.abs(force) < FREE_FALL).all(axis=1)
        self._steps += 1.0
        self._steps *= (along_z < LOW) & ~falls & flying
        time = self._steps * self._control_step
        self._longest = np.maximum(self._longest, time)
        # A sum of control steps is exact only up to rounding.
        allowed = np.where(along_z < UPSIDE_DOWN, UPSIDE_DOWN_TIME, LOW_TIME) + 1e-9
        self._cut |= time > allowed

    def results(self) -> Mapping[str, Any]:
        return {"cut_by_supervisor": self._cut, "low_force_time": self._longest}
