"""One control step of a whole batch, in one pass over its blocks, shared out between threads.

``work`` is all that the threads run. A job is an int64 array of addresses and sizes, the control array says which job is
under way and how many of its blocks are not taken yet. Whoever comes takes the next block: a thread that is late, or never
comes, costs time but changes nothing, since each row has a stream of its own and each block its own memory.
"""

from __future__ import annotations

import numpy as np
from numba import carray, int64

from sb3_quad.simulation.engine.blocks import (
    DISTANCE,
    MAX_DISTANCE,
    PZ,
    RADIUS,
    REWARD,
    WRENCH,
    load_columns,
    load_commands,
    load_scaling,
    load_state,
    load_streams,
    load_vehicles,
    store_state,
)
from sb3_quad.simulation.engine.kernel import fly_block
from sb3_quad.simulation.engine.lowlevel import (
    LANES,
    SCRATCH_SIZE,
    atomic_add,
    atomic_get,
    atomic_set,
    compiled,
    float64_rows,
    pointer,
    scratch_pointer,
)
from sb3_quad.simulation.engine.streams import STEP
from sb3_quad.simulation.episodes import TASK_COLUMNS, load_limits, score_block, start_episode
from sb3_quad.simulation.observation import OBSERVATION_SIZE, observe_block, store_observations
from sb3_quad.simulation.state import STATE_SIZE
from sb3_quad.vehicles.vehicle import PARAMETER_NAMES

# A job: sizes, then addresses of arrays in this order. Columns: 1 where one serves all rows.
(N, DELAY, SUBSTEPS, MAX_STEPS, TASKS, VEHICLE_COLUMNS, SCALING_COLUMNS) = range(7)
ADDRESSED = (
    *("physics_step", "state", "queue", "wrench", "vehicles", "streams", "mean", "std", "noise_level", "task_index"),
    *("task_parameters", "task_weights", "returns", "final_observation", "final_return", "final_length"),
    *("truncated", "collided", "out_of_range", "distance", "actions", "observations", "rewards", "dones"),
)
FIRST_ADDRESS = 7
JOB_SIZE = FIRST_ADDRESS + len(ADDRESSED)
# fmt: off
(
    A_STEP, A_STATE, A_QUEUE, A_WRENCH, A_VEHICLES, A_STREAMS, A_MEAN, A_STD, A_NOISE, A_TASK_INDEX,
    A_TASKS, A_WEIGHTS, A_RETURNS, A_FINAL_OBSERVATION, A_FINAL_RETURN, A_FINAL_LENGTH,
    A_TRUNCATED, A_COLLIDED, A_OUT_OF_RANGE, A_DISTANCE, A_ACTIONS, A_OBSERVATIONS, A_REWARDS, A_DONES,
) = range(FIRST_ADDRESS, JOB_SIZE)
# fmt: on

# The control array, each number on a cache line of its own.
LEFT, DONE, JOB, SERIAL, AWAKE = 0, 16, 32, 48, 64  # AWAKE + 16 k: helper k is looking for work
_PARAMETERS = len(PARAMETER_NAMES)


