"""How episodes begin: what a task, a Randomization and a VehicleDistribution sample for each."""

import math

import numpy as np

from sb3_quad.simulation.compiled import compiled
from sb3_quad.simulation.observation import GUST_WORDS
from sb3_quad.simulation.random import (
    EPISODE,
    EPISODE_START,
    GUST,
    DISTURBANCE,
    STEP,
    VEHICLE,
    WIND,
    uniforms,
)
from sb3_quad.simulation.randomization import FIXED, FIXED_NUMBERS, R, V, between
from sb3_quad.simulation.state import P, W, X, first_rows, row_slices
from sb3_quad.simulation.tasks import T
from sb3_quad.simulation.vehicle_distribution import arm_length, sample_from_distribution

GUSTS = {"value": 3, "keeps": 1, "adds": 1}
"""Of each row: the present gust, world frame, N or m/s; the share left after a control step; the
spread of what is added.
"""
GUST_SIZE = sum(GUSTS.values())
GUST_VALUE = row_slices(GUSTS)["value"]
G = first_rows(GUSTS)
TURN = 2.0 * math.pi
_SEVEN = np.uint64(127)
_SUM_MEAN, _SUM_STD = (
    3 * 127 / 2,
    math.sqrt(3 * (128**2 - 1) / 12),
)  # of three whole numbers, uniform from 0 to 127


@compiled
def count_episode(i, streams):
    """Row i's stream goes on to its next episode, in place."""
    streams[EPISODE, i] += np.uint32(1)
    streams[STEP, i] = np.uint32(0)


@compiled
def start_episode(i, state, queue, streams, task_index, vehicles, tasks, weights):
    """Begin the episode that row i's stream has come to, in place: a task, state and target sampled
    from it.

    Targets are never below ground.

    :param state: float64 (STATE_SIZE, n), see :mod:`.state`.
    :param queue: float64 (delay, 4, n), commanded rotor speeds on their way: hover.
    :param streams: uint32 (4, n), see :mod:`.random`.
    :param task_index: int64 (n,), the sampled row of the table of tasks.
    :param vehicles: float64 (len(PARAMETER_NAMES), n), or (len(PARAMETER_NAMES), 1) for all rows.
    :param tasks: float64 (K, columns), :meth:`sb3_quad.simulation.tasks.Task.parameters` of each
        task.
    :param weights: float64 (K,), cumulative.
    """
    u = uniforms(streams, i, 7, EPISODE_START)
    choice, height, azimuth = u[0], u[1], TURN * u[2]
    k = 0
    while k < weights.shape[0] - 1 and choice >= weights[k]:
        k += 1
    task_index[i] = k
    column = min(i, vehicles.shape[1] - 1)
    z = tasks[k, T.start_position + 2]

    nearest = tasks[k, T.nearest_target]
    distance = nearest + (tasks[k, T.target_distance] - nearest) * u[12]
    # A uniform direction has a uniform height (Archimedes): cut it where the target would lie too
    # close to the ground.
    ground = vehicles[P.collision_radius, column] + tasks[k, T.target_clearance]
    lowest = min(max(-1.0, (ground - z) / distance), 1.0) if distance > 0.0 else -1.0
    up = lowest + (1.0 - lowest) * height
    across = math.sqrt(max(0.0, 1.0 - up * up))
    for axis in range(3):
        state[X.position + axis, i] = tasks[k, T.start_position + axis]
    state[X.target, i] = state[X.position, i] + distance * across * math.cos(azimuth)
    state[X.target + 1, i] = state[X.position + 1, i] + distance * across * math.sin(azimuth)
    state[X.target + 2, i] = z + distance * up

    qw, qx, qy, qz = 1.0, 0.0, 0.0, 0.0
    if tasks[k, T.random_attitude] != 0.0:  # uniform on SO(3) (Shoemake)
        a, b, alpha, beta = math.sqrt(1.0 - u[3]), math.sqrt(u[3]), TURN * u[4], TURN * u[5]
        qw, qx, qy, qz = (
            b * math.cos(beta),
            a * math.sin(alpha),
            a * math.cos(alpha),
            b * math.sin(beta),
        )
    state[X.quaternion, i], state[X.quaternion + 1, i] = qw, qx
    state[X.quaternion + 2, i], state[X.quaternion + 3, i] = qy, qz
    spin = math.hypot(tasks[k, T.body_rates_std], tasks[k, T.hit_rates_std])
    for axis in range(3):  # two normals from two uniforms (Box-Muller)
        radius, angle = math.sqrt(-2.0 * math.log(u[6 + 2 * axis])), TURN * u[7 + 2 * axis]
        state[X.velocity + axis, i] = tasks[k, T.velocity_std] * radius * math.cos(angle)
        state[X.body_rates + axis, i] = spin * radius * math.sin(angle)
    hover = math.sqrt(vehicles[P.hover_thrust, column] / vehicles[P.thrust_coefficient, column])
    for rotor in range(4):
        state[X.rotor_speeds + rotor, i] = hover
        for late in range(queue.shape[0]):
            queue[late, rotor, i] = hover


