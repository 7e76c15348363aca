"""One control step of a batch, block by block: a block goes through the whole step while it is in
the L1 cache.

A block holds ``LANES`` neighbouring rows, with everything a control step needs of them, in one
piece of memory. Its arrays have constant shapes and places: LLVM then knows the distance between
any two rows, needs no test for overlap, and vectorises the loops over lanes. Lanes past the last
row repeat it, so that every loop runs over all lanes: a row's numbers then depend neither on how
many others fly nor on its place in the batch.
"""

import inspect
import math
from typing import Any

import numpy as np
from numba import float32, int32

from sb3_quad.base.compiled import LANES, atomic_add, called, compiled, inlined, inner
from sb3_quad.envs.simulation.aerodynamics import scale_thrusts
from sb3_quad.envs.simulation.estimator import begin_estimate, perceive
from sb3_quad.envs.simulation.frames import (
    clear_frames,
    integrate_position,
    observe_frames,
    store_action,
)
from sb3_quad.envs.simulation.observation import (
    FEATURE_SIZES,
    GUST_WORDS,
    NORMALS,
    OBSERVATION_SIZE,
    WORDS,
    observe,
)
from sb3_quad.envs.simulation.physics import (
    command_by_rates,
    command_rotors,
    fly,
    moment,
    motor_factor,
    total_thrust,
    turn_rotors,
)
from sb3_quad.envs.simulation.random import RECORDING, STEP, gust_words, uniforms
from sb3_quad.envs.simulation.rate_loop import (
    RATE_LOOP,
    command_rates,
    load_rate_loop,
)
from sb3_quad.envs.simulation.recordings import add_recording
from sb3_quad.envs.simulation.reward import lands, score, score_calm, succeeds
from sb3_quad.envs.simulation.sampling import (
    add_gusts,
    advance_gusts,
    sample_episode,
    start_episode,
)
from sb3_quad.envs.simulation.state import (
    STATE,
    STATE_SIZE,
    WRENCH,
    WRENCH_SIZE,
    P,
    X,
)
from sb3_quad.envs.simulation.tasks import SCORED, T
from sb3_quad.envs.simulation.threads import DONE, LEFT, finish
from sb3_quad.envs.simulation.tracks import follow, observe_preview
from sb3_quad.envs.simulation.vectors import store, vector
from sb3_quad.envs.vehicles.rates import RATE_PARAMETERS
from sb3_quad.envs.vehicles.vehicle import PARAMETER_NAMES

CHUNK = 2 * LANES  # rows that a thread takes at once
LOOK, SCORE, FLY = range(3)
"""The modes of :func:`step`. LOOK begins the next episodes of the rows whose ``dones`` are set, and
observes all rows. SCORE scores a control step that another simulator has flown. FLY flies and
scores one.
"""

OUTCOME = np.dtype(
    [
        ("total", "f8"),  # sum of the rewards
        ("reward", "f8"),  # of the last control step
        ("length", "i8"),  # control steps
        ("distance", "f8"),  # |r - r_T|, m
        ("collision", "?"),
        ("out_of_range", "?"),
        ("truncated", "?"),  # neither of these: the flight survived
        ("success", "?"),  # survived, and ended at its target; or landed there
    ],
    align=True,
)
"""How the last episode of a row ended."""

