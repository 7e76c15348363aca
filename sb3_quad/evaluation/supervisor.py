"""Whether the supervisor in a flight controller's firmware would have cut the motors of flights.

The rule is the Crazyflie's: ``isTumbledCheck`` in ``src/modules/src/supervisor.c`` of
bitcraze/crazyflie-firmware (commit 2a18fc2, 2026), with the constants ``SUPERVISOR_TUMBLE_CHECK_…``
of ``src/platform/interface/platform_defaults.h``.
"""

from collections.abc import Sequence

import numpy as np

from sb3_quad.base.types import BoolArray
from sb3_quad.envs.simulation.state import QuadcopterState
from sb3_quad.envs.vehicles.vehicle import GRAVITY, Vehicle

# Specific forces in g, and the times in s that they may last
LOW = 0.5
LOW_TIME = 1.0
UPSIDE_DOWN = -0.2
UPSIDE_DOWN_TIME = 0.1
FREE_FALL = 0.1
SUPERVISED = ("cut_by_supervisor", "low_force_time")


class Supervisor:
    """Tracks the specific force of n flights, which is what an accelerometer shows.

    The motors are cut once its component along body z has stayed below 0.5 g for more than 1.0 s,
    or has done so for more than 0.1 s and is below -0.2 g. Free fall, where no component reaches
    0.1 g, does not count, and restarts the time. A flight that would be cut continues here.

    ``cut`` (n,) says which were. ``longest`` (n,) is the longest time below 0.5 g, s; NaN if the
    vehicle's file names no ``supervisor``.

    The firmware checks every 40 ms, with a sensor filtered at 30 Hz; here every control step is
    checked, and the sensor has no noise.

    :param vehicles: vehicles of the flights, (n,).
    """

    def __init__(self, vehicles: Sequence[Vehicle]) -> None:
        self._control_step = vehicles[0].control_step
        self._watched = np.array([vehicle.supervisor is not None for vehicle in vehicles])
        self._steps = np.zeros(len(vehicles))
        self.cut = np.zeros(len(vehicles), bool)
        self.longest = np.where(self._watched, 0.0, np.nan)

    def update(self, state: QuadcopterState, flying: BoolArray) -> None:
        """See the state after a control step; only the flights (n,) that continue count."""
        if not self._watched.any():
            return
        force = state.specific_force / GRAVITY
        along_z = force[:, 2]
        falls = (np.abs(force) < FREE_FALL).all(axis=1)
        self._steps += 1.0
        self._steps *= (along_z < LOW) & ~falls & flying & self._watched
        time = self._steps * self._control_step
        self.longest = np.maximum(self.longest, time)
        # A sum of control steps is exact only up to rounding.
        allowed = np.where(along_z < UPSIDE_DOWN, UPSIDE_DOWN_TIME, LOW_TIME) + 1e-9
        self.cut |= time > allowed