@compiled
def sample_episode(i, streams, base, distribution, table, vehicles, wrench, gust, wind, wind_gust):
    """The vehicle, the constant wrench and wind, and the first gusts of row i's episode, in place;
    the rest stays as it is.

    :param base: float64 (len(PARAMETER_NAMES), n or 1), the vehicles before anything is random.
    :param distribution: :meth:`.VehicleDistribution.numbers`.
    :param table: :meth:`.Randomization.numbers`.
    :param vehicles: float64 (len(PARAMETER_NAMES), n), or (len(PARAMETER_NAMES), 1) if one serves
        all rows.
    :param wrench: float64 (WRENCH_SIZE, n).
    :param gust: float64 (GUST_SIZE, n), or (GUST_SIZE, 0) without gusts; ``wind_gust`` likewise.
    :param wind: float64 (3, n).
    """
    has_own_vehicle = vehicles.shape[1] == wrench.shape[1]
    if has_own_vehicle:
        for k in range(vehicles.shape[0]):
            vehicles[k, i] = base[k, min(i, base.shape[1] - 1)]
        sample_from_distribution(i, streams, distribution, vehicles)
    # Forces in weights are those of the vehicle before it is randomised.
    column, u = min(i, vehicles.shape[1] - 1), uniforms(streams, i, 4, DISTURBANCE)
    is_disturbed, weight = (
        u[0] < table[R.wrench_share],
        vehicles[P.mass, column] * vehicles[P.gravity, column],
    )
    if table[R.force + 2] != FIXED or table[R.torque + 2] != FIXED:
        for k in range(wrench.shape[0]):
            wrench[k, i] = 0.0
        if is_disturbed:
            moment = weight * arm_length(column, vehicles)
            _push(table, R.force, u[1], u[2], u[3], weight, wrench, W.force_world, W.force_body, i)
            _push(
                table, R.torque, u[4], u[5], u[6], moment, wrench, W.torque_world, W.torque_body, i
            )
    if gust.shape[1] > 0:
        unit = weight if table[R.gust_by_weight] != 0.0 else 1.0
        _begin_gusts(i, table, R.gust_std, unit * is_disturbed, uniforms(streams, i, 4, GUST), gust)
    if table[R.wind + 2] != FIXED or wind_gust.shape[1] > 0:
        _begin_wind(i, streams, table, is_disturbed, wind, wind_gust)
    if has_own_vehicle:
        _randomize_vehicle(i, streams, table, vehicles)


@compiled
def _push(table, k, length, height, azimuth, unit, wrench, world, body, i):
    """Write a constant vector, whose numbers begin at ``k``, to its rows of a wrench or wind;
    ``unit``: of a weight, SI.
    """
    size = between(table, k, length, 0.0)
    if table[k + V.by_weight] != 0.0:
        size *= unit
    up = 2.0 * height - 1.0
    across = math.sqrt(max(0.0, 1.0 - up * up))
    x, y, z = (
        across * math.cos(2.0 * math.pi * azimuth),
        across * math.sin(2.0 * math.pi * azimuth),
        up,
    )
    to = k + V.direction
    if table[to] != 0.0 or table[to + 1] != 0.0 or table[to + 2] != 0.0:
        x, y, z = table[to], table[to + 1], table[to + 2]
    rows, axes = body if table[k + V.in_body] != 0.0 else world, k + V.axes
    wrench[rows, i] = size * x * table[axes]
    wrench[rows + 1, i] = size * y * table[axes + 1]
    wrench[rows + 2, i] = size * z * table[axes + 2]