@compiled(inline="always")
def run_block(job, block, scratch, fresh):
    """One block of a job: fly, score, observe; rows that end leave how they ended and begin their next episode.

    What is the same for all rows is in scratch memory already unless it is ``fresh``. With ``MAX_STEPS`` 0 nothing flies:
    the rows whose ``dones`` are set begin their next episode, and all are observed.
    """
    n, columns, scaling, tasks, max_steps = job[N], job[VEHICLE_COLUMNS], job[SCALING_COLUMNS], job[TASKS], job[MAX_STEPS]
    physics_step = carray(pointer(job[A_STEP]), (1,), np.float64)[0]
    state = carray(pointer(job[A_STATE]), (STATE_SIZE, n), np.float64)
    queue = carray(pointer(job[A_QUEUE]), (job[DELAY], 4, n), np.float64)
    wrench = carray(pointer(job[A_WRENCH]), (12, n), np.float64)
    vehicles = carray(pointer(job[A_VEHICLES]), (_PARAMETERS, columns), np.float64)
    streams = carray(pointer(job[A_STREAMS]), (4, n), np.uint32)
    mean = carray(pointer(job[A_MEAN]), (OBSERVATION_SIZE, scaling), np.float64)
    std = carray(pointer(job[A_STD]), (OBSERVATION_SIZE, scaling), np.float64)
    noise_level = carray(pointer(job[A_NOISE]), (scaling,), np.float64)
    task_index = carray(pointer(job[A_TASK_INDEX]), (n,), np.int64)
    task_parameters = carray(pointer(job[A_TASKS]), (tasks, TASK_COLUMNS), np.float64)
    task_weights = carray(pointer(job[A_WEIGHTS]), (tasks,), np.float64)
    returns = carray(pointer(job[A_RETURNS]), (n,), np.float64)
    observations = carray(pointer(job[A_OBSERVATIONS]), (n, OBSERVATION_SIZE), np.float32)
    dones = carray(pointer(job[A_DONES]), (n,), np.bool_)
    first = block * LANES
    count = min(LANES, n - first)

    if fresh or scaling > 1:
        load_scaling(scratch, mean, std, noise_level, first, count)
    if max_steps > 0:
        b = float64_rows(scratch)
        load_state(scratch, state, first, count)
        load_columns(wrench, first, count, b, WRENCH)
        if fresh or columns > 1:
            load_vehicles(scratch, vehicles, first, count, physics_step)
        if fresh or tasks > 1:
            load_limits(scratch, task_index, task_parameters, first, count)
        load_commands(scratch, carray(pointer(job[A_ACTIONS]), (n, 4), np.float32), queue, first, count)
        fly_block(scratch, physics_step, job[SUBSTEPS])
        store_state(scratch, state, first, count)
        score_block(scratch)
        for lane in range(count):
            streams[STEP, first + lane] += np.uint32(1)
        load_streams(scratch, streams, first, count)
        observe_block(scratch)
        store_observations(scratch, observations, first, count)

        rewards = carray(pointer(job[A_REWARDS]), (n,), np.float32)
        ended = 0
        for lane in range(count):
            i = first + lane
            returns[i] += b[REWARD, lane]
            rewards[i] = b[REWARD, lane]
            lost = (b[PZ, lane] <= b[RADIUS, lane]) | (b[DISTANCE, lane] > b[MAX_DISTANCE, lane])
            dones[i] = lost | (streams[STEP, i] >= max_steps)
            ended += dones[i]
        if ended == 0:
            return
        final_observation = carray(pointer(job[A_FINAL_OBSERVATION]), (n, OBSERVATION_SIZE), np.float32)
        final_return = carray(pointer(job[A_FINAL_RETURN]), (n,), np.float64)
        final_length = carray(pointer(job[A_FINAL_LENGTH]), (n,), np.int64)
        truncated = carray(pointer(job[A_TRUNCATED]), (n,), np.bool_)
        collided = carray(pointer(job[A_COLLIDED]), (n,), np.bool_)
        out_of_range = carray(pointer(job[A_OUT_OF_RANGE]), (n,), np.bool_)
        distance = carray(pointer(job[A_DISTANCE]), (n,), np.float64)
        for lane in range(count):
            i = first + lane
            if dones[i]:
                collided[i] = b[PZ, lane] <= b[RADIUS, lane]
                out_of_range[i] = b[DISTANCE, lane] > b[MAX_DISTANCE, lane]
                truncated[i] = not (collided[i] or out_of_range[i])
                distance[i] = b[DISTANCE, lane]
                final_return[i] = returns[i]
                final_length[i] = streams[STEP, i]
                for k in range(OBSERVATION_SIZE):
                    final_observation[i, k] = observations[i, k]

    for i in range(first, first + count):
        if dones[i]:
            returns[i] = 0.0
            start_episode(i, state, queue, streams, task_index, vehicles, task_parameters, task_weights)
    load_state(scratch, state, first, count)
    load_streams(scratch, streams, first, count)
    observe_block(scratch)
    store_observations(scratch, observations, first, count)


@compiled
def _finite(actions):
    # By their bits: code compiled with fastmath may take it that no NaN exists.
    count = 4 * actions.shape[0]
    bits = carray(pointer(actions.ctypes.data), (count,), np.int32)
    wrong = 0
    for i in range(count):
        wrong += (bits[i] & 0x7F800000) == 0x7F800000
    return wrong == 0


@compiled
def work(control, helper, patience, job, actions, observations, rewards, dones):
    """The loop of every thread.

    :param control: int64, see this module's constants; shared by all threads.
    :param helper: number of a helping thread, which returns after ``patience`` looks without work; -1 for the thread that
        brings the job, which returns when the job is done or after ``patience`` looks at a block that a helper still has.
    :param job: int64 (JOB_SIZE,); unused by helpers, as are the arrays: actions float32 (n, 4), observations float32
        (n, 18), rewards float32 (n,), dones bool (n,).
    :return: whether all is done; -1 if an action is not finite, and then nothing has been done.
    """
    memory = np.empty(SCRATCH_SIZE + 8)
    blocks = int64(0)
    if helper < 0:
        if not _finite(actions):
            return -1
        job[A_ACTIONS], job[A_OBSERVATIONS] = actions.ctypes.data, observations.ctypes.data
        job[A_REWARDS], job[A_DONES] = rewards.ctypes.data, dones.ctypes.data
        blocks = (job[N] + LANES - 1) // LANES
        atomic_set(control, DONE, 0)
        atomic_set(control, JOB, job.ctypes.data)
        atomic_add(control, SERIAL, 1)
        atomic_set(control, LEFT, blocks)
    idle = 0
    known = int64(-1)  # the job whose common numbers lie in this thread's scratch memory
    while True:
        scratch = scratch_pointer(memory)  # in the loop: numba frees what is not used again
        if atomic_get(control, LEFT) > 0:
            block = atomic_add(control, LEFT, -1) - 1
            if block >= 0:
                # Whoever holds a block keeps its job under way, so what is read from here on belongs together.
                address, serial = atomic_get(control, JOB), atomic_get(control, SERIAL)
                run_block(carray(pointer(address), (JOB_SIZE,), np.int64), block, scratch, serial != known)
                known = serial
                atomic_add(control, DONE, 1)
                idle = 0
        elif helper < 0 and atomic_get(control, DONE) == blocks:
            return 1
        idle += 1
        if idle > patience:
            if helper >= 0:
                atomic_set(control, AWAKE + 16 * helper, 0)
                if atomic_get(control, LEFT) > 0 and atomic_set(control, AWAKE + 16 * helper, 1) == 0:
                    idle = 0
                    continue
            return 0