# The shape of each quantity of a lane, by its dtype; an int is a number of rows.
_CONTENTS: dict[str, dict[str, Any]] = {
    "i8": {"row": ()},  # of the batch
    "f8": {
        **STATE,
        # action, then the rotor speed it commands
        "command": 4,
        # rotor speeds to be reached in this control step
        "wanted_speeds": 4,
        "thrust": 4,  # of each rotor, N
        # With action="rates": the thrust, N, and body rates, rad/s, to be reached; the body rates
        # behind the gyro's filter; and what load_rate_loop computes
        "rate_command": 4,
        "filtered_rates": 3,
        **RATE_LOOP,
        **WRENCH,
        "wind": 3,  # velocity of the air
        **dict.fromkeys(PARAMETER_NAMES[: P.rotor_drag_x], ()),
        # motor_factor of a rotor that speeds up, and of one that slows down
        "motor": 2,
        "velocity_gain": (),  # dt / m
        "rates_gain": 3,  # dt / I
        "fall": (),  # g dt
        "gyro": 3,  # Izz - Iyy, Ixx - Izz, Iyy - Ixx
        # the range of squared rotor speeds that can be commanded
        "square_middle": (),
        "square_half_range": (),
        "greatest_speed": (),  # of a rotor, with the present battery, rad/s
        "speed2": (),  # the larger of |v|² and |ω|²
        # limits and costs of the row's task
        **dict.fromkeys(SCORED, ()),
        "reward": (),
        "distance": (),
    },
    "f4": {
        "mean": OBSERVATION_SIZE,  # μ of Eq. 3.16
        "inverse_std": OBSERVATION_SIZE,  # 1 / σ
        "noise_level": (),  # relative
        "additive": (),  # level of the noise that is added, in σ
        "noise": NORMALS,
        **{f"observed_{name}": size for name, size in FEATURE_SIZES.items()},
    },
    "u4": {"word": WORDS, "stream": 4},
    # Last, so that the places of all others are what they are without air; float64 once more.
    "<f8": {
        **dict.fromkeys(PARAMETER_NAMES[P.rotor_drag_x :], ()),
        "spin": 4,  # moments of inertia of the rotors, with the sign of their direction about z
    },
}
# Several consecutive quantities under one name: the first of them, and the shape of all
_TOGETHER: dict[str, tuple[str, Any]] = {
    "state": ("position", STATE_SIZE),
    # the state with a target that rests
    "resting": ("position", X.target_velocity),
    "wrench": ("force_world", WRENCH_SIZE),
    # what is always loaded of a vehicle, and its terms of aerodynamics.py
    "vehicle": (PARAMETER_NAMES[0], P.rotor_drag_x),
    "air": ("rotor_drag_x", P.rate_limit_x - P.rotor_drag_x),
    "rotor_drag": ("rotor_drag_x", 3),
    "airspeed_moment": ("airspeed_moment_roll", 2),
    "rate_damping": ("rate_damping_x", 3),
    "thrust_factor": ("thrust_factor_0", 4),
    "rate_loop": (RATE_PARAMETERS[0], len(RATE_PARAMETERS)),
    "rate_limit": ("rate_limit_x", 3),
    "rate_gain": ("rate_gain_x", 3),
    "mix": ("roll_mix_0", (3, 4)),
    "hover_share": ("hover_share_0", 4),
    "inertia": ("ixx", 3),
    "drag": ("drag_x", 3),
    # the moment of each rotor per thrust, by axis
    "arm": ("roll_arm_0", (3, 4)),
    "scored": (SCORED[0], len(SCORED)),
    "scaling": ("mean", 2 * OBSERVATION_SIZE + 2),
    "feature": ("observed_position", OBSERVATION_SIZE),
}


def _block_type() -> Any:
    """Return the type of a block.

    Fields alias: block.velocity is a view of some rows of block.state, so that the state is loaded
    in one loop and each quantity still has its name.
    """
    columns = []
    for kind, shapes in _CONTENTS.items():
        for name, shape in shapes.items():
            columns.append((name, kind, (*np.empty(shape).shape, LANES)))
    fields: Any = dict(np.dtype(columns).fields or {})
    for name, (first, shape) in _TOGETHER.items():
        quantity, place = fields[first][:2]
        fields[name] = np.dtype((quantity.base, (*np.empty(shape).shape, LANES))), place
    return np.dtype(fields)


BLOCK = _block_type()
_SIZE = BLOCK.itemsize