@compiled
def _randomize_vehicle(i, streams, table, vehicles):
    """Multiply the parameters of vehicle i by the factors of the row's episode, in place."""
    u, nominal_mass = uniforms(streams, i, 7, VEHICLE), vehicles[P.mass, i]
    if u[0] >= table[R.share]:
        return
    mass = between(table, R.mass, u[1], 1.0)
    vehicles[P.mass, i] *= mass
    vehicles[P.hover_thrust, i] *= mass
    for axis in range(3):
        vehicles[P.ixx + axis, i] *= between(table, R.inertia, u[2 + axis], 1.0)
    for axis in range(3):  # no body has one moment larger than the other two together
        others = vehicles[P.ixx + (axis + 1) % 3, i] + vehicles[P.ixx + (axis + 2) % 3, i]
        vehicles[P.ixx + axis, i] = min(vehicles[P.ixx + axis, i], others)
    motor_gain = between(table, R.motor_gain, u[5], 1.0)
    vehicles[P.motor_gain_up, i] *= motor_gain * between(table, R.motor_gain_up, u[11], 1.0)
    vehicles[P.motor_gain_down, i] *= motor_gain * between(table, R.motor_gain_down, u[12], 1.0)
    for axis in range(3):
        vehicles[P.drag_x + axis, i] += nominal_mass * between(table, R.drag, u[13], 0.0)
    thrust = between(table, R.thrust, u[6], 1.0)
    vehicles[P.thrust_middle, i] *= thrust
    vehicles[P.thrust_half_range, i] *= thrust
    arm = between(table, R.arm, u[7], 1.0)
    x, y = between(table, R.center_of_mass, u[8], 0.0), between(table, R.center_of_mass, u[9], 0.0)
    for rotor in range(4):  # roll arms are y of the rotors, pitch arms -x
        vehicles[P.roll_arm_0 + rotor, i] = arm * vehicles[P.roll_arm_0 + rotor, i] - y
        vehicles[P.pitch_arm_0 + rotor, i] = arm * vehicles[P.pitch_arm_0 + rotor, i] + x
    if table[R.delay + 2] != FIXED:
        vehicles[P.delay, i] = min(
            math.floor(between(table, R.delay, u[10], 0.0)), table[R.delay + 1] - 1.0
        )


@compiled
def _begin_wind(i, streams, table, is_disturbed, wind, wind_gust):
    """The constant wind of row i's episode, level unless its direction is given, and the first of
    its gusts, in place.
    """
    u = uniforms(streams, i, 5, WIND)
    if table[R.wind + 2] != FIXED:
        for axis in range(3):
            wind[axis, i] = 0.0
        if is_disturbed:
            _push(table, R.wind, u[8], 0.5, u[9], 1.0, wind, 0, 0, i)
    if wind_gust.shape[1] > 0:
        _begin_gusts(i, table, R.wind_std, 1.0 * is_disturbed, u, wind_gust)


@compiled
def _begin_gusts(i, table, k, unit, u, gust):
    """How row i's gusts are in its episode, and the first, in place; their numbers begin at ``k``,
    ``u`` is eight uniforms.
    """
    std, keeps = unit * between(table, k, u[0], 0.0), table[k + len(FIXED_NUMBERS)]
    gust[G.keeps, i], gust[G.adds, i] = keeps, std * math.sqrt(1.0 - keeps * keeps)
    for axis in range(3):  # stationary from the start; two normals from two uniforms (Box-Muller)
        radius = math.sqrt(-2.0 * math.log(u[2 + 2 * axis]))
        gust[G.value + axis, i] = std * radius * math.cos(2.0 * math.pi * u[3 + 2 * axis])


@compiled
def add_gusts(to, gust, first, count):
    """Add the present gusts of a block to its force or wind, (3, LANES)."""
    for axis in range(3):
        for lane in range(count):
            to[axis, lane] += gust[G.value + axis, first + lane]


@compiled
def advance_gusts(b, gust, first, count):
    """Advance the gusts of a block by a control step, in place, by two random words of each lane.

    What is added to a component is the sum of three numbers of seven bits each, scaled. A gust's
    time constant is many control steps, so the sum of what was added is normal.
    """
    word = b.word
    for lane in range(count):
        i = first + lane
        bits = np.uint64(word[GUST_WORDS, lane]) | np.uint64(
            word[GUST_WORDS + 1, lane]
        ) << np.uint64(32)
        for axis in range(3):
            part = bits >> np.uint64(21 * axis)
            added = np.float64(
                np.int64(
                    (part & _SEVEN)
                    + (part >> np.uint64(7) & _SEVEN)
                    + (part >> np.uint64(14) & _SEVEN)
                )
            )
            kept = gust[G.keeps, i] * gust[G.value + axis, i]
            gust[G.value + axis, i] = kept + gust[G.adds, i] * ((added - _SUM_MEAN) / _SUM_STD)
