"""The true state of n quadcopters, the wrench that acts on them, and their layout in memory.

One float64 array of shape ``(STATE_SIZE, n)`` holds n vehicles, a quantity per row and a vehicle
per column, so that compiled loops over vehicles run over neighbouring numbers. The order of the
rows is that of :data:`STATE`; :class:`QuadcopterState` says what they are.

A wrench is a ``(WRENCH_SIZE, n)`` array: ``force_world`` and ``force_body`` (N), ``torque_world``
and ``torque_body`` (N m), three rows each, all at the centre of mass.
"""

from collections import namedtuple
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import numpy as np

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.types import FloatArray
from sb3_quad.envs.simulation.physics import rotation_rows
from sb3_quad.envs.vehicles.vehicle import PARAMETER_NAMES


def first_rows(sizes: Mapping[str, int]) -> Any:
    """Return the first row of each quantity, by its name.

    Compiled code reads these numbers as constants, and none is counted by hand.

    :param sizes: number of rows of each quantity.

    >>> first_rows({"position": 3, "quaternion": 4})
    Rows(position=0, quaternion=3)
    """
    starts = [0, *accumulate(sizes.values())]
    rows: Any = namedtuple("Rows", list(sizes))  # type: ignore[misc]
    return rows._make(starts[:-1])


def row_slices(sizes: Mapping[str, int]) -> dict[str, slice]:
    """Return the rows of each quantity, by its name."""
    starts = first_rows(sizes)._asdict()
    return {name: slice(start, start + sizes[name]) for name, start in starts.items()}


AHEAD = 0.2  # s

REFERENCE_PARTS = {
    "target": 3,
    "target_velocity": 3,
    "target_acceleration": 3,
    # Its cosine and sine; both zero if no heading is commanded
    "target_heading": 2,
    "target_heading_rate": 1,
    # The acceleration in AHEAD seconds, for experts; the present one if it is unknown
    "target_ahead": 3,
}
"""Where the vehicle should be, and how that moves: the last rows of :data:`STATE`."""
REFERENCE_SIZE = sum(REFERENCE_PARTS.values())

STATE = {
    "position": 3,
    "quaternion": 4,
    "velocity": 3,
    "body_rates": 3,
    "rotor_speeds": 4,
    **REFERENCE_PARTS,
}
STATE_SIZE = sum(STATE.values())
POSITION, QUATERNION, VELOCITY, BODY_RATES, ROTOR_SPEEDS, TARGET = [*row_slices(STATE).values()][:6]

X = first_rows(STATE)
REFERENCE = slice(X.target, STATE_SIZE)

WRENCH = {"force_world": 3, "force_body": 3, "torque_world": 3, "torque_body": 3}
WRENCH_SIZE = sum(WRENCH.values())
FORCE_WORLD, FORCE_BODY, TORQUE_WORLD, TORQUE_BODY = row_slices(WRENCH).values()
W = first_rows(WRENCH)

# The rows of a vehicle's parameters
P = first_rows(dict.fromkeys(PARAMETER_NAMES, 1))
# Of those, what the wind acts through, and what switches the terms of aerodynamics.py off
FELT = [*range(P.drag_x, P.drag_z + 1), *range(P.rotor_drag_x, P.rate_damping_x)]
STILL = np.array([[0.0]] * (P.thrust_factor_0 - P.rotor_drag_x) + [[1.0]] * 4)