@compiled
def step(
    control, leads, mode, actions, observations, rewards, dones,
    state, queue, filtered_rates, wrench, vehicles, base_vehicles, distribution_numbers,
    randomize_numbers, gust, wind, wind_gust, wrench_record, wrench_starts, wind_record,
    wind_starts, chances, estimator_numbers, estimate, frames, ages, integral, integral_numbers,
    streams, scaling, task_index, task_parameters, task_weights, returns, limits, max_steps,
    outcome, last_observations, last_actions,
    moves, course, tracks, track_numbers, previews,
    physics_step, substeps, in_air, autoreset,
):  # fmt: skip
    """Compute a control step of all rows. Each thread takes chunks of rows until none is left, see
    :func:`.threads.share_out`.

    The arrays are flat arguments: with them in a named tuple numba took twice as long to compile,
    and each block a tenth longer. The parts of a step are functions that numba inlines
    (``inline="always"``): where LLVM inlined them, a step took 5 to 8 % longer.

    Where a shape says 1 or n, one column may serve all rows.

    :param leads: whether this is the thread that returns to the batch.
    :param actions: float32 (n, 4); ``observations`` float32 (n, size), ``rewards`` float32 (n,) and
        ``dones`` bool (n,) are written.
    :param state: (STATE_SIZE, n), see :data:`.state.STATE`.
    :param queue: (delay, 4, n), rotor speeds that have been commanded and are not due yet, rad/s;
        or with ``action="rates"`` the thrusts, N, and body rates, rad/s.
    :param filtered_rates: (3, 0 or n), body rates behind the gyro's filter; without columns,
        actions are thrusts.
    :param wrench: (WRENCH_SIZE, n), see :data:`.state.WRENCH`.
    :param vehicles: (parameters, 1 or n), as they fly; ``base_vehicles``: before randomization.
    :param distribution_numbers: :meth:`.VehicleDistribution.numbers`.
    :param randomize_numbers: :meth:`.Randomization.numbers`.
    :param gust: (GUST_SIZE, 0 or n), gusts of force; ``wind_gust``, likewise, gusts of wind.
    :param wind: (3, n), velocity of the air without gusts, world frame, m/s.
    :param wrench_record: (0 or rows, WRENCH_SIZE), with ``wrench_starts``; ``wind_record`` (0 or
        rows, 3), with ``wind_starts``; ``chances`` (0 or n,); see :mod:`.recordings`.
    :param estimator_numbers: :meth:`.EstimatorError.numbers`; ``estimate`` (ESTIMATE_SIZE, 0 or n).
    :param frames: float32 (n, depth, frame size); depth 0 if an observation is the present features
        only.
    :param ages: int64 (ages,), of the frames in an observation, control steps.
    :param integral: (0 or 3, n), integral of the position error; ``integral_numbers`` (4,), see
        :class:`.PositionIntegral`.
    :param streams: uint32 (4, n), see :mod:`.random`.
    :param scaling: (2 OBSERVATION_SIZE + 2, 1 or n): μ and σ of Eq. 3.16, relative and additive
        noise level.
    :param task_index: int64 (n,), tasks of the current episodes.
    :param task_parameters: (tasks, columns), see :data:`.tasks.TASK`; ``task_weights`` (tasks,),
        cumulative.
    :param returns: (n,), of the episodes so far.
    :param limits: int64 (n,), control steps of the current episodes; ``max_steps`` (n,), of later
        ones.
    :param outcome: OUTCOME (n,); ``last_observations`` float32 (n, size), of the same episodes.
    :param last_actions: float32 (0 or n, 4), of the control step before, if change has a cost.
    :param moves: whether references move or have a heading; otherwise the rows of the state after
        the target's position are not read.
    :param course: (COURSE_SIZE, 0 or n), see :mod:`.tracks`, also for ``tracks`` and
        ``track_numbers``; ``previews`` int64, control steps ahead that are observed.
    :param physics_step: s; a control step has ``substeps`` of them.
    :param in_air: whether the terms of :mod:`.aerodynamics` act on some vehicle.
    :param autoreset: whether a row that ends begins its next episode within the same step.
    :return: False if an action is not finite; then nothing has changed.
    """
    n = state.shape[1]
    by_rates = filtered_rates.shape[1] > 0
    # Gusts and recordings add to what was set or sampled.
    adds = gust.shape[1] + wind_gust.shape[1] + chances.size > 0
    chunks = (n + CHUNK - 1) // CHUNK
    if leads:
        if mode != LOOK and not _is_finite(actions):
            return False
        control[LEFT] = chunks
    blocks = new_block()
    b = blocks[0]
    b.row[:] = 0
    load_constants(
        b, 0, True, scaling, vehicles, task_index, task_parameters, physics_step, in_air, by_rates
    )

    # The rows whose observations are due at the end: those that begin an episode, or all in LOOK.
    due = np.empty(n, np.int64)
    n_due = 0
    taken = 0
    while True:
        left = atomic_add(control, LEFT, -1)
        if left <= 0:
            break
        taken += 1
        chunk = (chunks - left) * CHUNK
        if mode == LOOK:
            for i in range(chunk, min(chunk + CHUNK, n)):
                due[n_due] = i
                n_due += 1
            continue
        for first in range(chunk, min(chunk + CHUNK, n), LANES):
            # Take the view again here: numba frees `blocks` after its last use, even while `b`
            # points into it.
            b = blocks[0]
            count = min(LANES, n - first)
            for lane in range(LANES):
                b.row[lane] = first + min(lane, count - 1)
            load_constants(
                b, first, False, scaling, vehicles, task_index, task_parameters,
                physics_step, in_air, by_rates,
            )  # fmt: skip
            if moves and tracks.shape[0] == 0:
                load_rows(state, first, b.state)
            else:
                load_rows(state, first, b.resting)
            if mode == FLY:
                is_pushed = adds or _acts(wrench, first, count) or _acts(wind, first, count)
                if is_pushed:
                    load_rows(wrench, first, b.wrench)
                    load_rows(wind, first, b.wind)
                if adds:
                    add_gusts(b.force_world, gust, first, count)
                    add_gusts(b.wind, wind_gust, first, count)
                    add_recording(
                        b.wrench, wrench_record, wrench_starts, chances, streams, first, count
                    )
                    add_recording(b.wind, wind_record, wind_starts, chances, streams, first, count)
                _load_commands(b, first, count, actions, queue, by_rates)
                if by_rates:
                    b.rate_command[:] = b.wanted_speeds
                    load_rows(filtered_rates, first, b.filtered_rates)
                fly(b, physics_step, substeps, in_air, by_rates, is_pushed)
                if by_rates:
                    save_rows(b.filtered_rates, first, count, filtered_rates)
                save_rows(b.state[: X.target], first, count, state)
            if tracks.shape[0] > 0:
                follow(b, np.int64(1), state, streams, course, tracks, track_numbers)
                save_rows(b.target, first, count, state[X.target :])
            score(b)
            # The noise of the observation is that of the next step.
            for lane in range(count):
                streams[STEP, first + lane] += 1
            load_rows(streams, first, b.stream)
            if last_actions.shape[0] > 0:
                score_calm(b, first, count, actions, last_actions, physics_step * substeps)
            if estimate.shape[1] > 0:
                perceive(b, count, True, estimator_numbers, estimate)
            observe(b, moves)
            if estimate.shape[1] > 0:
                # What follows reads the true state.
                load_rows(state, first, b.resting)
            if gust.shape[1] > 0:
                advance_gusts(b, gust, first, count)
            if wind_gust.shape[1] > 0:
                # Gusts of wind have their own random words.
                gust_words(b.word[GUST_WORDS:], b.stream)
                advance_gusts(b, wind_gust, first, count)
            if frames.shape[1] > 0:
                # A policy sees more than the present features.
                for lane in range(count):
                    i = first + lane
                    store_action(i, b.stream[STEP, lane], actions[i], frames)
                    if integral.shape[0] > 0:
                        integrate_position(b, i, lane, integral_numbers, integral)
            _write_observations(
                b, count, integral, ages, frames, previews, course, tracks, track_numbers,
                observations,
            )  # fmt: skip
            ended = _end_episodes(
                b, first, count, autoreset, observations, rewards, dones, returns, limits,
                outcome, last_observations,
            )  # fmt: skip
            if autoreset and ended > 0:
                for i in range(first, first + count):
                    if dones[i]:
                        due[n_due] = i
                        n_due += 1

    # Begin the episodes that are due, and observe these rows, which are not neighbours.
    for first in range(0, n_due, LANES):
        b = blocks[0]
        count = min(LANES, n_due - first)
        for lane in range(LANES):
            b.row[lane] = due[first + min(lane, count - 1)]
        for lane in range(count):
            i = b.row[lane]
            if dones[i]:
                returns[i] = 0.0
                limits[i] = max_steps[i]
                sample_episode(
                    i, streams, base_vehicles, distribution_numbers, randomize_numbers, vehicles,
                    wrench, gust, wind, wind_gust,
                )  # fmt: skip
                if chances.size > 0:
                    chances[i] = uniforms(streams, i, RECORDING)[0]
                begin_estimate(i, streams, estimator_numbers, estimate)
                start_episode(
                    i, state, queue, filtered_rates, streams, task_index, vehicles,
                    task_parameters, task_weights, course, tracks, track_numbers,
                )  # fmt: skip
                if frames.shape[1] > 0:
                    clear_frames(i, frames, integral)
        # Lanes past the last row keep a row of the previous block, which is never read.
        for lane in range(count):
            for k in range(STATE_SIZE):
                b.state[k, lane] = state[k, b.row[lane]]
            for k in range(4):
                b.stream[k, lane] = streams[k, b.row[lane]]
        if tracks.shape[0] > 0:
            follow(b, np.int64(0), state, streams, course, tracks, track_numbers)
        if scaling.shape[1] > 1:
            load_scaling(b, scaling)
        if estimate.shape[1] > 0:
            perceive(b, count, False, estimator_numbers, estimate)
        observe(b, moves)
        _write_observations(
            b, count, integral, ages, frames, previews, course, tracks, track_numbers,
            observations,
        )  # fmt: skip
    atomic_add(control, DONE, taken)
    if leads:
        finish(control, chunks)
    return True


