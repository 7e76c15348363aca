"""The features of an observation (thesis 3.3.1), their noise and their scaling (Eq. 3.16).

:data:`FEATURES` names them and :func:`features` computes them: a new one is a line in the table and
its formula.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import float32

from sb3_quad.simulation.compiled import LANES, compiled
from sb3_quad.simulation.physics import rotation_rows
from sb3_quad.simulation.random import random_words, standard_normals
from sb3_quad.simulation.state import first_rows, row_slices


class Feature(NamedTuple):
    """Features of one kind.

    :param name: of the group; ``each`` begins the name of one feature, which ends in one of
        ``parts``.
    :param std: σ of Eq. 3.16 (Table A.2), in ``unit``.
    """

    name: str
    each: str
    parts: tuple[str, ...]
    std: float
    unit: str


_MATRIX = tuple(f"{row}{column}" for row in range(3) for column in range(3))
FEATURES = (
    Feature(
        "position", "position", ("x", "y", "z"), 10.0 / math.sqrt(3.0), "m"
    ),  # r - r_T, world frame
    Feature("rotation", "rotation", _MATRIX, math.sqrt(3.0), "-"),  # world to body
    Feature("velocity", "velocity", ("x", "y", "z"), 5.0, "m/s"),  # body frame
    Feature("body_rates", "body_rate", ("x", "y", "z"), 5.0, "rad/s"),  # body frame
)
_SIZES = {feature.name: len(feature.parts) for feature in FEATURES}
F = first_rows(_SIZES)
GROUPS = row_slices(_SIZES)
"""By the name of a group, where its features stand in an observation."""
FEATURE_NAMES = tuple(f"{feature.each}_{part}" for feature in FEATURES for part in feature.parts)
OBSERVATION_SIZE = len(FEATURE_NAMES)
NORMALS = -(-OBSERVATION_SIZE // 2) * 2  # of the noise, each from a random word
GUST_WORDS = NORMALS  # where the two random words of a gust begin, behind those
WORDS = -(-(GUST_WORDS + 2) // 4) * 4  # random words of a control step
DEFAULT_MEAN = np.zeros(OBSERVATION_SIZE)
DEFAULT_STD = np.concatenate([np.full(len(feature.parts), feature.std) for feature in FEATURES])


@compiled(fastmath=True)
def features(b):
    """``b.feature``, float32: what is observed of a loaded block, in the units of the table,
    without noise.
    """
    position, target, q, v, w, out = (
        b.position,
        b.target,
        b.quaternion,
        b.velocity,
        b.body_rates,
        b.feature,
    )
    for lane in range(LANES):
        vx, vy, vz = v[0, lane], v[1, lane], v[2, lane]
        (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = rotation_rows(
            q[0, lane], q[1, lane], q[2, lane], q[3, lane]
        )
        for k in range(3):
            out[F.position + k, lane] = float32(position[k, lane] - target[k, lane])
            out[F.body_rates + k, lane] = float32(w[k, lane])
        out[F.rotation, lane] = float32(r00)
        out[F.rotation + 1, lane] = float32(r10)
        out[F.rotation + 2, lane] = float32(r20)
        out[F.rotation + 3, lane] = float32(r01)
        out[F.rotation + 4, lane] = float32(r11)
        out[F.rotation + 5, lane] = float32(r21)
        out[F.rotation + 6, lane] = float32(r02)
        out[F.rotation + 7, lane] = float32(r12)
        out[F.rotation + 8, lane] = float32(r22)
        out[F.velocity, lane] = float32(r00 * vx + r10 * vy + r20 * vz)
        out[F.velocity + 1, lane] = float32(r01 * vx + r11 * vy + r21 * vz)
        out[F.velocity + 2, lane] = float32(r02 * vx + r12 * vy + r22 * vz)


@compiled(fastmath=True)
def _disturb_and_scale(b):
    feature, noise, mean, inverse_std = b.feature, b.noise, b.mean, b.inverse_std
    added = float32(0.0)
    for lane in range(LANES):
        added = max(added, b.additive[lane])
    for k in range(OBSERVATION_SIZE):
        for lane in range(LANES):
            relative = b.noise_level[lane] * feature[k, lane]
            if added == float32(0.0):
                noisy = feature[k, lane] * (float32(1.0) + b.noise_level[lane] * noise[k, lane])
            else:
                fixed = b.additive[lane] / inverse_std[k, lane]
                noisy = (
                    feature[k, lane]
                    + math.sqrt(relative * relative + fixed * fixed) * noise[k, lane]
                )
            feature[k, lane] = (noisy - mean[k, lane]) * inverse_std[k, lane]


@compiled(inline="always")
def observe(b):
    """``b.feature``: the observations of a loaded block, disturbed by the noise and scaled.

    The noise belongs to the row's episode and step: it is the same until the stream counts on.
    """
    features(b)
    random_words(b)
    standard_normals(b)
    _disturb_and_scale(b)