@dataclass(frozen=True, eq=False)
class QuadcopterState:
    """Read access to the true state of n vehicles, which experts act on.

    :param array: float64 of shape ``(STATE_SIZE, n)``, its rows in the order of :data:`STATE`. The
        properties are views of it with one vehicle per row, so they show later changes: copy
        whatever must last.
    :param vehicles: the true parameters of the vehicles, float64 ``(len(PARAMETER_NAMES), n)``,
        their rows in the order of :data:`~sb3_quad.envs.vehicles.vehicle.PARAMETER_NAMES`; None if
        they are unknown.
    :param wrench: the external forces and torques, float64 ``(WRENCH_SIZE, n)``, its rows in the
        order of :data:`WRENCH`; None if they are unknown.
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
        """Rotor speeds ω, shape (n, 4), rad/s; each yields a thrust F = kF ω² (Eq. 2.4)."""
        return self.array[ROTOR_SPEEDS].T

    @property
    def target(self) -> FloatArray:
        """r_T, shape (n, 3), world frame, m: the position of the reference."""
        return self.array[TARGET].T

    @property
    def target_velocity(self) -> FloatArray:
        """Velocity of the reference, shape (n, 3), world frame, m/s."""
        return self.array[X.target_velocity : X.target_acceleration].T

    @property
    def target_heading(self) -> FloatArray:
        """Cosine and sine of the commanded heading, (n, 2); zeros if there is none."""
        return self.array[X.target_heading : X.target_heading_rate].T

    @property
    def rotation(self) -> FloatArray:
        """Rotation matrices R, body to world, shape (n, 3, 3)."""
        return rotation_matrices(self.quaternion)

    @property
    def specific_force(self) -> FloatArray:
        """What an accelerometer at the centre of mass shows, shape (n, 3), body frame, m/s^2: all
        forces except the weight, divided by the mass. ``vehicles`` and ``wrench`` must be known.
        """
        assert self.vehicles is not None and self.wrench is not None
        force = np.einsum("nji,jn->ni", self.rotation, self.wrench[FORCE_WORLD])
        force += self.wrench[FORCE_BODY].T
        force[:, 2] += thrusts_far_from_ground(self.array, self.vehicles)
        return np.asarray(force / self.vehicles[P.mass][:, None])

    @property
    def distance(self) -> FloatArray:
        """|r - r_T|, shape (n,), m."""
        error = self.array[POSITION] - self.array[TARGET]
        return np.asarray(np.sqrt(np.einsum("in,in->n", error, error)))

    def copy(self) -> "QuadcopterState":
        """Return a state with its own memory, unaffected by later flight."""
        # Concatenation copies, even a single part.
        return QuadcopterState.concatenate([self])

    def rows(self, rows: slice) -> "QuadcopterState":
        """Return some of the vehicles, as views."""
        known = (self.vehicles, self.wrench)
        others = [None if array is None else array[:, rows] for array in known]
        return QuadcopterState(self.array[:, rows], *others)

    @staticmethod
    def concatenate(states: Sequence["QuadcopterState"]) -> "QuadcopterState":
        """Return several states as one batch, in order. Vehicles or wrench are unknown if one of
        the states does not know them.
        """
        columns = [(state.array, state.vehicles, state.wrench) for state in states]
        joined: list[Any] = []
        for arrays in zip(*columns, strict=True):
            unknown = any(array is None for array in arrays)
            joined.append(None if unknown else np.concatenate(arrays, axis=1))
        return QuadcopterState(*joined)


def rotation_matrices(quaternions: FloatArray) -> FloatArray:
    """Return rotation matrices R, body to world, (n, 3, 3).

    :param quaternions: unit quaternions (w, x, y, z), (n, 4).
    """
    return np.moveaxis(np.array(rotation_rows.py_func(*quaternions.T)), -1, 0)


def drag_forces(state: FloatArray, vehicles: FloatArray, wind: FloatArray) -> FloatArray:
    """Return the drag of n vehicles, (3, n), world frame, N.

    It is -R diag(d + k Σω) Rᵀ (v - wind), with the sum Σω of the rotor speeds (Faessler, Franchi
    and Scaramuzza, RA-L 2018).

    :param state: (STATE_SIZE, n).
    :param vehicles: parameters, (len(PARAMETER_NAMES), n).
    :param wind: velocity of the air, (3, n), world frame, m/s.
    """
    force, _ = _drag_and_airspeed(state, vehicles, wind)
    return force


def _drag_and_airspeed(
    state: FloatArray, vehicles: FloatArray, wind: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return :func:`drag_forces`, and the airspeeds, (3, n), body frame, m/s."""
    rotation = rotation_matrices(state[QUATERNION].T)
    airspeed = np.einsum("nji,jn->in", rotation, state[VELOCITY] - wind)
    by_rotors = vehicles[P.rotor_drag_x : P.rotor_drag_z + 1] * state[ROTOR_SPEEDS].sum(axis=0)
    in_body = (vehicles[P.drag_x : P.drag_z + 1] + by_rotors) * airspeed
    return -np.einsum("nij,jn->in", rotation, in_body), airspeed


