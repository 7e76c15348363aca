"""The 18 features of an observation (thesis 3.3.1), their noise and their scaling (Eq. 3.16), as array functions."""

from __future__ import annotations

import math

import numpy as np
from numba import float32

from sb3_quad.simulation.engine.blocks import (
    FEATURE,
    INVERSE_STD,
    LEVEL,
    MEAN,
    NOISE,
    PX,
    QW,
    QX,
    QY,
    QZ,
    TX,
    VX,
    VY,
    VZ,
    WX,
    load_scaling,
    load_state,
    load_streams,
)
from sb3_quad.simulation.engine.gaussian import draw_normals, draw_words
from sb3_quad.simulation.engine.lowlevel import LANES, SCRATCH_SIZE, compiled, float32_rows, float64_rows, scratch_pointer

FEATURE_NAMES = (
    *("position_x", "position_y", "position_z"),  # r - r_T, world frame
    *(f"rotation_{row}{column}" for row in range(3) for column in range(3)),  # world to body
    *("velocity_x", "velocity_y", "velocity_z"),  # body frame
    *("body_rate_x", "body_rate_y", "body_rate_z"),
)
OBSERVATION_SIZE = len(FEATURE_NAMES)
DEFAULT_MEAN = np.zeros(OBSERVATION_SIZE)
DEFAULT_STD = np.repeat([10.0 / math.sqrt(3.0), math.sqrt(3.0), 5.0, 5.0], [3, 9, 3, 3])  # Table A.2


@compiled(fastmath=True)
def _features(scratch):
    b = float64_rows(scratch)
    out = float32_rows(scratch)
    for lane in range(LANES):
        qw, qx, qy, qz = b[QW, lane], b[QX, lane], b[QY, lane], b[QZ, lane]
        vx, vy, vz = b[VX, lane], b[VY, lane], b[VZ, lane]
        r00, r01, r02 = 1.0 - 2.0 * (qy * qy + qz * qz), 2.0 * (qx * qy - qw * qz), 2.0 * (qx * qz + qw * qy)
        r10, r11, r12 = 2.0 * (qx * qy + qw * qz), 1.0 - 2.0 * (qx * qx + qz * qz), 2.0 * (qy * qz - qw * qx)
        r20, r21, r22 = 2.0 * (qx * qz - qw * qy), 2.0 * (qy * qz + qw * qx), 1.0 - 2.0 * (qx * qx + qy * qy)
        for k in range(3):
            out[FEATURE + k, lane] = float32(b[PX + k, lane] - b[TX + k, lane])
            out[FEATURE + 15 + k, lane] = float32(b[WX + k, lane])
        out[FEATURE + 3, lane] = float32(r00)
        out[FEATURE + 4, lane] = float32(r10)
        out[FEATURE + 5, lane] = float32(r20)
        out[FEATURE + 6, lane] = float32(r01)
        out[FEATURE + 7, lane] = float32(r11)
        out[FEATURE + 8, lane] = float32(r21)
        out[FEATURE + 9, lane] = float32(r02)
        out[FEATURE + 10, lane] = float32(r12)
        out[FEATURE + 11, lane] = float32(r22)
        out[FEATURE + 12, lane] = float32(r00 * vx + r10 * vy + r20 * vz)
        out[FEATURE + 13, lane] = float32(r01 * vx + r11 * vy + r21 * vz)
        out[FEATURE + 14, lane] = float32(r02 * vx + r12 * vy + r22 * vz)


@compiled(fastmath=True)
def _disturb_and_scale(scratch):
    b = float32_rows(scratch)
    for k in range(OBSERVATION_SIZE):
        for lane in range(LANES):
            noisy = b[FEATURE + k, lane] * (float32(1.0) + b[LEVEL, lane] * b[NOISE + k, lane])
            b[FEATURE + k, lane] = (noisy - b[MEAN + k, lane]) * b[INVERSE_STD + k, lane]


@compiled(inline="always")
def observe_block(scratch):
    """Observations of a loaded block, in its ``FEATURE`` rows: each feature times (1 + level N(0, 1)), then scaled."""
    _features(scratch)
    draw_words(scratch)
    draw_normals(scratch)
    _disturb_and_scale(scratch)


@compiled
def store_observations(scratch, out, first, count):
    """The observations of a block to rows of ``out``, float32 (n, 18)."""
    b = float32_rows(scratch)
    for lane in range(count):
        for k in range(OBSERVATION_SIZE):
            out[first + lane, k] = b[FEATURE + k, lane]


@compiled
def observe(state, streams, mean, std, noise_level, out):
    """Write the noisy, scaled observations of all rows into ``out``.

    The noise belongs to the row's episode and step: the same until the stream counts on.

    :param state: float64 (STATE_SIZE, n), see dynamics/state.py.
    :param streams: uint32 (4, n), see dynamics/streams.py.
    :param mean: μ of Eq. 3.16, float64 (18, n), or (18, 1) for all rows; ``std`` likewise.
    :param noise_level: float64 (n,) or (1,), relative; 0: the features exactly.
    :param out: float32 (n, 18).
    """
    memory = np.empty(SCRATCH_SIZE + 8)
    n = state.shape[1]
    for first in range(0, n, LANES):
        scratch = scratch_pointer(memory)  # in the loop: numba frees what is not used again
        count = min(LANES, n - first)
        load_state(scratch, state, first, count)
        load_streams(scratch, streams, first, count)
        load_scaling(scratch, mean, std, noise_level, first, count)
        observe_block(scratch)
        store_observations(scratch, out, first, count)