# The arguments of a step that are attributes of a batch: all from the state on
_ARGUMENTS = list(inspect.signature(step.py_func).parameters)
BATCH_ARGUMENTS = _ARGUMENTS[_ARGUMENTS.index("state") :]


@compiled
def rotor_wrenches(
    begins, actions, due, out, speeds, state, queue, filtered_rates, vehicles, physics_step, in_air
):
    """Advance delay and rotors of row 0 by physics steps, for a simulator that moves the body
    itself.

    Motors do not feel the body, so all physics steps of a control step can be computed before it
    moves; with ``action="rates"``, one.

    :param begins: whether a control step begins.
    :param actions: float32 (n, 4), clipped to [-1, 1].
    :param due: (4,), the commands that are due in this control step, written when it begins.
    :param out: (steps, 2, 3): force (N) and torque (N m) of the rotors in each physics step, body
        frame, far from the ground.
    :param speeds: (steps + 1, 4): rotor speeds before them, and after each.
    """
    by_rates = filtered_rates.shape[1] > 0
    blocks = new_block()
    blocks[0].row[:] = 0
    load_rows(state, 0, blocks[0].state)
    load_vehicles(blocks[0], vehicles, 0, physics_step, in_air, by_rates)
    if begins:
        _load_commands(blocks[0], 0, 1, actions, queue, by_rates)
        due[:] = blocks[0].wanted_speeds[:, 0]
    if by_rates:
        load_rows(due.reshape(4, 1), 0, blocks[0].rate_command)
        load_rows(filtered_rates, 0, blocks[0].filtered_rates)
        command_by_rates(blocks[0])
        filtered_rates[:, 0] = blocks[0].filtered_rates[:, 0]
    b = blocks[0]
    speeds[0] = b.rotor_speeds[:, 0]
    b.ground_effect_radius[0] = 0.0
    for substep in range(len(out)):
        turn_rotors(b, 0)
        if in_air:
            scale_thrusts(b, 0.0, 0)
        speeds[substep + 1] = b.rotor_speeds[:, 0]
        out[substep, 0, 2] = total_thrust(b, 0)
        for axis in range(3):
            out[substep, 1, axis] = moment(b, axis, 0)
    state[X.rotor_speeds : X.target, 0] = blocks[0].rotor_speeds[:, 0]


