"""How the world of an episode is sampled: its vehicle, and what pushes it."""

import math

import numpy as np

from sb3_quad.simulation.engine.block import P, W
from sb3_quad.simulation.engine.lowlevel import compiled
from sb3_quad.simulation.engine.random import WORLD as PURPOSE
from sb3_quad.simulation.engine.random import uniforms
from sb3_quad.simulation.layout import first_rows
from sb3_quad.simulation.randomization import FIXED, LOG_UNIFORM
from sb3_quad.vehicles.vehicle import PARAMETER_NAMES

_RANGES = ("mass", "inertia", "motor_gain", "thrust", "arm", "center_of_mass", "delay")
_VECTOR = {"": 3, "_unit": 1, "_in_body": 1, "_direction": 3, "_axes": 3}
WORLD = {
    "share": 1,
    "wrench_share": 1,
    **dict.fromkeys(_RANGES, 3),
    **{f"{name}{part}": size for name in ("force", "torque") for part, size in _VECTOR.items()},
    "gust_std": 3,
    "gust_keeps": 1,
}
"""Numbers of :meth:`~sb3_quad.simulation.randomization.Randomization.numbers`; a range is low, high and how to sample."""
WORLD_SIZE = sum(WORLD.values())
R = first_rows(WORLD)
GUST = {"force": 3, "std": 1, "keeps": 1}
"""Of each row: the present gust, world frame, N; its standard deviation; what is left of it after a control step."""
GUST_SIZE = sum(GUST.values())
G = first_rows(GUST)
_N_PARAMETERS = len(PARAMETER_NAMES)


@compiled
def _between(table, k, column, u, nominal):
    low, high, kind = table[k, column], table[k + 1, column], table[k + 2, column]
    if kind == FIXED:
        return nominal
    return low * (high / low) ** u if kind == LOG_UNIFORM else low + (high - low) * u


@compiled
def _push(table, k, column, length, height, azimuth, wrench, world, body, i):
    """Add a constant force or torque, whose numbers begin at ``k``, to its rows of a wrench."""
    size = _between(table, k, column, length, 0.0) * table[k + 3, column]
    up = 2.0 * height - 1.0
    across = math.sqrt(max(0.0, 1.0 - up * up))
    x, y, z = across * math.cos(2.0 * math.pi * azimuth), across * math.sin(2.0 * math.pi * azimuth), up
    if table[k + 5, column] != 0.0 or table[k + 6, column] != 0.0 or table[k + 7, column] != 0.0:
        x, y, z = table[k + 5, column], table[k + 6, column], table[k + 7, column]
    rows = body if table[k + 4, column] != 0.0 else world
    wrench[rows, i] = size * x * table[k + 8, column]
    wrench[rows + 1, i] = size * y * table[k + 9, column]
    wrench[rows + 2, i] = size * z * table[k + 10, column]


@compiled
def sample_world(i, streams, nominal, table, sets_wrench, vehicles, wrench, gust):
    """The vehicle and the wrench of row i's episode, in place.

    :param nominal: float64 (len(PARAMETER_NAMES), n or 1), of the vehicles that differ by ``table`` (WORLD_SIZE, n or 1).
    :param sets_wrench: whether the wrench is replaced.
    :param vehicles: float64 (len(PARAMETER_NAMES), n); ``wrench`` (WRENCH_SIZE, n); ``gust`` (GUST_SIZE, n).
    """
    column = min(i, nominal.shape[1] - 1)
    u = uniforms(streams, i, 13, PURPOSE)
    for k in range(_N_PARAMETERS):
        vehicles[k, i] = nominal[k, column]
    if u[0] < table[R.share, column]:
        mass = _between(table, R.mass, column, u[1], 1.0)
        vehicles[P.mass, i] *= mass
        vehicles[P.hover_thrust, i] *= mass
        for axis in range(3):
            vehicles[P.ixx + axis, i] *= _between(table, R.inertia, column, u[2 + axis], 1.0)
        for axis in range(3):  # no body has one moment larger than the other two together
            others = vehicles[P.ixx + (axis + 1) % 3, i] + vehicles[P.ixx + (axis + 2) % 3, i]
            vehicles[P.ixx + axis, i] = min(vehicles[P.ixx + axis, i], others)
        vehicles[P.motor_gain, i] *= _between(table, R.motor_gain, column, u[5], 1.0)
        thrust = _between(table, R.thrust, column, u[6], 1.0)
        vehicles[P.thrust_middle, i] *= thrust
        vehicles[P.thrust_half_range, i] *= thrust
        arm = _between(table, R.arm, column, u[7], 1.0)
        x, y = _between(table, R.center_of_mass, column, u[8], 0.0), _between(table, R.center_of_mass, column, u[9], 0.0)
        for rotor in range(4):  # roll arms are y of the rotors, pitch arms -x
            vehicles[P.roll_arm_0 + rotor, i] = arm * vehicles[P.roll_arm_0 + rotor, i] - y
            vehicles[P.pitch_arm_0 + rotor, i] = arm * vehicles[P.pitch_arm_0 + rotor, i] + x
        if table[R.delay + 2, column] != FIXED:
            steps = table[R.delay + 1, column] - table[R.delay, column] + 1.0
            vehicles[P.delay, i] = table[R.delay, column] + min(math.floor(steps * u[10]), steps - 1.0)
    pushed = u[11] < table[R.wrench_share, column]
    if sets_wrench:
        for k in range(wrench.shape[0]):
            wrench[k, i] = 0.0
        if pushed:
            _push(table, R.force, column, u[12], u[13], u[14], wrench, W.force_world, W.force_body, i)
            _push(table, R.torque, column, u[15], u[16], u[17], wrench, W.torque_world, W.torque_body, i)
    std = _between(table, R.gust_std, column, u[18], 0.0) if pushed else 0.0
    gust[G.std, i], gust[G.keeps, i] = std, table[R.gust_keeps, column]
    for axis in range(3):  # stationary from the start; two normals from two uniforms (Box-Muller)
        radius = math.sqrt(-2.0 * math.log(u[20 + 2 * axis]))
        gust[G.force + axis, i] = std * radius * math.cos(2.0 * math.pi * u[21 + 2 * axis])


@compiled
def advance_gust(i, gust, x, y, z):
    """Row i's gust one control step later, in place, from three standard normals."""
    keeps = gust[G.keeps, i]
    adds = gust[G.std, i] * math.sqrt(1.0 - keeps * keeps)
    gust[G.force, i] = keeps * gust[G.force, i] + adds * x
    gust[G.force + 1, i] = keeps * gust[G.force + 1, i] + adds * y
    gust[G.force + 2, i] = keeps * gust[G.force + 2, i] + adds * z


def no_table(columns: int = 0) -> np.ndarray:
    """The table of rows in a nominal world."""
    return np.zeros((WORLD_SIZE, columns))
