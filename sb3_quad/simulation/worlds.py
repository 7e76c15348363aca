"""How the world of an episode is sampled: its vehicle, and what pushes it."""

import math
from collections.abc import Sequence

import numpy as np

from sb3_quad.base.arrays import FloatArray
from sb3_quad.simulation.compiled import compiled
from sb3_quad.simulation.designs import DESIGN_SIZE, VehicleDistribution, arm_length
from sb3_quad.simulation.layout import first_rows, row_slices
from sb3_quad.simulation.observation import GUST_WORDS
from sb3_quad.simulation.random import GUST, PUSH, VEHICLE, uniforms
from sb3_quad.simulation.randomization import Randomization
from sb3_quad.simulation.ranges import FIXED, between
from sb3_quad.simulation.state import P, W
from sb3_quad.vehicles.vehicle import PARAMETER_NAMES, Vehicle

_RANGES = ("mass", "inertia", "motor_gain", "thrust", "arm", "center_of_mass", "delay")
VECTOR = {"length": 3, "by_weight": 1, "in_body": 1, "direction": 3, "axes": 3}
V = first_rows(VECTOR)
WORLD = {
    "share": 1,
    "wrench_share": 1,
    **dict.fromkeys(_RANGES, 3),
    **dict.fromkeys(("force", "torque"), sum(VECTOR.values())),
    "gust_std": 3,
    "gust_by_weight": 1,
    "gust_keeps": 1,
}
"""Numbers of :meth:`~sb3_quad.simulation.randomization.Randomization.numbers`; a range is low, high and how to sample."""
WORLD_SIZE = sum(WORLD.values())
R = first_rows(WORLD)
GUSTS = {"force": 3, "keeps": 1, "adds": 1}
"""Of each row: the present gust, world frame, N; what is left of it after a control step; the spread of what comes to it."""
GUST_SIZE = sum(GUSTS.values())
GUST_FORCE = row_slices(GUSTS)["force"]
G = first_rows(GUSTS)
_N_PARAMETERS = len(PARAMETER_NAMES)
_SEVEN = np.uint64(127)
_SUM_MEAN, _SUM_STD = 3 * 127 / 2, math.sqrt(3 * (128**2 - 1) / 12)  # of three whole numbers, uniform from 0 to 127


@compiled
def _push(table, k, column, length, height, azimuth, unit, wrench, world, body, i):
    """Add a constant force or torque, whose numbers begin at ``k``, to its rows of a wrench; ``unit``: in N or N m."""
    size = between(table, k, column, length, 0.0)
    if table[k + V.by_weight, column] != 0.0:
        size *= unit
    up = 2.0 * height - 1.0
    across = math.sqrt(max(0.0, 1.0 - up * up))
    x, y, z = across * math.cos(2.0 * math.pi * azimuth), across * math.sin(2.0 * math.pi * azimuth), up
    to = k + V.direction
    if table[to, column] != 0.0 or table[to + 1, column] != 0.0 or table[to + 2, column] != 0.0:
        x, y, z = table[to, column], table[to + 1, column], table[to + 2, column]
    rows, axes = body if table[k + V.in_body, column] != 0.0 else world, k + V.axes
    wrench[rows, i] = size * x * table[axes, column]
    wrench[rows + 1, i] = size * y * table[axes + 1, column]
    wrench[rows + 2, i] = size * z * table[axes + 2, column]


@compiled
def sample_vehicle(i, streams, nominal, table, vehicles):
    """The vehicle of row i's episode, in place.

    :param nominal: float64 (len(PARAMETER_NAMES), n or 1), of the vehicles that differ by ``table``, (WORLD_SIZE, n or 1).
    :param vehicles: float64 (len(PARAMETER_NAMES), n).
    """
    column, u = min(i, table.shape[1] - 1), uniforms(streams, i, 6, VEHICLE)
    for k in range(_N_PARAMETERS):
        vehicles[k, i] = nominal[k, min(i, nominal.shape[1] - 1)]
    if u[0] >= table[R.share, column]:
        return
    mass = between(table, R.mass, column, u[1], 1.0)
    vehicles[P.mass, i] *= mass
    vehicles[P.hover_thrust, i] *= mass
    for axis in range(3):
        vehicles[P.ixx + axis, i] *= between(table, R.inertia, column, u[2 + axis], 1.0)
    for axis in range(3):  # no body has one moment larger than the other two together
        others = vehicles[P.ixx + (axis + 1) % 3, i] + vehicles[P.ixx + (axis + 2) % 3, i]
        vehicles[P.ixx + axis, i] = min(vehicles[P.ixx + axis, i], others)
    vehicles[P.motor_gain, i] *= between(table, R.motor_gain, column, u[5], 1.0)
    thrust = between(table, R.thrust, column, u[6], 1.0)
    vehicles[P.thrust_middle, i] *= thrust
    vehicles[P.thrust_half_range, i] *= thrust
    arm = between(table, R.arm, column, u[7], 1.0)
    x, y = between(table, R.center_of_mass, column, u[8], 0.0), between(table, R.center_of_mass, column, u[9], 0.0)
    for rotor in range(4):  # roll arms are y of the rotors, pitch arms -x
        vehicles[P.roll_arm_0 + rotor, i] = arm * vehicles[P.roll_arm_0 + rotor, i] - y
        vehicles[P.pitch_arm_0 + rotor, i] = arm * vehicles[P.pitch_arm_0 + rotor, i] + x
    if table[R.delay + 2, column] != FIXED:
        vehicles[P.delay, i] = min(math.floor(between(table, R.delay, column, u[10], 0.0)), table[R.delay + 1, column] - 1.0)


