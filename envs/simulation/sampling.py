"""How episodes begin: sampling from the task, the Randomization and the VehicleDistribution."""

import math

import numpy as np

from sb3_quad.base.compiled import called, inlined, inner
from sb3_quad.envs.simulation.observation import GUST_WORDS
from sb3_quad.envs.simulation.random import (
    AIR,
    DISTURBANCE,
    EPISODE,
    EPISODE_START,
    GUST,
    RATE_LOOP,
    STEP,
    VEHICLE,
    WIND,
    uniforms,
)
from sb3_quad.envs.simulation.randomization import FIXED, GUST_NUMBERS, R, V, between
from sb3_quad.envs.simulation.state import STATE_SIZE, P, W, X, first_rows, row_slices
from sb3_quad.envs.simulation.tasks import T
from sb3_quad.envs.simulation.tracks import deepest, start_course
from sb3_quad.envs.simulation.vehicle_distribution import arm_length, sample_from_distribution

GUSTS = {"value": 3, "keeps": 1, "adds": 1}
"""Rows of an array of gusts: the present gust, world frame, N or m/s; the share of it that is left
after a control step; the standard deviation of the increment.
"""
GUST_SIZE = sum(GUSTS.values())
GUST_VALUE = row_slices(GUSTS)["value"]
GUST_ROWS = first_rows(GUSTS)
TURN = 2.0 * math.pi
# Parameters of a vehicle, the range of each one's factor, and the index of its uniform number
_FACTORS = (
    (P.mass, R.mass, 1),
    (P.hover_thrust, R.mass, 1),
    (P.ixx, R.inertia, 2),
    (P.iyy, R.inertia, 3),
    (P.izz, R.inertia, 4),
    (P.thrust_middle, R.thrust, 6),
    (P.thrust_half_range, R.thrust, 6),
    (P.battery, R.battery, 14),
    # The firmware's moments, too, are as far off as its thrusts.
    (P.rate_gain_x, R.thrust, 6),
    (P.rate_gain_y, R.thrust, 6),
    (P.rate_gain_z, R.thrust, 6),
)
_SEVEN_BITS = np.uint64(127)
# Mean and deviation of the sum of three whole numbers, uniform from 0 to 127
_SUM_MEAN = 3 * 127 / 2
_SUM_STD = math.sqrt(3 * (128**2 - 1) / 12)


