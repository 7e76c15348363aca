"""How episodes begin."""

import math

import numpy as np

from sb3_quad.simulation.compiled import compiled
from sb3_quad.simulation.random import EPISODE, EPISODE_START, STEP, uniforms
from sb3_quad.simulation.state import P, X
from sb3_quad.simulation.tasks import T

TURN = 2.0 * math.pi


@compiled
def count_episode(i, streams):
    """Row i's stream goes on to its next episode, in place."""
    streams[EPISODE, i] += np.uint32(1)
    streams[STEP, i] = np.uint32(0)


@compiled
def start_episode(i, state, queue, streams, task_index, vehicles, tasks, weights):
    """Begin the episode that row i's stream has come to, in place: a task, state and target sampled from it.

    Targets are never below ground.

    :param state: float64 (STATE_SIZE, n), see :mod:`.state`.
    :param queue: float64 (delay, 4, n), commanded rotor speeds on their way: hover.
    :param streams: uint32 (4, n), see :mod:`.random`.
    :param task_index: int64 (n,), the sampled row of the table of tasks.
    :param vehicles: float64 (len(PARAMETER_NAMES), n), or (len(PARAMETER_NAMES), 1) for all rows.
    :param tasks: float64 (K, columns), :meth:`sb3_quad.simulation.tasks.Task.parameters` of each task.
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
    # A uniform direction has a uniform height (Archimedes): cut it where the target would lie too close to the ground.
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
        qw, qx, qy, qz = b * math.cos(beta), a * math.sin(alpha), a * math.cos(alpha), b * math.sin(beta)
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
