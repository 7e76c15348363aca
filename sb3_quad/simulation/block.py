"""A block: ``LANES`` neighbouring rows of the environment, with all that a control step needs of them in one piece of memory.

Lanes behind the last row repeat it, so that every loop runs over all lanes: a row's numbers then never depend on how many
others fly, or on where in the batch it stands.
"""

import math
from typing import Any

import numpy as np
from numba import carray

from sb3_quad.simulation.compiled import LANES, compiled, pointer
from sb3_quad.simulation.observation import GUST_WORDS, NORMALS, OBSERVATION_SIZE
from sb3_quad.simulation.state import STATE, STATE_SIZE, WRENCH_SIZE, P, X
from sb3_quad.simulation.tasks import SCORED, T
from sb3_quad.vehicles.vehicle import PARAMETER_NAMES

_SCORED = tuple(getattr(T, name) for name in SCORED)
_WORDS = -(-(GUST_WORDS + 2) // 4) * 4

# Of every lane: the kind of numbers, and how many or of what shape.
_CONTENTS: dict[str, tuple[str, Any]] = {
    "state": ("f8", STATE_SIZE),  # all its rows
    "command": ("f8", 4),  # action, then the rotor speed it commands
    "wanted_speeds": ("f8", 4),  # rotor speeds to be reached in this control step
    "wrench": ("f8", WRENCH_SIZE),
    "motor": ("f8", ()),  # km dt
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
    "vehicle": ("f8", len(PARAMETER_NAMES)),  # room for those of one vehicle for all rows, or of a last block
    "scored": ("f8", len(SCORED)),  # max_distance and the costs of the row's task
    "reward": ("f8", ()),
    "distance": ("f8", ()),
    "work": ("f8", 4),
    "mean": ("f4", OBSERVATION_SIZE),  # μ of Eq. 3.16
    "inverse_std": ("f4", OBSERVATION_SIZE),  # 1 / σ
    "noise_level": ("f4", ()),  # relative
    "additive": ("f4", ()),  # level of the noise that is added, in σ
    "noise": ("f4", NORMALS),
    "feature": ("f4", OBSERVATION_SIZE),
    "word": ("u4", _WORDS),  # random
    "stream": ("u4", 4),
}
# The parts of the state lie in it, each under its name.
_PARTS = {name: (np.dtype(("f8", (STATE[name], LANES))), 8 * LANES * row) for name, row in X._asdict().items()}
_WHOLE = np.dtype([(name, kind, (*np.empty(shape).shape, LANES)) for name, (kind, shape) in _CONTENTS.items()])
_FIELDS: Any = {**(_WHOLE.fields or {}), **_PARTS}
BLOCK = np.dtype(_FIELDS)
MEMORY = BLOCK.itemsize + 64  # bytes of the array that a block lies in, at a cache line


@compiled
def block_in(memory):
    """The block in a uint8 array of ``MEMORY`` bytes."""
    return carray(pointer((memory.ctypes.data + 63) // 64 * 64), 1, BLOCK)[0]


@compiled
def load_rows(source, first, count, target):
    """Copy the first rows of a (rows, n) array to those of a block."""
    for k in range(target.shape[0]):
        if count == LANES:
            for lane in range(LANES):
                target[k, lane] = source[k, first + lane]
        else:
            for lane in range(LANES):
                target[k, lane] = source[k, first + min(lane, count - 1)]


@compiled
def store_state(b, state, first, count):
    """Back to the array of all rows; the target, which comes last, stays as it is."""
    for k in range(X.target):
        for lane in range(count):
            state[k, first + lane] = b.state[k, lane]


@compiled
def load_vehicles(b, vehicles, first, count, physics_step, arms):
    """What the control step needs of the vehicles of a block, with the divisions done; without ``arms`` those stay."""
    if vehicles.shape[1] > 1 and count == LANES:
        _prepare_vehicles(b, vehicles, first, physics_step, arms)
        return
    for k in range(vehicles.shape[0]):
        for lane in range(LANES):
            b.vehicle[k, lane] = vehicles[k, min(first + min(lane, count - 1), vehicles.shape[1] - 1)]
    _prepare_vehicles(b, b.vehicle, 0, physics_step, arms)


@compiled
def _prepare_vehicles(b, vehicles, first, dt, arms):
    motor, lift, fall, push, twist, gyro = b.motor, b.lift, b.fall, b.push, b.twist, b.gyro
    for lane in range(LANES):
        i = first + lane
        ixx, iyy, izz = vehicles[P.ixx, i], vehicles[P.iyy, i], vehicles[P.izz, i]
        motor[lane], push[lane] = vehicles[P.motor_gain, i] * dt, dt / vehicles[P.mass, i]
        fall[lane], lift[lane] = vehicles[P.gravity, i] * dt, vehicles[P.thrust_coefficient, i]
        twist[0, lane], twist[1, lane], twist[2, lane] = dt / ixx, dt / iyy, dt / izz
        gyro[0, lane], gyro[1, lane], gyro[2, lane] = izz - iyy, ixx - izz, iyy - ixx
        b.thrust_middle[lane] = vehicles[P.thrust_middle, i] / lift[lane]
        b.thrust_half_range[lane] = vehicles[P.thrust_half_range, i] / lift[lane]
        b.radius[lane], b.delay[lane] = vehicles[P.collision_radius, i], vehicles[P.delay, i]
    if arms:
        for axis in range(3):
            for rotor in range(4):
                for lane in range(LANES):
                    b.arm[axis, rotor, lane] = vehicles[P.roll_arm_0 + 4 * axis + rotor, first + lane]


@compiled(fastmath=True)
def _command_rotors(b):
    """Rotor speeds from actions (Eqs. 3.18 and 2.4), in place."""
    for lane in range(LANES):
        for k in range(4):
            action = min(max(b.command[k, lane], -1.0), 1.0)
            b.command[k, lane] = math.sqrt(b.thrust_middle[lane] + b.thrust_half_range[lane] * action)


@compiled
def load_commands(b, actions, queue, mixed, first, count):
    """Actions into the delay's end, which for ``mixed`` delays is the row's own, and what leaves it into the wanted speeds."""
    command, wanted, own = b.command, b.wanted_speeds, b.delay
    delay, rotors = queue.shape[0], queue.shape[1]
    for lane in range(LANES):
        i = first + min(lane, count - 1)
        for k in range(rotors):
            command[k, lane] = actions[i, k]
    _command_rotors(b)
    if delay == 0:
        for k in range(rotors):
            for lane in range(LANES):
                wanted[k, lane] = command[k, lane]
        return
    for k in range(rotors):
        for lane in range(LANES):
            wanted[k, lane] = queue[0, k, first + min(lane, count - 1)]
        for late in range(delay - 1):
            here, behind = queue[late, k, first : first + count], queue[late + 1, k, first : first + count]
            for lane in range(count):
                # Both are read whichever is taken, and the rows are views: else the loop is not vectorised.
                new, old = command[k, lane], behind[lane]
                here[lane] = new if mixed and own[lane] == late + 1.0 else old
        if mixed:
            for lane in range(LANES):
                new, old = command[k, lane], wanted[k, lane]
                wanted[k, lane] = new if own[lane] == 0.0 else old
        for lane in range(count):
            queue[delay - 1, k, first + lane] = command[k, lane]


@compiled
def load_scored(b, task_index, tasks, first, count):
    """Limits and costs of the tasks that the rows of a block are flying."""
    scored = b.scored
    for lane in range(LANES):
        task = 0 if tasks.shape[0] == 1 else task_index[first + min(lane, count - 1)]
        for k in range(scored.shape[0]):
            scored[k, lane] = tasks[task, _SCORED[k]]


@compiled
def load_scaling(b, mean, std, noise_level, additive, first, count):
    """μ, 1/σ and the noise levels of a block, in float32."""
    step = 0 if noise_level.shape[0] == 1 else 1
    for lane in range(LANES):
        i = step * (first + min(lane, count - 1))
        b.noise_level[lane], b.additive[lane] = noise_level[i], additive[i]
        for k in range(std.shape[0]):
            b.mean[k, lane] = mean[k, i]
            b.inverse_std[k, lane] = std[k, i]
    for k in range(std.shape[0]):
        for lane in range(LANES):
            b.inverse_std[k, lane] = np.float32(1.0) / b.inverse_std[k, lane]


@compiled
def store_observations(b, out, first, count):
    """The observations of a block, features alone, to rows of ``out``, float32 (n, OBSERVATION_SIZE)."""
    feature = b.feature
    for lane in range(count):
        for k in range(feature.shape[0]):
            out[first + lane, k] = feature[k, lane]