@called
def start_episode(
    i, state, queue, filtered_rates, streams, task_index, vehicles, tasks, weights, course, tracks,
    track_numbers,
):  # fmt: skip
    """Begin the next episode of row i's stream, in place: sample task, state and target.

    Targets are never below ground.

    :param state: float64 (STATE_SIZE, n), see :mod:`.state`.
    :param queue: float64 (delay, 4, n), commands on their way; set to hover.
    :param filtered_rates: float64 (3, 0 or n), see :func:`.kernel.step`.
    :param streams: uint32 (4, n), see :mod:`.random`.
    :param task_index: int64 (n,), the sampled row of the table of tasks.
    :param vehicles: float64 (len(PARAMETER_NAMES), n), or (len(PARAMETER_NAMES), 1) for all rows.
    :param tasks: float64 (K, columns), :meth:`sb3_quad.envs.simulation.tasks.Task.parameters` of
        each task.
    :param weights: float64 (K,), cumulative.
    :param course: see :mod:`.tracks`, as for ``tracks`` and ``track_numbers``.
    """
    u = uniforms(streams, i, EPISODE_START)
    task_index[i] = 0
    for weight in weights[:-1]:
        task_index[i] += weight <= u[0]
    task = tasks[task_index[i]]
    s = state[:, i]
    vehicle = _column(vehicles, i)

    # A uniform direction has a uniform height (Archimedes), which is limited so that the target is
    # not too close to the ground.
    nearest = task[T.nearest_target]
    distance = nearest + (task[T.target_distance] - nearest) * u[12]
    ground = vehicle[P.collision_radius] + task[T.target_clearance]
    if tracks.shape[0] > 0:
        ground += deepest(i, streams, tracks, track_numbers)
    lowest = -1.0
    if distance > 0.0:
        lowest = min(max(-1.0, (ground - task[T.start_position + 2]) / distance), 1.0)
    offset = _spherical(distance, lowest + (1.0 - lowest) * u[1], TURN * u[2])
    for axis in range(3):
        s[X.position + axis] = task[T.start_position + axis]
        s[X.target + axis] = s[X.position + axis] + offset[axis]
    for k in range(X.target_velocity, STATE_SIZE):
        s[k] = 0.0
    if course.shape[1] > 0:
        start_course(i, state, streams, course, track_numbers)

    s[X.quaternion] = 1.0
    for axis in range(3):
        s[X.quaternion + 1 + axis] = 0.0
    if task[T.random_attitude] != 0.0:
        # Uniform on SO(3) (Shoemake)
        a = math.sqrt(1.0 - u[3])
        b = math.sqrt(u[3])
        s[X.quaternion] = b * math.cos(TURN * u[5])
        s[X.quaternion + 1] = a * math.sin(TURN * u[4])
        s[X.quaternion + 2] = a * math.cos(TURN * u[4])
        s[X.quaternion + 3] = b * math.sin(TURN * u[5])

    spin = math.hypot(task[T.body_rates_std], task[T.hit_rates_std])
    for axis in range(3):
        velocity, rate = _normals(task[T.velocity_std], spin, u, 6 + 2 * axis)
        s[X.velocity + axis] = velocity
        s[X.body_rates + axis] = rate
    for rotor in range(4):
        hover = vehicle[P.hover_share_0 + rotor] * vehicle[P.hover_thrust]
        speed = math.sqrt(hover / vehicle[P.thrust_coefficient])
        s[X.rotor_speeds + rotor] = speed
        for late in range(queue.shape[0]):
            queue[late, rotor, i] = speed
    if filtered_rates.shape[1] > 0:
        filtered_rates[:, i] = s[X.body_rates : X.rotor_speeds]
        # Hover is a thrust without body rates.
        queue[:, 0, i] = 4.0 * vehicle[P.hover_thrust]
        queue[:, 1:, i] = 0.0


@inlined
def _column(array, i):
    """Return column i, or the only one."""
    return array[:, min(i, array.shape[1] - 1)]


@inlined
def _spherical(length, up, azimuth):
    """Return the vector of that length and azimuth whose z is ``up`` times the length."""
    across = length * math.sqrt(max(0.0, 1.0 - up * up))
    return across * math.cos(azimuth), across * math.sin(azimuth), length * up


@inlined
def _normals(first_std, second_std, u, k):
    """Return two normals from the uniforms u[k] and u[k + 1] (Box-Muller)."""
    radius = math.sqrt(-2.0 * math.log(u[k]))
    angle = TURN * u[k + 1]
    return first_std * radius * math.cos(angle), second_std * radius * math.sin(angle)


@called
def sample_episode(i, streams, base, distribution, table, vehicles, wrench, gust, wind, wind_gust):
    """Advance row i's stream to its next episode, and sample its vehicle, constant wrench and wind,
    and first gusts, in place. Whatever is not random stays as it is.

    :param base: float64 (len(PARAMETER_NAMES), n or 1), the vehicles before they are randomized.
    :param distribution: :meth:`.VehicleDistribution.numbers`.
    :param table: :meth:`.Randomization.numbers`.
    :param vehicles: float64 (len(PARAMETER_NAMES), n), or (len(PARAMETER_NAMES), 1) if one serves
        all rows.
    :param wrench: float64 (WRENCH_SIZE, n).
    :param gust: float64 (GUST_SIZE, n), or (GUST_SIZE, 0) without gusts; ``wind_gust`` likewise.
    :param wind: float64 (3, n).
    """
    streams[EPISODE, i] += 1
    streams[STEP, i] = 0
    has_own_vehicle = vehicles.shape[1] == wrench.shape[1]
    if has_own_vehicle:
        for k in range(vehicles.shape[0]):
            vehicles[k, i] = _column(base, i)[k]
        sample_from_distribution(i, streams, distribution, vehicles)

    # Forces in multiples of a weight refer to the vehicle before randomization.
    vehicle = _column(vehicles, i)
    weight = vehicle[P.mass] * vehicle[P.gravity]
    u = uniforms(streams, i, DISTURBANCE)
    is_disturbed = np.float64(u[0] < table[R.wrench_share])
    if table[R.force + 2] != FIXED or table[R.torque + 2] != FIXED:
        for k in range(wrench.shape[0]):
            wrench[k, i] = 0.0
        leverage = weight * arm_length(vehicle)
        force, torque = wrench[W.force_world :, i], wrench[W.torque_world :, i]
        _sample_vector(table, R.force, is_disturbed, weight, u[1], u[2], u[3], force)
        _sample_vector(table, R.torque, is_disturbed, leverage, u[4], u[5], u[6], torque)
    if gust.shape[1] > 0:
        u = uniforms(streams, i, GUST)
        _begin_gusts(table, R.gusts, is_disturbed, weight, u, gust[:, i])
    if wind_gust.shape[1] > 0:
        u = uniforms(streams, i, WIND)
        _begin_gusts(table, R.wind_gusts, is_disturbed, 1.0, u, wind_gust[:, i])
    if table[R.wind + 2] != FIXED:
        u = uniforms(streams, i, WIND)
        # The wind is horizontal unless its direction is given.
        _sample_vector(table, R.wind, is_disturbed, 1.0, u[8], 0.5, u[9], wind[:, i])
    if has_own_vehicle:
        _randomize_vehicle(i, streams, table, vehicles)