@inner
def new_block():
    """Return memory for a block, (1,), that begins at a cache line: vectors that straddle two lines
    take a third longer.
    """
    room = np.empty(_SIZE + 64, np.uint8)
    start = -room.ctypes.data % 64
    return room[start : start + _SIZE].view(BLOCK)


@inner
def _is_finite(actions):
    # Look at the bits: code compiled with fastmath may assume that no NaN exists.
    bits = actions.view(np.int32).reshape(-1)
    largest = int32(0)
    for i in range(len(bits)):
        largest = max(largest, bits[i] & int32(0x7F800000))
    return largest < 0x7F800000


@inner
def _acts(source, first, count):
    """Return whether a number of a block is not zero in a (rows, n) array."""
    bits = source.view(np.int64)
    found = np.int64(0)
    for k in range(source.shape[0]):
        for i in range(first, first + count):
            found |= bits[k, i]
    return found != 0


@inner
def load_rows(source, first, target):
    """Copy the columns of a block from a (rows, n) array, or its only column to all lanes."""
    last = min(first + LANES, source.shape[1]) - 1
    for k in range(target.shape[0]):
        if last - first == LANES - 1:
            for lane in range(LANES):
                target[k, lane] = source[k, first + lane]
        else:
            for lane in range(LANES):
                target[k, lane] = source[k, min(first + lane, last)]


