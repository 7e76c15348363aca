"""One control step of a whole batch, in one pass over its blocks, shared out between threads.

``work`` is all that the threads run. A job holds sizes and the addresses of arrays; the control array says which job is
under way and how many of its blocks are not taken yet. Whoever comes takes the next block: a thread that is late, or never
comes, costs time but changes nothing, since each row has a stream of its own and each block its own memory.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numba import carray, int64

from sb3_quad.base.arrays import Arrays, BoolArray, Float32Array, IntArray
from sb3_quad.base.errors import ConfigError
from sb3_quad.simulation.block import (
    MEMORY,
    block_in,
    load_commands,
    load_rows,
    load_scaling,
    load_scored,
    load_vehicles,
    store_observations,
    store_state,
)
from sb3_quad.simulation.compiled import LANES, atomic_add, atomic_get, atomic_set, compiled, give_way, pointer
from sb3_quad.simulation.episodes import count_episode, start_episode
from sb3_quad.simulation.frames import clear_frames, integrate_position, observe_frames, store_action
from sb3_quad.simulation.layout import first_rows
from sb3_quad.simulation.observation import OBSERVATION_SIZE, observe
from sb3_quad.simulation.physics import fly_block
from sb3_quad.simulation.random import STEP
from sb3_quad.simulation.randomization import RANDOMIZATION
from sb3_quad.simulation.reward import score, succeeds
from sb3_quad.simulation.sampling import GUST_SIZE, add_gusts, advance_gusts, sample_episode
from sb3_quad.simulation.state import STATE_SIZE, WRENCH_SIZE
from sb3_quad.simulation.tasks import TASK, S
from sb3_quad.simulation.vehicle_distribution import DISTRIBUTION_NUMBERS
from sb3_quad.vehicles.vehicle import PARAMETER_NAMES

LOOK, SCORE, FLY = range(3)
"""What a job does: it observes, after it has begun the next episodes of the rows whose ``dones`` are set; it scores a control
step that another simulator has flown; it flies and scores one."""

OUTCOME = np.dtype(
    [
        ("total", "f8"),  # sum of the rewards
        ("reward", "f8"),  # of the last control step
        ("length", "i8"),  # control steps
        ("distance", "f8"),  # |r - r_T|, m
        ("collision", "?"),
        ("out_of_range", "?"),
        ("truncated", "?"),  # neither of these: the flight survived
        ("success", "?"),  # survived, and ended at its target
    ],
    align=True,
)
"""How the last episode of a row ended."""

# Columns of vehicles and scaling: n, or 1 if all rows share the values; of gusts: n, or 0 without gusts. Control steps of an
# episode: limits of the present ones, max_steps of those that follow. Numbers in an observation: width.
SIZES = (
    *("n", "delay", "substeps", "tasks", "vehicle_columns", "base_columns", "gust_columns", "scaling_columns"),
    *("mixed_delays", "own_arms", "width", "depth", "frame", "ages", "integrals", "mode", "autoreset"),
)
_PARAMETERS, _COLUMNS = len(PARAMETER_NAMES), sum(TASK.values())
_DISTRIBUTION, _RANDOMIZATION = sum(DISTRIBUTION_NUMBERS.values()), sum(RANDOMIZATION.values())
ARRAYS: dict[str, tuple[Any, tuple[int | str, ...]]] = {  # kind of numbers, and shape, of which a name is one of the sizes
    "state": ("f8", (STATE_SIZE, "n")),
    "queue": ("f8", ("delay", 4, "n")),
    "wrench": ("f8", (WRENCH_SIZE, "n")),
    "vehicles": ("f8", (_PARAMETERS, "vehicle_columns")),  # that fly
    "base_vehicles": ("f8", (_PARAMETERS, "base_columns")),  # before anything is random
    "distribution_numbers": ("f8", (_DISTRIBUTION,)),
    "randomize_numbers": ("f8", (_RANDOMIZATION,)),
    "gust": ("f8", (GUST_SIZE, "gust_columns")),
    "frames": ("f4", ("n", "depth", "frame")),
    "ages": ("i8", ("ages",)),
    "integral": ("f8", ("integrals", "n")),
    "integral_numbers": ("f8", (4,)),
    "streams": ("u4", (4, "n")),
    "mean": ("f8", (OBSERVATION_SIZE, "scaling_columns")),
    "std": ("f8", (OBSERVATION_SIZE, "scaling_columns")),
    "noise_level": ("f8", ("scaling_columns",)),
    "additive_level": ("f8", ("scaling_columns",)),
    "task_index": ("i8", ("n",)),
    "task_parameters": ("f8", ("tasks", _COLUMNS)),
    "task_weights": ("f8", ("tasks",)),
    "returns": ("f8", ("n",)),
    "limits": ("i8", ("n",)),
    "max_steps": ("i8", ("n",)),
    "outcome": (OUTCOME, ("n",)),
    "last_observations": ("f4", ("n", "width")),  # of the episodes that outcome tells of
}
STEP_ARRAYS = ("actions", "observations", "rewards", "dones")  # of one step
_ADDRESSES = tuple(f"{name}_at" for name in (*ARRAYS, *STEP_ARRAYS))
JOB = np.dtype([("physics_step", "f8"), *((name, "i8") for name in SIZES + _ADDRESSES)])

# The control array, each number on a cache line of its own. Taken: whether a job is under way. From AWAKE on: whether worker k
# is looking for blocks.
LINE = 16
_CONTROL = first_rows(dict.fromkeys(("left", "done", "job", "serial", "taken", "awake"), 1))
LEFT, DONE, NOW, SERIAL, TAKEN, AWAKE = (LINE * k for k in _CONTROL)
NOT_FINITE, BUSY, LATE, IN_TIME = range(4)
"""What came of a job: nothing, since an action is not finite, or since another job is under way; or all is done, late if the
last block kept the thread that brought the job waiting."""


class StepArrays(NamedTuple):
    """What a step is given and gives: actions (n, 4), observations (n, width), rewards (n,), dones (n,)."""

    actions: Float32Array
    observations: Float32Array
    rewards: Float32Array
    dones: BoolArray


def step_arrays(n: int, width: int, actions: Float32Array | None = None) -> StepArrays:
    """Arrays for a step: dones are False, actions zero unless given; observations and rewards hold anything."""
    observations = np.empty((n, width), dtype=np.float32)
    given = np.zeros((n, 4), np.float32) if actions is None else actions
    return StepArrays(given, observations, np.empty(n, np.float32), np.zeros(n, np.bool_))


def check_arrays(arrays: Arrays, sizes: Mapping[str, float]) -> None:
    """Refuse what compiled code, which checks no index, would read or write outside of.

    :param arrays: each of ``ARRAYS``.
    :param sizes: each of ``SIZES`` but the mode, and the physics step.
    :raises ConfigError: an array of another type, shape or order in memory, or a row of a task that does not exist.
    """
    for name, (kind, shape) in ARRAYS.items():
        array, wanted = arrays[name], tuple(int(sizes[size]) if isinstance(size, str) else size for size in shape)
        if array.dtype != kind or array.shape != wanted or not array.flags.carray:
            raise ConfigError(f"{name}: {array.dtype} of shape {array.shape}; needed is {np.dtype(kind)} of shape {wanted}")
    for name in (size for size in SIZES if size.endswith("_columns")):
        if sizes[name] not in (1, sizes["n"]) and not (sizes[name] == 0 and name == "gust_columns"):
            raise ConfigError(f"{name} {sizes[name]}: must be 1, or one for each of {sizes['n']} rows")
    if not ((arrays["task_index"] >= 0) & (arrays["task_index"] < sizes["tasks"])).all():
        raise ConfigError(f"task_index: every number must be one of the {sizes['tasks']} tasks, counted from 0")


def new_jobs(arrays: Arrays, sizes: Mapping[str, float]) -> list[IntArray]:
    """A job for each mode, a ``JOB`` viewed as int64, of arrays that must live as long; see :func:`check_arrays`."""
    check_arrays(arrays, sizes)
    jobs = np.zeros(3, dtype=JOB)
    for name, value in {**sizes, **{f"{name}_at": arrays[name].ctypes.data for name in ARRAYS}}.items():
        jobs[name] = value
    jobs["mode"] = LOOK, SCORE, FLY
    return [*jobs.view(np.int64).reshape(3, -1)]


@compiled(inline="always")
def run_block(job, number, b, fresh):
    """One block of a job, see the modes; rows that end leave their outcome and, with ``autoreset``, begin their next episode.

    What is the same for all rows is in the block already unless it is ``fresh``.
    """
    n = job.n
    state = carray(pointer(job.state_at), (STATE_SIZE, n), np.float64)
    streams = carray(pointer(job.streams_at), (4, n), np.uint32)
    task_index = carray(pointer(job.task_index_at), (n,), np.int64)
    tasks = carray(pointer(job.task_parameters_at), (job.tasks, _COLUMNS), np.float64)
    vehicles = carray(pointer(job.vehicles_at), (_PARAMETERS, job.vehicle_columns), np.float64)
    queue = carray(pointer(job.queue_at), (job.delay, 4, n), np.float64)
    gust = carray(pointer(job.gust_at), (GUST_SIZE, job.gust_columns), np.float64)
    wrench = carray(pointer(job.wrench_at), (WRENCH_SIZE, n), np.float64)
    frames = carray(pointer(job.frames_at), (n, job.depth, job.frame), np.float32)
    integral = carray(pointer(job.integral_at), (job.integrals, n), np.float64)
    ages = carray(pointer(job.ages_at), (job.ages,), np.int64)
    returns = carray(pointer(job.returns_at), (n,), np.float64)
    limits = carray(pointer(job.limits_at), (n,), np.int64)
    observations = carray(pointer(job.observations_at), (n, job.width), np.float32)
    dones = carray(pointer(job.dones_at), (n,), np.bool_)
    first = number * LANES
    count = min(LANES, n - first)

    if fresh or job.scaling_columns > 1:
        scaling = job.scaling_columns
        mean = carray(pointer(job.mean_at), (OBSERVATION_SIZE, scaling), np.float64)
        std = carray(pointer(job.std_at), (OBSERVATION_SIZE, scaling), np.float64)
        relative = carray(pointer(job.noise_level_at), (scaling,), np.float64)
        additive = carray(pointer(job.additive_level_at), (scaling,), np.float64)
        load_scaling(b, mean, std, relative, additive, first, count)
    if job.mode > LOOK:
        load_rows(state, first, count, b.state)
        if fresh or job.vehicle_columns > 1:
            load_vehicles(b, vehicles, first, count, job.physics_step, fresh or job.own_arms)
        if fresh or job.tasks > 1:
            load_scored(b, task_index, tasks, first, count)
        actions = carray(pointer(job.actions_at), (n, 4), np.float32)
        if job.mode == FLY:
            load_rows(wrench, first, count, b.wrench)
            if job.gust_columns > 0:
                add_gusts(b, gust, first, count)
            load_commands(b, actions, queue, job.mixed_delays, first, count)
            fly_block(b, job.physics_step, job.substeps)
            store_state(b, state, first, count)
        score(b)
        for lane in range(count):
            streams[STEP, first + lane] += np.uint32(1)
        load_rows(streams, first, count, b.stream)
        observe(b)
        if job.gust_columns > 0:
            advance_gusts(b, gust, first, count)
        if job.depth > 0:
            numbers = carray(pointer(job.integral_numbers_at), (4,), np.float64)
            for lane in range(count):
                i = first + lane
                step = int64(streams[STEP, i])
                store_action(i, step, actions[i], frames)
                if job.integrals > 0:
                    integrate_position(i, b.feature, lane, b.mean, b.inverse_std, numbers, integral)
                observe_frames(i, step, b.feature, lane, b.inverse_std, integral, ages, frames, observations)
        else:
            store_observations(b, observations, first, count)

        rewards = carray(pointer(job.rewards_at), (n,), np.float32)
        height, radius, distance, scored = b.position[2], b.radius, b.distance, b.scored
        ended = 0
        for lane in range(count):
            i = first + lane
            returns[i] += b.reward[lane]
            rewards[i] = b.reward[lane]
            lost = (height[lane] <= radius[lane]) | (distance[lane] > scored[S.max_distance, lane])
            dones[i] = lost | (streams[STEP, i] >= limits[i])
            ended += dones[i]
        if ended == 0 and job.autoreset:
            return
        outcome = carray(pointer(job.outcome_at), (n,), OUTCOME)
        last = carray(pointer(job.last_observations_at), (n, job.width), np.float32)
        for lane in range(count):
            i = first + lane
            if dones[i] or not job.autoreset:
                outcome[i].collision = height[lane] <= radius[lane]
                outcome[i].out_of_range = distance[lane] > scored[S.max_distance, lane]
                outcome[i].truncated = not (outcome[i].collision or outcome[i].out_of_range)
                outcome[i].success = outcome[i].truncated and succeeds(b, lane)
                outcome[i].distance = distance[lane]
                outcome[i].total, outcome[i].reward = returns[i], b.reward[lane]
                outcome[i].length = streams[STEP, i]
                for k in range(job.width):
                    last[i, k] = observations[i, k]
        if not job.autoreset:
            return

    max_steps = carray(pointer(job.max_steps_at), (n,), np.int64)
    weights = carray(pointer(job.task_weights_at), (job.tasks,), np.float64)
    base = carray(pointer(job.base_vehicles_at), (_PARAMETERS, job.base_columns), np.float64)
    distribution = carray(pointer(job.distribution_numbers_at), (_DISTRIBUTION,), np.float64)
    randomization = carray(pointer(job.randomize_numbers_at), (_RANDOMIZATION,), np.float64)
    for i in range(first, first + count):
        if dones[i]:
            returns[i], limits[i] = 0.0, max_steps[i]
            count_episode(i, streams)
            sample_episode(i, streams, base, distribution, randomization, vehicles, wrench, gust)
            start_episode(i, state, queue, streams, task_index, vehicles, tasks, weights)
            if job.depth > 0:
                clear_frames(i, frames, integral)
    load_rows(state, first, count, b.state)
    load_rows(streams, first, count, b.stream)
    observe(b)
    if job.depth > 0:
        for lane in range(count):
            i = first + lane
            observe_frames(i, int64(streams[STEP, i]), b.feature, lane, b.inverse_std, integral, ages, frames, observations)
    else:
        store_observations(b, observations, first, count)


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
def work(control, worker, patience, job, actions, observations, rewards, dones):
    """The loop of every thread.

    :param control: int64, see this module's constants; shared by all threads.
    :param worker: number of a worker thread, which returns after ``patience`` looks without a block; -1 for the thread that
        brings the job, which returns when the job is done: no interrupt, which Python sees to between two calls, leaves a
        worker with a block. After ``patience`` looks at a block that a worker still has, it lets that have the core.
    :param job: of the dtype ``JOB``, (1,), viewed as int64, which numba tells apart sooner; unused by workers, as are the
        :class:`StepArrays`.
    :return: ``NOT_FINITE``, ``BUSY``, ``LATE`` or ``IN_TIME``.
    """
    memory = np.empty(MEMORY, np.uint8)
    blocks = int64(0)
    if worker >= 0:
        atomic_set(control, AWAKE + LINE * worker, 1)
    else:
        if not _finite(actions):
            return NOT_FINITE
        if atomic_set(control, TAKEN, 1) == 1:
            return BUSY
        own = carray(pointer(job.ctypes.data), 1, JOB)[0]
        own.actions_at, own.observations_at = actions.ctypes.data, observations.ctypes.data
        own.rewards_at, own.dones_at = rewards.ctypes.data, dones.ctypes.data
        blocks = (own.n + LANES - 1) // LANES
        atomic_set(control, DONE, 0)
        atomic_set(control, NOW, job.ctypes.data)
        atomic_add(control, SERIAL, 1)
        atomic_set(control, LEFT, blocks)
    idle = 0
    known = int64(-1)  # the job whose common numbers lie in this thread's block
    while True:
        b = block_in(memory)  # in the loop: numba frees what is not used again
        if atomic_get(control, LEFT) > 0:
            number = atomic_add(control, LEFT, -1) - 1
            if number >= 0:
                # Whoever holds a block keeps its job under way, so what is read from here on belongs together.
                address, serial = atomic_get(control, NOW), atomic_get(control, SERIAL)
                run_block(carray(pointer(address), 1, JOB)[0], number, b, serial != known)
                known = serial
                atomic_add(control, DONE, 1)
                idle = 0
        elif worker < 0 and atomic_get(control, DONE) == blocks:
            atomic_set(control, TAKEN, 0)
            return LATE if idle > patience else IN_TIME
        idle += 1
        if idle > patience:
            if worker < 0:
                give_way()
                continue
            atomic_set(control, AWAKE + LINE * worker, 0)
            if atomic_get(control, LEFT) <= 0:
                return IN_TIME
            atomic_set(control, AWAKE + LINE * worker, 1)
            idle = 0