@called
def _sample_vector(table, k, share, unit, u, height, azimuth, out):
    """Write the vector whose numbers begin at ``k``, (3,) in the world or the next 3 in the body
    frame.

    :param share: 1, or 0 for none in this episode.
    :param unit: unit of a magnitude that is given by weight, in SI units.
    :param u: a number on (0, 1) for the magnitude; ``height`` and ``azimuth``, for a random
        direction.
    """
    size = share * between(table, k, u, 0.0)
    if table[k + V.by_weight] != 0.0:
        size *= unit
    # A direction of zeros means a random one.
    at = k + V.direction
    x, y, z = table[at], table[at + 1], table[at + 2]
    if x == y == z == 0.0:
        x, y, z = _spherical(1.0, 2.0 * height - 1.0, TURN * azimuth)
    first = 3 * int(table[k + V.in_body])
    out[first] = size * x * table[k + V.axes]
    out[first + 1] = size * y * table[k + V.axes + 1]
    out[first + 2] = size * z * table[k + V.axes + 2]


@called
def _randomize_vehicle(i, streams, table, vehicles):
    """Multiply the parameters of vehicle i by the factors of the row's episode, in place."""
    u = uniforms(streams, i, VEHICLE)
    if u[0] >= table[R.share]:
        return
    v = vehicles[:, i]
    _randomize_air(uniforms(streams, i, AIR), table, v)
    drag = v[P.mass] * between(table, R.drag, u[13], 0.0)
    for axis in range(3):
        v[P.drag_x + axis] += drag
    for parameter, factor, number in _FACTORS:
        v[parameter] *= between(table, factor, u[number], 1.0)
    # No body has a moment of inertia larger than the sum of the other two.
    inertia = v[P.ixx : P.izz + 1]
    for axis in range(3):
        inertia[axis] = min(inertia[axis], inertia[axis - 1] + inertia[axis - 2])

    motor_gain = between(table, R.motor_gain, u[5], 1.0)
    v[P.motor_gain_up] *= motor_gain * between(table, R.motor_gain_up, u[11], 1.0)
    v[P.motor_gain_down] *= motor_gain * between(table, R.motor_gain_down, u[12], 1.0)

    # The arms are measured from the centre of mass: roll arms are y of the rotors, pitch arms -x.
    arm = between(table, R.arm, u[7], 1.0)
    x = between(table, R.center_of_mass, u[8], 0.0)
    y = between(table, R.center_of_mass, u[9], 0.0)
    for rotor in range(4):
        v[P.roll_arm_0 + rotor] = arm * v[P.roll_arm_0 + rotor] - y
        v[P.pitch_arm_0 + rotor] = arm * v[P.pitch_arm_0 + rotor] + x
    if table[R.delay + 2] != FIXED:
        delay = math.floor(between(table, R.delay, u[10], 0.0))
        v[P.delay] = min(delay, table[R.delay + 1] - 1.0)
    u = uniforms(streams, i, RATE_LOOP)
    tilting = between(table, R.rate_gains, u[0], 1.0)
    v[P.rate_gain_x] *= tilting
    v[P.rate_gain_y] *= tilting
    v[P.rate_gain_z] *= between(table, R.rate_gains, u[1], 1.0)
    v[P.rate_lag] += between(table, R.rate_lag, u[2], 0.0)


