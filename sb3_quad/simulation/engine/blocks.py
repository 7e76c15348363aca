"""What lies where in a block's scratch memory, and the copies between it and the arrays of all rows.

A block is ``LANES`` neighbouring rows of the environment. Lanes behind the last row repeat it, so that every loop runs over
all lanes: a row's numbers then never depend on how many others fly, or on where in the batch it stands.
"""

from __future__ import annotations

import math

import numpy as np

from sb3_quad.simulation.engine.lowlevel import LANES, compiled, float32_rows, float64_rows, uint32_rows
from sb3_quad.simulation.state import STATE_SIZE
from sb3_quad.vehicles.vehicle import PARAMETER_NAMES

# float64 rows. 0:20 the state as of dynamics/state.py
PX, PY, PZ, QW, QX, QY, QZ, VX, VY, VZ, WX, WY, WZ, S0, S1, S2, S3, TX, TY, TZ = range(STATE_SIZE)
WANTED = 20  # 4: rotor speeds to be reached in this control step
COMMAND = 24  # 4: action, then the rotor speed it commands
WRENCH = 28  # 12: force world, force body, torque world, torque body
MOTOR, LIFT, FALL, PUSH = 40, 41, 42, 43  # km dt, kF, g dt, dt / m
TWIST_X, TWIST_Y, TWIST_Z = 44, 45, 46  # dt / I
GYRO_X, GYRO_Y, GYRO_Z = 47, 48, 49  # Izz - Iyy, Ixx - Izz, Iyy - Ixx
ARM = 50  # 12: moment per thrust, by axis and rotor
MIDDLE, HALF, RADIUS = 62, 63, 64  # thrust_middle / kF, thrust_half_range / kF, collision radius
MAX_DISTANCE = 65  # 6: max_distance, then the five costs, as in a row of the task table from its seventh column
REWARD, DISTANCE = 71, 72
AX, AY, AZ, AW = 73, 74, 75, 76  # work space

# float32 rows
MEAN, INVERSE_STD, NOISE, FEATURE, LEVEL = 0, 18, 36, 54, 72
# uint32 rows
WORD, KEY_ROW = 0, 20  # 20 random words; key_lo, key_hi, episode, step

_NAMES = {name: index for index, name in enumerate(PARAMETER_NAMES)}
P_MASS, P_IXX, P_IYY, P_IZZ, P_LIFT, P_MOTOR, P_GRAVITY = (
    _NAMES[name] for name in ("mass", "ixx", "iyy", "izz", "thrust_coefficient", "motor_gain", "gravity")
)
P_ARM, P_HOVER, P_MIDDLE, P_HALF, P_RADIUS = (
    _NAMES[name] for name in ("roll_arm_0", "hover_thrust", "thrust_middle", "thrust_half_range", "collision_radius")
)


@compiled
def load_columns(source, first, count, target, row):
    """Copy columns of a (rows, n) array to the lanes of the rows from ``row`` on."""
    if count == LANES:
        for k in range(source.shape[0]):
            for lane in range(LANES):
                target[row + k, lane] = source[k, first + lane]
    else:
        for k in range(source.shape[0]):
            for lane in range(LANES):
                target[row + k, lane] = source[k, first + min(lane, count - 1)]


@compiled
def load_state(scratch, state, first, count):
    """The true state of a block."""
    load_columns(state, first, count, float64_rows(scratch), 0)


@compiled
def store_state(scratch, state, first, count):
    """Back to the array of all rows; the target stays as it is."""
    b = float64_rows(scratch)
    rows = state.shape[0] - 3  # not a constant: that would have the compiler write out every row
    if count == LANES:
        for k in range(rows):
            for lane in range(LANES):
                state[k, first + lane] = b[k, lane]
    else:
        for lane in range(count):
            for k in range(rows):
                state[k, first + lane] = b[k, lane]


@compiled
def load_streams(scratch, streams, first, count):
    """The keys and counters of a block."""
    w = uint32_rows(scratch)
    for k in range(streams.shape[0]):
        for lane in range(LANES):
            w[KEY_ROW + k, lane] = streams[k, first + min(lane, count - 1)]


@compiled
def load_vehicles(scratch, vehicles, first, count, physics_step):
    """What the control step needs of the vehicles of a block, with the divisions done."""
    b = float64_rows(scratch)
    last = vehicles.shape[1] - 1
    dt = physics_step
    for lane in range(LANES):
        i = min(first + min(lane, count - 1), last)
        lift = vehicles[P_LIFT, i]
        ixx, iyy, izz = vehicles[P_IXX, i], vehicles[P_IYY, i], vehicles[P_IZZ, i]
        b[MOTOR, lane] = vehicles[P_MOTOR, i] * dt
        b[LIFT, lane] = lift
        b[FALL, lane] = vehicles[P_GRAVITY, i] * dt
        b[PUSH, lane] = dt / vehicles[P_MASS, i]
        b[TWIST_X, lane], b[TWIST_Y, lane], b[TWIST_Z, lane] = dt / ixx, dt / iyy, dt / izz
        b[GYRO_X, lane], b[GYRO_Y, lane], b[GYRO_Z, lane] = izz - iyy, ixx - izz, iyy - ixx
        for k in range(12):
            b[ARM + k, lane] = vehicles[P_ARM + k, i]
        b[MIDDLE, lane] = vehicles[P_MIDDLE, i] / lift
        b[HALF, lane] = vehicles[P_HALF, i] / lift
        b[RADIUS, lane] = vehicles[P_RADIUS, i]


@compiled(fastmath=True)
def command_rotors(scratch):
    """Rotor speeds from actions (Eqs. 3.18 and 2.4), in place."""
    b = float64_rows(scratch)
    for lane in range(LANES):
        for k in range(4):
            action = min(max(b[COMMAND + k, lane], -1.0), 1.0)
            b[COMMAND + k, lane] = math.sqrt(b[MIDDLE, lane] + b[HALF, lane] * action)


@compiled
def load_commands(scratch, actions, queue, first, count):
    """Actions into the delay's end, and what leaves it into the rows of wanted rotor speeds."""
    b = float64_rows(scratch)
    delay, rotors = queue.shape[0], queue.shape[1]
    for lane in range(LANES):
        i = first + min(lane, count - 1)
        for k in range(rotors):
            b[COMMAND + k, lane] = actions[i, k]
    command_rotors(scratch)
    if delay == 0:
        for k in range(rotors):
            for lane in range(LANES):
                b[WANTED + k, lane] = b[COMMAND + k, lane]
        return
    for k in range(rotors):
        for lane in range(LANES):
            b[WANTED + k, lane] = queue[0, k, first + min(lane, count - 1)]
        for late in range(delay - 1):
            for lane in range(count):
                queue[late, k, first + lane] = queue[late + 1, k, first + lane]
        for lane in range(count):
            queue[delay - 1, k, first + lane] = b[COMMAND + k, lane]


@compiled
def load_scaling(scratch, mean, std, noise_level, first, count):
    """μ, 1/σ and the noise level of a block, in float32."""
    b = float32_rows(scratch)
    step = 0 if noise_level.shape[0] == 1 else 1
    for lane in range(LANES):
        i = step * (first + min(lane, count - 1))
        b[LEVEL, lane] = noise_level[i]
        for k in range(std.shape[0]):
            b[MEAN + k, lane] = mean[k, i]
            b[INVERSE_STD + k, lane] = std[k, i]
    for k in range(std.shape[0]):
        for lane in range(LANES):
            b[INVERSE_STD + k, lane] = np.float32(1.0) / b[INVERSE_STD + k, lane]