@compiled
def _weight(i, nominal):
    column = min(i, nominal.shape[1] - 1)
    return nominal[P.mass, column] * nominal[P.gravity, column]


@compiled
def sample_wrench(i, streams, nominal, table, wrench):
    """The constant wrench of row i's episode, in place: ``wrench`` (WRENCH_SIZE, n)."""
    column, u = min(i, table.shape[1] - 1), uniforms(streams, i, 4, PUSH)
    for k in range(wrench.shape[0]):
        wrench[k, i] = 0.0
    if u[0] < table[R.wrench_share, column]:
        weight = _weight(i, nominal)
        moment = weight * arm_length(min(i, nominal.shape[1] - 1), nominal)
        _push(table, R.force, column, u[1], u[2], u[3], weight, wrench, W.force_world, W.force_body, i)
        _push(table, R.torque, column, u[4], u[5], u[6], moment, wrench, W.torque_world, W.torque_body, i)


@compiled
def sample_gust(i, streams, nominal, table, gust):
    """How row i's gusts are in its episode, and the first, in place: ``gust`` (GUST_SIZE, n)."""
    column = min(i, table.shape[1] - 1)
    for k in range(gust.shape[0]):
        gust[k, i] = 0.0
    if uniforms(streams, i, 1, PUSH)[0] >= table[R.wrench_share, column]:
        return
    u = uniforms(streams, i, 4, GUST)
    std = between(table, R.gust_std, column, u[0], 0.0)
    if table[R.gust_by_weight, column] != 0.0:
        std *= _weight(i, nominal)
    keeps = table[R.gust_keeps, column]
    gust[G.keeps, i], gust[G.adds, i] = keeps, std * math.sqrt(1.0 - keeps * keeps)
    for axis in range(3):  # stationary from the start; two normals from two uniforms (Box-Muller)
        radius = math.sqrt(-2.0 * math.log(u[2 + 2 * axis]))
        gust[G.force + axis, i] = std * radius * math.cos(2.0 * math.pi * u[3 + 2 * axis])


@compiled
def add_gusts(b, gust, first, count):
    """The present gusts of a block to its wrench."""
    wrench = b.wrench
    for axis in range(3):
        for lane in range(count):
            wrench[W.force_world + axis, lane] += gust[G.force + axis, first + lane]


@compiled
def advance_gusts(b, gust, first, count):
    """The gusts of a block one control step later, in place, by two random words of each lane.

    What comes to a component is the sum of three numbers of seven bits each, scaled: a process that remembers many control
    steps adds up so many of them that it is normal.
    """
    word = b.word
    for lane in range(count):
        i = first + lane
        bits = np.uint64(word[GUST_WORDS, lane]) | np.uint64(word[GUST_WORDS + 1, lane]) << np.uint64(32)
        for axis in range(3):
            part = bits >> np.uint64(21 * axis)
            added = np.float64(np.int64((part & _SEVEN) + (part >> np.uint64(7) & _SEVEN) + (part >> np.uint64(14) & _SEVEN)))
            kept = gust[G.keeps, i] * gust[G.force + axis, i]
            gust[G.force + axis, i] = kept + gust[G.adds, i] * ((added - _SUM_MEAN) / _SUM_STD)


def new_worlds(
    randomize: Randomization, designs: VehicleDistribution | None, vehicles: Sequence[Vehicle], given: FloatArray, n: int
) -> dict[str, FloatArray]:
    """Arrays of n rows, by name: the vehicles that fly and their nominal ones, how to sample both, and gusts.

    :param vehicles: n or one for all rows; ``given`` their parameters, (len(PARAMETER_NAMES), n or 1).
    :param designs: of the nominal vehicles; None: they are the given ones.
    :raises ConfigError: a world that one of them cannot be flown in.
    """
    each_row, still = n // len(vehicles), randomize == Randomization() and designs is None
    for each in {id(each): each for each in vehicles}.values():
        randomize.check(each if designs is None else designs.weakest(each))
    nominal = given if designs is None else np.repeat(given, each_row, axis=1)
    worlds = np.stack([randomize.numbers(each) for each in vehicles], axis=1)
    return {
        "nominal": nominal,
        "vehicles": np.repeat(nominal, each_row, axis=1) if randomize.sets_vehicle and designs is None else nominal.copy(),
        "designs": np.zeros((DESIGN_SIZE, 0)) if designs is None else designs.numbers()[:, None],
        "worlds": np.zeros((WORLD_SIZE, 0)) if still else worlds,
        "gust": np.zeros((GUST_SIZE, 0 if still else n)),
    }