@inner
def save_rows(source, first, count, target):
    """Copy the first lanes of a block to columns of a (rows, n) array."""
    for k in range(source.shape[0]):
        for lane in range(count):
            target[k, first + lane] = source[k, lane]


@inlined
def load_constants(b, first, shared, scaling, vehicles, task_index, tasks, dt, in_air, by_rates):
    """Load what does not change during an episode: scaling, vehicles, limits and costs.

    :param shared: True: load what is the same for all rows, once for all blocks of a call. False:
        load what differs by row.
    """
    if (scaling.shape[1] == 1) == shared:
        load_scaling(b, scaling)
    if (vehicles.shape[1] == 1) == shared:
        load_vehicles(b, vehicles, first, dt, in_air, by_rates)
    if (tasks.shape[0] == 1) == shared:
        # Limits and costs are the last columns of a task.
        for lane in range(LANES):
            task = task_index[b.row[lane]]
            for k in range(b.scored.shape[0]):
                b.scored[k, lane] = tasks[task, T.max_distance + k]


@called
def load_vehicles(b, vehicles, first, dt, in_air, by_rates):
    """Load the vehicles of a block, with the divisions of a control step precomputed.

    :param by_rates: whether to load their rate loops, too.
    """
    load_rows(vehicles, first, b.vehicle)
    if in_air:
        load_rows(vehicles[P.rotor_drag_x :], first, b.air)
        # A rotor turns against the yaw moment of its drag.
        for lane in range(LANES):
            for k in range(4):
                b.spin[k, lane] = -math.copysign(b.rotor_inertia[lane], b.arm[2, k, lane])
    for lane in range(LANES):
        lift = b.thrust_coefficient[lane]
        exact = b.exact_motors[lane]
        b.motor[0, lane] = motor_factor(b.motor_gain_up[lane], exact, dt)
        b.motor[1, lane] = motor_factor(b.motor_gain_down[lane], exact, dt)
        b.square_middle[lane] = b.thrust_middle[lane] / lift
        b.square_half_range[lane] = b.thrust_half_range[lane] / lift
        most = b.square_middle[lane] + b.square_half_range[lane]
        b.greatest_speed[lane] = math.sqrt(most * b.battery[lane])
        b.velocity_gain[lane] = dt / b.mass[lane]
        b.fall[lane] = dt * b.gravity[lane]
        ixx, iyy, izz = vector(b.inertia, lane)
        store(b.gyro, lane, (izz - iyy, ixx - izz, iyy - ixx))
        store(b.rates_gain, lane, (dt / ixx, dt / iyy, dt / izz))
    if by_rates:
        load_rows(vehicles[P.rate_limit_x :], first, b.rate_loop)
        load_rate_loop(b, dt)


