"""One control step of a batch, block by block: a block goes through all of it while it is in the
first cache.

A block is ``LANES`` neighbouring rows with all that a control step needs of them in one piece of
memory. Its arrays have constant shapes and places: LLVM then knows each distance between two rows,
needs no test for overlap, and vectorises the loops over lanes. Lanes behind the last row repeat it,
so that every loop runs over all lanes: a row's numbers then never depend on how many others fly, or
on where in the batch it stands.
"""

from typing import Any, NamedTuple

import numpy as np

from sb3_quad.base.arrays import Float32Array, FloatArray, IntArray
from sb3_quad.simulation.compiled import LANES, atomic_add, compiled
from sb3_quad.simulation.frames import (
    clear_frames,
    integrate_position,
    observe_frames,
    store_action,
)
from sb3_quad.simulation.observation import GUST_WORDS, NORMALS, OBSERVATION_SIZE, WORDS, observe
from sb3_quad.simulation.physics import (
    command_rotors,
    fly,
    moment,
    motor_factor,
    rotation_rows,
    total_thrust,
    turn_rotors,
)
from sb3_quad.simulation.random import STEP, gust_words
from sb3_quad.simulation.reward import score, succeeds
from sb3_quad.simulation.sampling import (
    add_gusts,
    advance_gusts,
    count_episode,
    sample_episode,
    start_episode,
)
from sb3_quad.simulation.state import STATE, STATE_SIZE, WRENCH, WRENCH_SIZE, P, W, X
from sb3_quad.simulation.tasks import SCORED, S, T
from sb3_quad.simulation.threads import DONE, LEFT, finish