def air_wrenches(state: FloatArray, vehicles: FloatArray, wind: FloatArray) -> FloatArray:
    """Return the wrench of the air on n vehicles, (WRENCH_SIZE, n): drag, and what
    :mod:`.aerodynamics` lists. The yaw reaction of rotors that speed up and the ground effect are
    not included.

    The arguments are those of :func:`drag_forces`.
    """
    wrench = np.zeros((WRENCH_SIZE, state.shape[1]))
    wrench[FORCE_WORLD], (vx, vy, _) = _drag_and_airspeed(state, vehicles, wind)
    wrench[W.force_body + 2] = vehicles[P.translational_lift] * (vx**2 + vy**2)
    total = state[ROTOR_SPEEDS].sum(axis=0)
    momentum = rotor_momenta(vehicles, state[ROTOR_SPEEDS])
    roll_rate, pitch_rate, _ = state[BODY_RATES]
    roll = vehicles[P.airspeed_moment_roll] * total * vy - momentum * pitch_rate
    pitch = momentum * roll_rate - vehicles[P.airspeed_moment_pitch] * total * vx
    damping = vehicles[P.rate_damping_x : P.rate_damping_z + 1]
    wrench[TORQUE_BODY] = np.stack([roll, pitch, 0.0 * roll]) - damping * state[BODY_RATES]
    return wrench


def rotor_momenta(vehicles: FloatArray, speeds: FloatArray) -> FloatArray:
    """Return the angular momenta of the rotors about body z, (n,), N m s, at speeds (4, n)."""
    spins = -np.sign(vehicles[P.yaw_arm_0 : P.yaw_arm_0 + 4])
    return np.asarray(vehicles[P.rotor_inertia] * (spins * speeds).sum(axis=0))


def ground_effects(state: FloatArray, vehicles: FloatArray) -> FloatArray:
    """Return the factors of the thrust of n vehicles near the ground, (n,)."""
    radius = vehicles[P.ground_effect_radius]
    height = np.maximum(state[X.position + 2], np.maximum(0.5 * radius, 1e-9))
    return np.asarray(1.0 / (1.0 - (radius / (4.0 * height)) ** 2))


def thrusts_far_from_ground(state: FloatArray, vehicles: FloatArray) -> FloatArray:
    """Return the sums of the rotor thrusts of n vehicles without ground effect, (n,), N."""
    factors = vehicles[P.thrust_factor_0 : P.thrust_factor_0 + 4]
    squares = (factors * np.square(state[ROTOR_SPEEDS])).sum(axis=0)
    return np.asarray(vehicles[P.thrust_coefficient] * squares)


def make_wrench(
    force: FloatArray, torque: FloatArray, force_frame: str = "world", torque_frame: str = "body"
) -> FloatArray:
    """Return the wrench of n vehicles, (WRENCH_SIZE, n).

    :param force: (n, 3), N; ``torque`` (n, 3), N m; both at the centre of mass.
    :param force_frame: ``"world"`` or ``"body"``, the axes of ``force``; ``torque_frame`` those of
        ``torque``.
    :raises ConfigError: another frame.
    """
    wrench = np.zeros((WRENCH_SIZE, len(force)))
    rows: Any = row_slices(WRENCH)
    for kind, values, frame in (("force", force, force_frame), ("torque", torque, torque_frame)):
        name = f"{kind}_{frame}"
        if name not in rows:
            raise ConfigError(f"{kind}_frame {frame!r}: must be 'world' or 'body'")
        wrench[rows[name]] = values.T
    return wrench