@called
def load_scaling(b, scaling):
    """Load μ, 1/σ and the noise levels of a block, in float32."""
    for lane in range(LANES):
        i = 0 if scaling.shape[1] == 1 else b.row[lane]
        for k in range(b.scaling.shape[0]):
            b.scaling[k, lane] = scaling[k, i]
        for k in range(OBSERVATION_SIZE):
            b.inverse_std[k, lane] = float32(1.0) / b.inverse_std[k, lane]


@inlined
def _load_commands(b, first, count, actions, queue, by_rates):
    """Put the commands of a block into the queue, and move those that are due to
    ``b.wanted_speeds``.

    A command enters at the row's own delay; the queue is as long as the longest delay.
    """
    command = b.command
    wanted = b.wanted_speeds
    own = b.delay
    delay = queue.shape[0]
    for lane in range(LANES):
        for k in range(4):
            command[k, lane] = actions[b.row[lane], k]
    if by_rates:
        command_rates(b)
    else:
        command_rotors(b)
    if delay == 0:
        for k in range(4):
            for lane in range(LANES):
                wanted[k, lane] = command[k, lane]
        return
    load_rows(queue[0], first, wanted)
    for k in range(4):
        for late in range(delay - 1):
            # Take views, and read both values whichever is used: otherwise the loop is not
            # vectorised.
            here = queue[late, k, first : first + count]
            after = queue[late + 1, k, first : first + count]
            for lane in range(count):
                new = command[k, lane]
                old = after[lane]
                here[lane] = new if own[lane] == late + 1.0 else old
        for lane in range(LANES):
            new = command[k, lane]
            old = wanted[k, lane]
            wanted[k, lane] = new if own[lane] == 0.0 else old
    save_rows(command, first, count, queue[delay - 1])


@called
def _write_observations(
    b, count, integral, ages, frames, previews, course, tracks, track_numbers, out
):
    """Write the observations of a block to its rows of ``out``, float32 (n, size)."""
    for lane in range(count):
        i = b.row[lane]
        if frames.shape[1] == 0:
            for k in range(OBSERVATION_SIZE):
                out[i, k] = b.feature[k, lane]
        else:
            observe_frames(b, i, b.stream[STEP, lane], lane, integral, ages, frames, out)
    if previews.size > 0:
        observe_preview(b, count, previews, course, tracks, track_numbers, out)


@inlined
def _end_episodes(
    b, first, count, autoreset, observations, rewards, dones, returns, limits,
    outcome, last_observations,
):  # fmt: skip
    """Write rewards and dones of a block, and how its episodes ended; return how many ended.

    Without autoreset the outcome is that of every row's last step.
    """
    height = b.position[2]
    distance = b.distance
    ended = 0
    for lane in range(count):
        i = first + lane
        returns[i] += b.reward[lane]
        rewards[i] = b.reward[lane]
        crashed = height[lane] <= b.collision_radius[lane]
        out_of_range = distance[lane] > b.max_distance[lane]
        dones[i] = crashed | out_of_range | (b.stream[STEP, lane] >= limits[i])
        ended += dones[i]
    # Few episodes end, and without this separate part the loop above would have branches.
    if ended == 0 and autoreset:
        return ended
    for lane in range(count):
        i = first + lane
        if autoreset and not dones[i]:
            continue
        end = outcome[i]
        touches = height[lane] <= b.collision_radius[lane]
        landed = touches and lands(b, lane)
        spared = landed * b.collision_cost[lane]
        rewards[i] = b.reward[lane] + spared
        end.collision = touches and not landed
        end.out_of_range = distance[lane] > b.max_distance[lane]
        end.truncated = not (touches or end.out_of_range)
        there = b.touchdown_speed[lane] == 0.0 and succeeds(b, lane, distance[lane])
        end.success = landed or (end.truncated and there)
        end.distance = distance[lane]
        end.total = returns[i] + spared
        end.reward = b.reward[lane] + spared
        end.length = b.stream[STEP, lane]
        if autoreset:
            for k in range(observations.shape[1]):
                last_observations[i, k] = observations[i, k]
    return ended