@called
def _randomize_air(u, table, v):
    """Replace the terms of :mod:`.aerodynamics` of a vehicle that is not yet randomized, in place.

    :param u: 13 uniforms.
    """
    mass = v[P.mass]
    speeds = 4.0 * math.sqrt(v[P.hover_thrust] / v[P.thrust_coefficient])
    _replace(v, P.translational_lift, mass, table, R.translational_lift, u[5])
    _replace(v, P.rotor_inertia, v[P.izz], table, R.rotor_inertia, u[11])
    _replace(v, P.ground_effect_radius, arm_length(v), table, R.ground_effect_radius, u[12])
    for axis in range(3):
        inertia = v[P.ixx + axis]
        _replace(v, P.rotor_drag_x + axis, mass / speeds, table, R.rotor_drag, u[4])
        _replace(v, P.rate_damping_x + axis, inertia, table, R.rate_damping, u[8 + axis])
        if axis < 2:
            k = P.airspeed_moment_roll + axis
            _replace(v, k, inertia / speeds, table, R.airspeed_moment, u[6 + axis])
    for rotor in range(4):
        factor = between(table, R.rotors, u[rotor], 1.0)
        v[P.thrust_factor_0 + rotor] *= factor
        v[P.hover_share_0 + rotor] /= factor


@inner
def _replace(v, parameter, unit, table, k, u):
    """Replace a parameter by the number for u from the range at ``table[k]``, times its unit."""
    if table[k + 2] != FIXED:
        v[parameter] = unit * between(table, k, u, 0.0)


@called
def _begin_gusts(table, k, share, unit, u, gust):
    """Set the parameters of an episode's gusts, (GUST_SIZE,), and sample the first one, in place.

    :param k: where their numbers begin; ``share`` and ``unit`` as in :func:`_sample_vector`.
    :param u: eight uniforms.
    """
    std = share * between(table, k + GUST_NUMBERS.std, u[0], 0.0)
    if table[k + GUST_NUMBERS.by_weight] != 0.0:
        std *= unit
    keeps = table[k + GUST_NUMBERS.keeps]
    gust[GUST_ROWS.keeps] = keeps
    gust[GUST_ROWS.adds] = std * math.sqrt(1.0 - keeps * keeps)
    # The first gust has the deviation of all later ones.
    for axis in range(3):
        gust[GUST_ROWS.value + axis] = _normals(std, std, u, 2 + 2 * axis)[0]


@inner
def add_gusts(to, gust, first, count):
    """Add the present gusts of a block, if it has any, to its force or wind, (3, LANES)."""
    if gust.shape[1] == 0:
        return
    for axis in range(3):
        for lane in range(count):
            to[axis, lane] += gust[GUST_ROWS.value + axis, first + lane]


@inner
def advance_gusts(b, gust, first, count):
    """Advance the gusts of a block by a control step, in place, with two random words of each lane.

    The increment of a component is the sum of three numbers of seven bits each, scaled. A gust's
    time constant is many control steps, so the sum of many increments is normal.
    """
    word = b.word
    for lane in range(count):
        i = first + lane
        low = np.uint64(word[GUST_WORDS, lane])
        bits = low | np.uint64(word[GUST_WORDS + 1, lane]) << np.uint64(32)
        for axis in range(3):
            part = bits >> np.uint64(21 * axis)
            total = np.uint64(0)
            for shift in (0, 7, 14):
                total += part >> np.uint64(shift) & _SEVEN_BITS
            normal = (np.float64(np.int64(total)) - _SUM_MEAN) / _SUM_STD
            kept = gust[GUST_ROWS.keeps, i] * gust[GUST_ROWS.value + axis, i]
            gust[GUST_ROWS.value + axis, i] = kept + gust[GUST_ROWS.adds, i] * normal
