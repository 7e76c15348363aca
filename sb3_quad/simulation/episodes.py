"""How episodes begin, what their control steps are worth and when they end: array functions for both environments.

A row of ``task_parameters`` is :meth:`sb3_quad.simulation.tasks.Task.parameters`, its columns are ``TASK_PARAMETERS`` there.
"""

from __future__ import annotations

import math

import numpy as np

from sb3_quad.simulation.engine.blocks import (
    DISTANCE,
    MAX_DISTANCE,
    P_HOVER,
    P_LIFT,
    P_RADIUS,
    PX,
    PY,
    PZ,
    QW,
    QX,
    QY,
    QZ,
    RADIUS,
    REWARD,
    S0,
    TX,
    TY,
    TZ,
    VX,
    WX,
    WY,
    WZ,
    load_state,
)
from sb3_quad.simulation.engine.lowlevel import LANES, SCRATCH_SIZE, compiled, float64_rows, scratch_pointer
from sb3_quad.simulation.engine.streams import EPISODE, EPISODE_START, STEP, uniforms

# Columns of the table; START has three.
START, NEAREST_TARGET, FARTHEST_TARGET, CLEARANCE, RANDOM_ATTITUDE, VELOCITY_STD, BODY_RATES_STD, LIMITS = 0, *range(3, 10)
TASK_COLUMNS = LIMITS + 6
POSITION_COST, TILT_COST, RATES_COST, COLLISION_COST, RANGE_COST = range(MAX_DISTANCE + 1, MAX_DISTANCE + 6)
TURN = 2.0 * math.pi


@compiled
def start_episode(i, state, queue, streams, task_index, vehicles, task_parameters, task_weights):
    """Begin the next episode of row i: its stream's next, with a task, state and target drawn from it."""
    streams[EPISODE, i] += np.uint32(1)
    streams[STEP, i] = np.uint32(0)
    u = uniforms(streams, i, 7, EPISODE_START)
    choice, height, azimuth = u[0], u[1], TURN * u[2]
    k = 0
    while k < task_weights.shape[0] - 1 and choice >= task_weights[k]:
        k += 1
    task_index[i] = k
    column = min(i, vehicles.shape[1] - 1)
    position = task_parameters[k, START], task_parameters[k, START + 1], task_parameters[k, START + 2]

    nearest = task_parameters[k, NEAREST_TARGET]
    distance = nearest + (task_parameters[k, FARTHEST_TARGET] - nearest) * u[12]
    # A uniform direction has a uniform height (Archimedes): cut it where the target would lie too close to the ground.
    ground = vehicles[P_RADIUS, column] + task_parameters[k, CLEARANCE]
    lowest = min(max(-1.0, (ground - position[2]) / distance), 1.0) if distance > 0.0 else -1.0
    up = lowest + (1.0 - lowest) * height
    across = math.sqrt(max(0.0, 1.0 - up * up))
    state[PX, i], state[PY, i], state[PZ, i] = position
    state[TX, i] = position[0] + distance * across * math.cos(azimuth)
    state[TY, i] = position[1] + distance * across * math.sin(azimuth)
    state[TZ, i] = position[2] + distance * up

    state[QW, i], state[QX, i], state[QY, i], state[QZ, i] = 1.0, 0.0, 0.0, 0.0
    if task_parameters[k, RANDOM_ATTITUDE] != 0.0:  # uniform on SO(3) (Shoemake)
        a, b, alpha, beta = math.sqrt(1.0 - u[3]), math.sqrt(u[3]), TURN * u[4], TURN * u[5]
        state[QW, i], state[QX, i] = b * math.cos(beta), a * math.sin(alpha)
        state[QY, i], state[QZ, i] = a * math.cos(alpha), b * math.sin(beta)
    for axis in range(3):  # two normals from two uniforms (Box-Muller)
        radius, angle = math.sqrt(-2.0 * math.log(u[6 + 2 * axis])), TURN * u[7 + 2 * axis]
        state[VX + axis, i] = task_parameters[k, VELOCITY_STD] * radius * math.cos(angle)
        state[WX + axis, i] = task_parameters[k, BODY_RATES_STD] * radius * math.sin(angle)
    hover = math.sqrt(vehicles[P_HOVER, column] / vehicles[P_LIFT, column])
    for rotor in range(4):
        state[S0 + rotor, i] = hover
        for late in range(queue.shape[0]):
            queue[late, rotor, i] = hover


@compiled
def reset_rows(rows, state, queue, streams, task_index, vehicles, task_parameters, task_weights):
    """Begin the next episode of the given rows, in place; targets are never below ground.

    :param rows: int64 (m,).
    :param state: float64 (STATE_SIZE, n), see dynamics/state.py.
    :param queue: float64 (delay, 4, n), commanded rotor speeds on their way: hover.
    :param streams: uint32 (4, n), see dynamics/streams.py.
    :param task_index: int64 (n,), the drawn row of the table.
    :param vehicles: float64 (len(PARAMETER_NAMES), n), or (len(PARAMETER_NAMES), 1) for all rows.
    :param task_parameters: float64 (K, len(TASK_PARAMETERS)).
    :param task_weights: float64 (K,), cumulative.
    """
    for i in rows:
        start_episode(i, state, queue, streams, task_index, vehicles, task_parameters, task_weights)


