"""The true state of a batch of quadcopters, and its layout in memory.

One float64 array of shape ``(STATE_SIZE, n)`` holds n vehicles, a quantity per row and a vehicle per column
(structure of arrays, so that compiled loops over vehicles run over neighbouring numbers).

=========  ================  =======================================================================  ======
rows       name              meaning                                                                  unit
=========  ================  =======================================================================  ======
0:3        position          r, world frame                                                           m
3:7        quaternion        body to world, (w, x, y, z), unit norm                                   --
7:10       velocity          v, world frame                                                           m/s
10:13      body_rates        angular velocity, body frame (x forward, z up)                           rad/s
13:17      rotor_speeds      ω of each rotor; thrust F = kF ω² (Eq. 2.4)                              rad/s
17:20      target            r_T, world frame                                                         m
=========  ================  =======================================================================  ======
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

POSITION = slice(0, 3)
QUATERNION = slice(3, 7)
VELOCITY = slice(7, 10)
BODY_RATES = slice(10, 13)
ROTOR_SPEEDS = slice(13, 17)
TARGET = slice(17, 20)
STATE_SIZE = 20

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class QuadcopterState:
    """Read access to the true state of n vehicles; what an expert is given.

    :param array: float64 of shape ``(STATE_SIZE, n)``, laid out as this module's table says. The properties are views
        of it with one vehicle per row, so they show later changes: copy what must last.
    """

    array: FloatArray

    @property
    def n(self) -> int:
        """Number of vehicles."""
        return int(self.array.shape[1])

    @property
    def position(self) -> FloatArray:
        """r, shape (n, 3), world frame, m."""
        return self.array[POSITION].T

    @property
    def quaternion(self) -> FloatArray:
        """Body to world, shape (n, 4), (w, x, y, z)."""
        return self.array[QUATERNION].T

    @property
    def velocity(self) -> FloatArray:
        """v, shape (n, 3), world frame, m/s."""
        return self.array[VELOCITY].T

    @property
    def body_rates(self) -> FloatArray:
        """Angular velocity, shape (n, 3), body frame, rad/s."""
        return self.array[BODY_RATES].T

    @property
    def rotor_speeds(self) -> FloatArray:
        """Rotor speeds ω, shape (n, 4), rad/s."""
        return self.array[ROTOR_SPEEDS].T

    @property
    def target(self) -> FloatArray:
        """r_T, shape (n, 3), world frame, m."""
        return self.array[TARGET].T

    @property
    def rotation(self) -> FloatArray:
        """Rotation matrices R, body to world, shape (n, 3, 3)."""
        w, x, y, z = self.array[QUATERNION]
        rows = (
            (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        )
        return np.moveaxis(np.array(rows), -1, 0)

    @property
    def distance(self) -> FloatArray:
        """|r - r_T|, shape (n,), m."""
        error = self.array[POSITION] - self.array[TARGET]
        return np.asarray(np.sqrt(np.einsum("in,in->n", error, error)))

    def copy(self) -> QuadcopterState:
        """A state of its own memory, unaffected by later flight."""
        return QuadcopterState(self.array.copy())

    @staticmethod
    def concatenate(states: Sequence[QuadcopterState]) -> QuadcopterState:
        """Several states as one batch, in order."""
        return QuadcopterState(np.concatenate([state.array for state in states], axis=1))