CHUNK = 2 * LANES  # rows that a thread takes at once
LOOK, SCORE, FLY = range(3)
"""What :func:`step` does: it observes, after it has begun the next episodes of the rows whose
``dones`` are set; it scores a control step that another simulator has flown; it flies and scores
one.
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
        ("success", "?"),  # survived, and ended at its target
    ],
    align=True,
)
"""How the last episode of a row ended."""

_SCORED = tuple(getattr(T, name) for name in SCORED)
# Of every lane: the kind of numbers, and how many or of what shape.
_CONTENTS: dict[str, tuple[str, Any]] = {
    "row": ("i8", ()),  # of the batch
    "state": ("f8", STATE_SIZE),  # all its rows
    "command": ("f8", 4),  # action, then the rotor speed it commands
    "wanted_speeds": ("f8", 4),  # rotor speeds to be reached in this control step
    "wrench": ("f8", WRENCH_SIZE),
    "wind": ("f8", 3),  # velocity of the air
    "drag": ("f8", 3),
    "motor": ("f8", 2),  # motor_factor of a rotor that speeds up, and of one that slows down
    "exact": ("f8", ()),  # 1 where motors are integrated exactly, else 0
    "lift": ("f8", ()),  # kF
    "fall": ("f8", ()),  # g dt
    "push": ("f8", ()),  # dt / m
    "twist": ("f8", 3),  # dt / I
    "gyro": ("f8", 3),  # Izz - Iyy, Ixx - Izz, Iyy - Ixx
    "thrust_middle": ("f8", ()),  # divided by kF, as is the next
    "thrust_half_range": ("f8", ()),
    "radius": ("f8", ()),  # of the collision sphere
    "arm": ("f8", (3, 4)),  # moment per thrust, by axis and rotor
    "delay": ("f8", ()),  # control steps
    "vehicle": ("f8", P.roll_arm_0),  # its parameters but for the arms, the last of them
    "scored": ("f8", len(SCORED)),  # max_distance and the costs of the row's task
    "reward": ("f8", ()),
    "distance": ("f8", ()),
    "thrust": ("f8", 4),  # of each rotor, N
    "speed2": ("f8", ()),  # the larger of |v|² and |ω|²
    "mean": ("f4", OBSERVATION_SIZE),  # μ of Eq. 3.16
    "inverse_std": ("f4", OBSERVATION_SIZE),  # 1 / σ
    "noise_level": ("f4", ()),  # relative
    "additive": ("f4", ()),  # level of the noise that is added, in σ
    "noise": ("f4", NORMALS),
    "feature": ("f4", OBSERVATION_SIZE),
    "word": ("u4", WORDS),  # random
    "stream": ("u4", 4),
}
_WHOLE = np.dtype(
    [(name, kind, (*np.empty(shape).shape, LANES)) for name, (kind, shape) in _CONTENTS.items()]
)
_FIELDS: Any = dict(_WHOLE.fields or {})
for _whole, _parts, _first in (
    ("state", STATE, X),
    ("wrench", WRENCH, W),
):  # each part under its name, too
    for _name, _size in _parts.items():
        _place = _FIELDS[_whole][1] + 8 * LANES * getattr(_first, _name)
        _FIELDS[_name] = np.dtype(("f8", (_size, LANES))), _place
BLOCK = np.dtype(_FIELDS)
_SIZE = BLOCK.itemsize


class BatchArrays(NamedTuple):
    """What control steps of n rows read and write. Where a shape says 1 or n, one column may serve
    all rows.
    """

    state: FloatArray  # (STATE_SIZE, n), see STATE
    # (delay, 4, n), rotor speeds that have been commanded and are not due yet, rad/s
    queue: FloatArray
    wrench: FloatArray  # (WRENCH_SIZE, n), see WRENCH
    vehicles: FloatArray  # (parameters, 1 or n), that fly
    base_vehicles: FloatArray  # (parameters, 1 or n), before anything is random
    distribution_numbers: FloatArray  # VehicleDistribution.numbers()
    randomize_numbers: FloatArray  # Randomization.numbers()
    gust: FloatArray  # (GUST_SIZE, 0 or n), of force
    wind: FloatArray  # (3, n), velocity of the air without gusts, world frame, m/s
    wind_gust: FloatArray  # (GUST_SIZE, 0 or n)
    frames: (
        Float32Array  # (n, depth, frame size), depth 0 where an observation is the present features
    )
    ages: IntArray  # (ages,), of the frames in an observation, control steps
    integral: FloatArray  # (0 or 3, n), of the position
    integral_numbers: FloatArray  # (4,), see PositionIntegral
    streams: Any  # uint32 (4, n), see random.py
    # (2 OBSERVATION_SIZE + 2, 1 or n), μ and σ of Eq. 3.16, levels of the relative and additive
    # noise
    scaling: FloatArray
    task_index: IntArray  # (n,), of the episodes under way
    task_parameters: FloatArray  # (tasks, columns), see TASK
    task_weights: FloatArray  # (tasks,), cumulative
    returns: FloatArray  # (n,), of the episodes so far
    limits: IntArray  # (n,), control steps of the episodes under way
    max_steps: IntArray  # (n,), of those that follow
    outcome: Any  # OUTCOME (n,)
    last_observations: Float32Array  # (n, size), of the episodes that outcome tells of
    # (5,): physics step, s; physics steps in a control step; whether delays differ by row;
    # whether
    constants: FloatArray
    # rotor positions do; whether a row that ends begins its next episode within the same step


@compiled
def step(
    control, leads, mode, actions, observations, rewards, dones,
    state, queue, wrench, vehicles, base_vehicles, distribution_numbers, randomize_numbers, gust, wind, wind_gust,
    frames, ages, integral, integral_numbers, streams, scaling,
    task_index, task_parameters, task_weights, returns, limits, max_steps, outcome, last_observations, constants,
):  # fmt: skip
    """A control step of all rows, of which this thread takes as many as others leave it; see
    :func:`.threads.share_out`.

    Arrays as flat arguments: with them in a named tuple numba took twice as long to compile, and
    each block a tenth longer.

    :param leads: whether this is the thread that returns to the batch.
    :param actions: float32 (n, 4); ``observations`` float32 (n, size), ``rewards`` float32 (n,) and
        ``dones`` bool (n,) are written; the others are :class:`BatchArrays`.
    :return: False if an action is not finite, and then nothing has happened.
    """
    n, physics_step, substeps = state.shape[1], constants[0], np.int64(constants[1])
    own_delays, own_arms, autoreset = constants[2] > 0.0, constants[3] > 0.0, constants[4] > 0.0
    chunks = (n + CHUNK - 1) // CHUNK
    if leads:
        if mode != LOOK and not _finite(actions):
            return False
        control[LEFT] = chunks
    blocks = _new_block()
    rows, found, taken, fresh = np.empty(n, np.int64), 0, 0, True  # rows whose observations are due
    while True:
        left = atomic_add(control, LEFT, -1)
        if left <= 0:
            break
        taken += 1
        chunk = (chunks - left) * CHUNK
        if mode == LOOK:
            for i in range(chunk, min(chunk + CHUNK, n)):
                rows[found] = i
                found += 1
            continue
        for first in range(chunk, min(chunk + CHUNK, n), LANES):
            b = blocks[0]  # here: numba frees an array after its last use, whatever points into it
            count = min(LANES, n - first)
            # What is the same for all rows is in the block already unless it is fresh.
            for lane in range(LANES):
                b.row[lane] = first + min(lane, count - 1)
            if fresh or scaling.shape[1] > 1:
                _load_scaling(b, scaling)
            if fresh or vehicles.shape[1] > 1:
                _load_vehicles(b, vehicles, first, count, physics_step, fresh or own_arms)
            if fresh or task_weights.shape[0] > 1:
                _load_scored(b, task_index, task_parameters)
            fresh = False
            _load_rows(state, first, count, b.state)
            if mode == FLY:
                _load_rows(wrench, first, count, b.wrench)
                _load_rows(wind, first, count, b.wind)
                if gust.shape[1] > 0:
                    add_gusts(b.force_world, gust, first, count)
                if wind_gust.shape[1] > 0:
                    add_gusts(b.wind, wind_gust, first, count)
                _load_commands(actions, queue, own_delays, b, first, count)
                fly(b, physics_step, substeps)
                for k in range(X.target):
                    for lane in range(count):
                        state[k, first + lane] = b.state[k, lane]
            score(b)
            for lane in range(count):
                streams[STEP, first + lane] += np.uint32(1)
            _load_rows(streams, first, count, b.stream)
            observe(b)
            if gust.shape[1] > 0:
                advance_gusts(b, gust, first, count)
            if wind_gust.shape[1] > 0:
                gust_words(b.word[GUST_WORDS:], b.stream)
                advance_gusts(b, wind_gust, first, count)
            if frames.shape[1] > 0:
                for lane in range(count):
                    i = first + lane
                    store_action(i, np.int64(b.stream[STEP, lane]), actions[i], frames)
                    if integral.shape[0] > 0:
                        integrate_position(
                            i, b.feature, lane, b.mean, b.inverse_std, integral_numbers, integral
                        )
            _write_observations(b, count, integral, ages, frames, observations)

            height, radius, distance, scored = b.position[2], b.radius, b.distance, b.scored
            ends = 0
            for lane in range(count):
                i = first + lane
                returns[i] += b.reward[lane]
                rewards[i] = b.reward[lane]
                lost = (height[lane] <= radius[lane]) | (
                    distance[lane] > scored[S.max_distance, lane]
                )
                dones[i] = lost | (b.stream[STEP, lane] >= limits[i])
                ends += dones[i]
            if ends == 0 and autoreset:
                continue
            for lane in range(count):
                i = first + lane
                if not dones[i] and autoreset:
                    continue
                outcome[i].collision = height[lane] <= radius[lane]
                outcome[i].out_of_range = distance[lane] > scored[S.max_distance, lane]
                outcome[i].truncated = not (outcome[i].collision or outcome[i].out_of_range)
                outcome[i].success = outcome[i].truncated and succeeds(b, lane)
                outcome[i].distance = distance[lane]
                outcome[i].total, outcome[i].reward = returns[i], b.reward[lane]
                outcome[i].length = b.stream[STEP, lane]
                for k in range(observations.shape[1]):
                    last_observations[i, k] = observations[i, k]
                if autoreset:
                    rows[found] = i
                    found += 1

    for first in range(0, found, LANES):
        b = blocks[0]
        count = min(LANES, found - first)
        for lane in range(LANES):
            b.row[lane] = rows[first + min(lane, count - 1)]
        for lane in range(count):
            i = b.row[lane]
            if not dones[i]:
                continue
            returns[i], limits[i] = 0.0, max_steps[i]
            count_episode(i, streams)
            sample_episode(
                i,
                streams,
                base_vehicles,
                distribution_numbers,
                randomize_numbers,
                vehicles,
                wrench,
                gust,
                wind,
                wind_gust,
            )
            start_episode(
                i, state, queue, streams, task_index, vehicles, task_parameters, task_weights
            )
            if frames.shape[1] > 0:
                clear_frames(i, frames, integral)
        if fresh or scaling.shape[1] > 1:
            _load_scaling(b, scaling)
        fresh = False
        if b.row[count - 1] - b.row[0] == count - 1:  # side by side, since rows ascend
            _load_rows(state, b.row[0], count, b.state)
            _load_rows(streams, b.row[0], count, b.stream)
        else:  # lanes behind the last row keep a row of the last block
            for lane in range(count):
                for k in range(STATE_SIZE):
                    b.state[k, lane] = state[k, b.row[lane]]
                for k in range(4):
                    b.stream[k, lane] = streams[k, b.row[lane]]
        observe(b)
        _write_observations(b, count, integral, ages, frames, observations)
    atomic_add(control, DONE, taken)
    if leads:
        finish(control, chunks)
    return True


@compiled
def rotor_wrenches(actions, out, state, queue, wrench, vehicles, physics_step, own_delays):
    """Advance delay and rotors of row 0 by a control step, for a simulator that moves the body
    itself.

    Motors do not feel the body, so that all physics steps of a control step can be worked out
    before it moves.

    :param actions: float32 (n, 4), clipped to [-1, 1].
    :param out: (substeps, 2, 3): what rotors and wrench do in each physics step, force (N) and
        torque (N m), body frame.
    """
    blocks = _new_block()
    for each in range(len(out)):
        b = blocks[0]
        if each == 0:
            b.row[:] = 0
            _load_rows(state, 0, 1, b.state)
            _load_rows(wrench, 0, 1, b.wrench)
            _load_vehicles(b, vehicles, 0, 1, physics_step, True)
            _load_commands(actions, queue, own_delays, b, 0, 1)
        turn_rotors(b, 0)
        for axis in range(3):
            out[each, 0, axis] = b.force_body[axis, 0]
            out[each, 1, axis] = b.torque_body[axis, 0] + moment(b, axis, 0)
        out[each, 0, 2] += total_thrust(b, 0)
        for rotor in range(4):
            state[X.rotor_speeds + rotor, 0] = b.rotor_speeds[rotor, 0]


@compiled
def write_body(state, position, quaternion, velocity, rates):
    """Write another simulator's pose, quaternion (x, y, z, w), and world-frame velocities into
    column 0 of ``state``.
    """
    x, y, z, w = quaternion
    r, state[X.quaternion, 0] = rotation_rows(w, x, y, z), w
    for axis in range(3):
        state[X.position + axis, 0], state[X.velocity + axis, 0] = position[axis], velocity[axis]
        state[X.quaternion + 1 + axis, 0] = quaternion[axis]
        state[X.body_rates + axis, 0] = (
            r[0][axis] * rates[0] + r[1][axis] * rates[1] + r[2][axis] * rates[2]
        )


@compiled
def _new_block():
    """Room for a block, (1,), which begins with a cache line: vectors that straddle two take a
    third longer.
    """
    room = np.empty(_SIZE + 64, np.uint8)
    start = -room.ctypes.data % 64
    return room[start : start + _SIZE].view(BLOCK)


@compiled
def _finite(actions):
    # By their bits: code compiled with fastmath may take it that no NaN exists.
    wrong = 0
    for bits in actions.view(np.int32).reshape(-1):
        wrong += (bits & 0x7F800000) == 0x7F800000
    return wrong == 0


@compiled
def _write_observations(b, count, integral, ages, frames, out):
    """The observations of a block to its rows of ``out``, float32 (n, size)."""
    if frames.shape[1] == 0:
        for lane in range(count):
            i = b.row[lane]
            for k in range(OBSERVATION_SIZE):
                out[i, k] = b.feature[k, lane]
        return
    for lane in range(count):
        since = np.int64(b.stream[STEP, lane])
        observe_frames(
            b.row[lane], since, b.feature, lane, b.inverse_std, integral, ages, frames, out
        )


@compiled
def _load_rows(source, first, count, target):
    """Some columns of a (rows, n) array to a block, or one column for all lanes."""
    for k in range(target.shape[0]):
        if source.shape[1] == 1:
            for lane in range(LANES):
                target[k, lane] = source[k, 0]
        elif count == LANES:
            for lane in range(LANES):
                target[k, lane] = source[k, first + lane]
        else:
            for lane in range(LANES):
                target[k, lane] = source[k, first + min(lane, count - 1)]


@compiled
def _load_vehicles(b, vehicles, first, count, dt, arms):
    """What the control step needs of the vehicles of a block, with the divisions done; without
    ``arms`` those stay.
    """
    if vehicles.shape[1] > 1 and count == LANES:
        _divide(b, vehicles, first, dt)
    else:
        _load_rows(vehicles, first, count, b.vehicle)
        _divide(b, b.vehicle, 0, dt)
    if arms:
        _load_rows(vehicles[P.roll_arm_0 :], first, count, b.arm.reshape(12, LANES))


@compiled
def _divide(b, v, first, dt):
    for lane in range(LANES):
        i = first + lane
        ixx, iyy, izz, lift = v[P.ixx, i], v[P.iyy, i], v[P.izz, i], v[P.thrust_coefficient, i]
        exact = b.exact[lane] = v[P.exact_motors, i]
        b.motor[0, lane] = motor_factor(v[P.motor_gain_up, i], exact, dt)
        b.motor[1, lane] = motor_factor(v[P.motor_gain_down, i], exact, dt)
        b.push[lane] = dt / v[P.mass, i]
        b.drag[0, lane], b.drag[1, lane], b.drag[2, lane] = (
            v[P.drag_x, i],
            v[P.drag_y, i],
            v[P.drag_z, i],
        )
        b.fall[lane], b.lift[lane] = v[P.gravity, i] * dt, lift
        b.twist[0, lane], b.twist[1, lane], b.twist[2, lane] = dt / ixx, dt / iyy, dt / izz
        b.gyro[0, lane], b.gyro[1, lane], b.gyro[2, lane] = izz - iyy, ixx - izz, iyy - ixx
        b.thrust_middle[lane] = v[P.thrust_middle, i] / lift
        b.thrust_half_range[lane] = v[P.thrust_half_range, i] / lift
        b.radius[lane], b.delay[lane] = v[P.collision_radius, i], v[P.delay, i]


@compiled
def _load_commands(actions, queue, own_delays, b, first, count):
    """Actions into the delay's end, or where delays differ the row's own, and what leaves it into
    the wanted speeds.
    """
    command, wanted, own = b.command, b.wanted_speeds, b.delay
    delay = queue.shape[0]
    for lane in range(LANES):
        i = first + min(lane, count - 1)
        for k in range(4):
            command[k, lane] = actions[i, k]
    command_rotors(b)
    if delay == 0:
        for k in range(4):
            for lane in range(LANES):
                wanted[k, lane] = command[k, lane]
        return
    for k in range(4):
        for lane in range(LANES):
            wanted[k, lane] = queue[0, k, first + min(lane, count - 1)]
        for late in range(delay - 1):
            here, behind = (
                queue[late, k, first : first + count],
                queue[late + 1, k, first : first + count],
            )
            for lane in range(count):
                # Both are read whichever is taken, and the rows are views: else the loop is not
                # vectorised.
                new, old = command[k, lane], behind[lane]
                here[lane] = new if own_delays and own[lane] == late + 1.0 else old
        if own_delays:
            for lane in range(LANES):
                new, old = command[k, lane], wanted[k, lane]
                wanted[k, lane] = new if own[lane] == 0.0 else old
        for lane in range(count):
            queue[delay - 1, k, first + lane] = command[k, lane]


@compiled
def _load_scored(b, index, parameters):
    """Limits and costs of the tasks that the rows of a block are flying."""
    for lane in range(LANES):
        task = 0 if parameters.shape[0] == 1 else index[b.row[lane]]
        for k in range(len(_SCORED)):
            b.scored[k, lane] = parameters[task, _SCORED[k]]


@compiled
def _load_scaling(b, scaling):
    """μ, 1/σ and the noise levels of a block, in float32."""
    for lane in range(LANES):
        i = 0 if scaling.shape[1] == 1 else b.row[lane]
        b.noise_level[lane], b.additive[lane] = (
            scaling[2 * OBSERVATION_SIZE, i],
            scaling[2 * OBSERVATION_SIZE + 1, i],
        )
        for k in range(OBSERVATION_SIZE):
            b.mean[k, lane] = scaling[k, i]
            b.inverse_std[k, lane] = np.float32(1.0) / np.float32(scaling[OBSERVATION_SIZE + k, i])