@compiled
def load_limits(scratch, task_index, task_parameters, first, count):
    """Limits and costs of the tasks that the rows of a block are flying."""
    b = float64_rows(scratch)
    if task_parameters.shape[0] == 1:
        for k in range(6):
            for lane in range(LANES):
                b[MAX_DISTANCE + k, lane] = task_parameters[0, LIMITS + k]
        return
    for lane in range(LANES):
        task = task_index[first + min(lane, count - 1)]
        for k in range(6):
            b[MAX_DISTANCE + k, lane] = task_parameters[task, LIMITS + k]


@compiled(fastmath=True, forceinline=True)
def _tilt(sine2, cosine2):
    """arccos(R33) from the squared sine and cosine of its half (their sum is 1), to 1e-15 and without a library call.

    With the smaller as the sine of an angle up to π/4, its halved tangent is at most 0.4142; the arctangent up to there is
    Cephes' rational approximation. The arccosine itself would lose half of its digits near level flight.
    """
    low, high = math.sqrt(min(sine2, cosine2)), math.sqrt(max(sine2, cosine2))
    t = low / (1.0 + high)
    z = t * t
    p = z * (-8.750608600031904122785e-1) - 1.615753718733365076637e1
    p = (p * z - 7.500855792314704667340e1) * z - 1.228866684490136173410e2
    p = p * z - 6.485021904942025371773e1
    q = (z + 2.485846490142306297962e1) * z + 1.650270098316988542046e2
    q = (q * z + 4.328810604912902668951e2) * z + 4.853903996359136964868e2
    q = q * z + 1.945506571482613964425e2
    angle = 4.0 * (t + t * z * (p / q))
    return angle if sine2 <= cosine2 else math.pi - angle


@compiled(fastmath=True)
def score_block(scratch):
    """Reward (Eqs. 4.5-4.9) and distance of a loaded block, in place."""
    b = float64_rows(scratch)
    for lane in range(LANES):
        ex, ey, ez = b[PX, lane] - b[TX, lane], b[PY, lane] - b[TY, lane], b[PZ, lane] - b[TZ, lane]
        wx, wy, wz = b[WX, lane], b[WY, lane], b[WZ, lane]
        distance = math.sqrt(ex * ex + ey * ey + ez * ez)
        rates = math.sqrt(wx * wx + wy * wy + wz * wz)
        qw, qx, qy, qz = b[QW, lane], b[QX, lane], b[QY, lane], b[QZ, lane]
        tilt = _tilt(qx * qx + qy * qy, qw * qw + qz * qz)
        reward = -b[POSITION_COST, lane] * distance - b[TILT_COST, lane] * tilt - b[RATES_COST, lane] * rates
        reward -= b[COLLISION_COST, lane] if b[PZ, lane] <= b[RADIUS, lane] else 0.0
        reward -= b[RANGE_COST, lane] if distance > b[MAX_DISTANCE, lane] else 0.0
        b[REWARD, lane], b[DISTANCE, lane] = reward, distance


@compiled
def score(state, vehicles, task_index, task_parameters, reward, collided, out_of_range, distance):
    """Reward and termination of all rows, on the true state at the end of a control step.

    :param state: float64 (STATE_SIZE, n); ``vehicles``, ``task_index``, ``task_parameters`` as of :func:`reset_rows`.
    :param reward: float (n,), written: -0.003 |r - r_T| - 0.002 arccos(R33) - 0.0005 |ω| (Eqs. 4.5-4.7), less 15 for a
        collision (Eq. 4.8) and 15 for leaving the range (Eq. 4.9); the coefficients are the task's.
    :param collided: bool (n,), written: the collision sphere touches the ground.
    :param out_of_range: bool (n,), written: |r - r_T| exceeds the task's max_distance.
    :param distance: float64 (n,), written: |r - r_T|, m.
    """
    memory = np.empty(SCRATCH_SIZE + 8)
    n = state.shape[1]
    for first in range(0, n, LANES):
        scratch = scratch_pointer(memory)  # in the loop: numba frees what is not used again
        b = float64_rows(scratch)
        count = min(LANES, n - first)
        load_state(scratch, state, first, count)
        load_limits(scratch, task_index, task_parameters, first, count)
        for lane in range(LANES):
            b[RADIUS, lane] = vehicles[P_RADIUS, min(first + min(lane, count - 1), vehicles.shape[1] - 1)]
        score_block(scratch)
        for lane in range(count):
            i = first + lane
            reward[i] = b[REWARD, lane]
            distance[i] = b[DISTANCE, lane]
            collided[i] = b[PZ, lane] <= b[RADIUS, lane]
            out_of_range[i] = b[DISTANCE, lane] > b[MAX_DISTANCE, lane]
