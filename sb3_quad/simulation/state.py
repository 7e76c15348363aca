"""The true state of n quadcopters, the wrench that acts on them, and how both lie in memory.

One float64 array of shape ``(STATE_SIZE, n)`` holds n vehicles, a quantity per row and a vehicle
per column, so that compiled loops over vehicles run over neighbouring numbers. The order of the
rows is that of :data:`STATE`; :class:`QuadcopterState` says what they are.

A wrench is a ``(WRENCH_SIZE, n)`` array: ``force_world`` and ``force_body`` (N), ``torque_world``
and ``torque_body`` (N m), three rows each, all at the centre of mass.
"""

from collections import namedtuple
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import numpy as np

from sb3_quad.base.arrays import FloatArray
from sb3_quad.base.errors import ConfigError
from sb3_quad.simulation.physics import rotation_rows
from sb3_quad.vehicles.vehicle import PARAMETER_NAMES


def first_rows(sizes: Mapping[str, int]) -> Any:
    """The first row of each quantity, by its name, where ``sizes`` are how many rows each takes.

    Compiled code reads the numbers as constants, and none is counted by hand.

    >>> first_rows({"position": 3, "quaternion": 4})
    Rows(position=0, quaternion=3)
    """
    starts = [0, *accumulate(sizes.values())]
    rows: Any = namedtuple("Rows", list(sizes))  # type: ignore[misc]
    return rows._make(starts[:-1])


def row_slices(sizes: Mapping[str, int]) -> dict[str, slice]:
    """The rows of each quantity, by its name."""
    return {
        name: slice(start, start + sizes[name])
        for name, start in first_rows(sizes)._asdict().items()
    }


STATE = {
    "position": 3,
    "quaternion": 4,
    "velocity": 3,
    "body_rates": 3,
    "rotor_speeds": 4,
    "target": 3,
}
STATE_SIZE = sum(STATE.values())
POSITION, QUATERNION, VELOCITY, BODY_RATES, ROTOR_SPEEDS, TARGET = row_slices(STATE).values()

X = first_rows(STATE)

WRENCH = {"force_world": 3, "force_body": 3, "torque_world": 3, "torque_body": 3}
WRENCH_SIZE = sum(WRENCH.values())
FORCE_WORLD, FORCE_BODY, TORQUE_WORLD, TORQUE_BODY = row_slices(WRENCH).values()
W = first_rows(WRENCH)

P = first_rows(dict.fromkeys(PARAMETER_NAMES, 1))  # of a vehicle's parameters


@dataclass(frozen=True, eq=False)
class QuadcopterState:
    """Read access to the true state of n vehicles; what an expert is given.

    :param array: float64 of shape ``(STATE_SIZE, n)``, its rows in the order of :data:`STATE`. The
        properties are views of it with one vehicle per row, so they show later changes: copy what
        must last.
    :param vehicles: the true parameters of the vehicles, float64 ``(len(PARAMETER_NAMES), n)``,
        their rows in the order of :data:`~sb3_quad.vehicles.vehicle.PARAMETER_NAMES`; None:
        unknown.
    :param wrench: what pushes them, float64 ``(WRENCH_SIZE, n)``, its rows in the order of
        :data:`WRENCH`; None: unknown.
    """

    array: FloatArray
    vehicles: FloatArray | None = None
    wrench: FloatArray | None = None

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
        """Body to world, shape (n, 4), (w, x, y, z), unit norm."""
        return self.array[QUATERNION].T

    @property
    def velocity(self) -> FloatArray:
        """v, shape (n, 3), world frame, m/s."""
        return self.array[VELOCITY].T

    @property
    def body_rates(self) -> FloatArray:
        """Angular velocity, shape (n, 3), body frame (x forward, z up), rad/s."""
        return self.array[BODY_RATES].T

    @property
    def rotor_speeds(self) -> FloatArray:
        """Rotor speeds ω, shape (n, 4), rad/s; each gives a thrust F = kF ω² (Eq. 2.4)."""
        return self.array[ROTOR_SPEEDS].T

    @property
    def target(self) -> FloatArray:
        """r_T, shape (n, 3), world frame, m."""
        return self.array[TARGET].T

    @property
    def rotation(self) -> FloatArray:
        """Rotation matrices R, body to world, shape (n, 3, 3)."""
        return rotation_matrices(self.quaternion)

    @property
    def distance(self) -> FloatArray:
        """|r - r_T|, shape (n,), m."""
        error = self.array[POSITION] - self.array[TARGET]
        return np.asarray(np.sqrt(np.einsum("in,in->n", error, error)))

    def copy(self) -> "QuadcopterState":
        """A state of its own memory, unaffected by later flight."""
        return self._each(np.copy)

    def rows(self, rows: slice) -> "QuadcopterState":
        """Some of the vehicles, views."""
        return self._each(lambda part: part[:, rows])

    def _each(self, change: Callable[[FloatArray], FloatArray]) -> "QuadcopterState":
        vehicles, wrench = (
            None if part is None else change(part) for part in (self.vehicles, self.wrench)
        )
        return QuadcopterState(change(self.array), vehicles, wrench)

    @staticmethod
    def concatenate(states: Sequence["QuadcopterState"]) -> "QuadcopterState":
        """Several states as one batch, in order; what one of them does not know is unknown."""

        def joined(parts: list[FloatArray | None]) -> FloatArray | None:
            known = [part for part in parts if part is not None]
            return np.concatenate(known, axis=1) if len(known) == len(states) else None

        array = np.concatenate([state.array for state in states], axis=1)
        return QuadcopterState(
            array,
            joined([each.vehicles for each in states]),
            joined([each.wrench for each in states]),
        )


def rotation_matrices(quaternions: FloatArray) -> FloatArray:
    """Rotation matrices R, body to world, (n, 3, 3), of unit quaternions (n, 4), (w, x, y, z)."""
    return np.moveaxis(np.array(rotation_rows.py_func(*quaternions.T)), -1, 0)


def drag_forces(state: FloatArray, vehicles: FloatArray, wind: FloatArray) -> FloatArray:
    """Drag of n vehicles, (3, n), world frame, N: -R diag(d) Rᵀ (v - wind) (Faessler, Franchi and
    Scaramuzza, RA-L 2018).

    :param state: (STATE_SIZE, n).
    :param vehicles: parameters, (len(PARAMETER_NAMES), n).
    :param wind: velocity of the air, (3, n), world frame, m/s.
    """
    rotation, airspeed = rotation_matrices(state[QUATERNION].T), state[VELOCITY] - wind
    in_body = vehicles[P.drag_x : P.drag_z + 1] * np.einsum("nji,jn->in", rotation, airspeed)
    return np.asarray(-np.einsum("nij,jn->in", rotation, in_body))


def make_wrench(
    force: FloatArray, torque: FloatArray, force_frame: str = "world", torque_frame: str = "body"
) -> FloatArray:
    """The wrench of n vehicles, (WRENCH_SIZE, n).

    :param force: (n, 3), N; ``torque`` (n, 3), N m; both at the centre of mass.
    :param force_frame: ``"world"`` or ``"body"``, the axes of ``force``; ``torque_frame`` those of
        ``torque``.
    :raises ConfigError: another frame.
    """
    wrench = np.zeros((WRENCH_SIZE, len(force)))
    rows: Any = row_slices(WRENCH)
    for kind, values, frame in (("force", force, force_frame), ("torque", torque, torque_frame)):
        if frame not in ("world", "body"):
            raise ConfigError(f"{kind}_frame {frame!r}: must be 'world' or 'body'")
        wrench[rows[f"{kind}_{frame}"]] = values.T
    return wrench
