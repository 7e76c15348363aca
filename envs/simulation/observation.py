"""The features of an observation (thesis 3.3.1), their noise and their scaling (Eq. 3.16).

:data:`FEATURES` names them and :func:`features` computes them. To add one, add a line to the table
and its formula to the function; nothing else lists them.
"""

import math
from typing import Literal, NamedTuple

import numpy as np
from numba import float32

from sb3_quad.base.compiled import LANES, fast, inlined, inner
from sb3_quad.base.types import FloatArray
from sb3_quad.envs.simulation.physics import rotation, to_body
from sb3_quad.envs.simulation.random import OBSERVATION_NOISE, random_words, standard_normals
from sb3_quad.envs.simulation.state import first_rows, row_slices
from sb3_quad.envs.simulation.vectors import (
    dot,
    store,
    subtract,
    transposed,
    turn,
    vector,
    vector_at,
)
from sb3_quad.envs.vehicles.layout import Turn


class Feature(NamedTuple):
    """A group of features of one kind.

    :param name: name of the group.
    :param prefix: the name of each feature begins with it, and ends in one of ``parts``.
    :param std: σ of Eq. 3.16 (Table A.2), in ``unit``.
    :param axes: what the features refer to, which decides how :func:`turn_features` turns them: the
        ``world``'s axes, the ``body``'s axes, or the ``rotors``.
    """

    name: str
    prefix: str
    parts: tuple[str, ...]
    std: float
    unit: str
    axes: Literal["world", "body", "rotors"]


_XYZ = ("x", "y", "z")
_MATRIX = ("00", "01", "02", "10", "11", "12", "20", "21", "22")
FEATURES = (
    # r - r_T
    Feature("position", "position", _XYZ, 10.0 / math.sqrt(3.0), "m", "world"),
    # The rotation matrix from world to body, row by row
    Feature("rotation", "rotation", _MATRIX, math.sqrt(3.0), "-", "body"),
    Feature("velocity", "velocity", _XYZ, 5.0, "m/s", "body"),
    Feature("body_rates", "body_rate", _XYZ, 5.0, "rad/s", "body"),
)
FEATURE_SIZES = {feature.name: len(feature.parts) for feature in FEATURES}
F = first_rows(FEATURE_SIZES)
GROUPS = row_slices(FEATURE_SIZES)
"""The place of each group in an observation, by its name."""
FEATURE_NAMES = tuple(f"{feature.prefix}_{part}" for feature in FEATURES for part in feature.parts)
OBSERVATION_SIZE = len(FEATURE_NAMES)
DEFAULT_MEAN = np.zeros(OBSERVATION_SIZE)
DEFAULT_STD = np.repeat([feature.std for feature in FEATURES], list(FEATURE_SIZES.values()))

# The noise takes a random word for each normal, and normals come in pairs. Two words for a gust
# follow. Random words come in fours.
NORMALS = 2 * math.ceil(OBSERVATION_SIZE / 2)
GUST_WORDS = NORMALS
WORDS = 4 * math.ceil((GUST_WORDS + 2) / 4)


def turn_features(turn: Turn) -> FloatArray:
    """Return the matrix from features in a vehicle's own axes to those in the axes of a layout.

    :param turn: from the vehicle's own body axes and rotors to those of the layout.
    :return: orthogonal, shape (OBSERVATION_SIZE, OBSERVATION_SIZE); its transpose turns them back.
    """
    matrix = np.eye(OBSERVATION_SIZE)
    for feature in FEATURES:
        place = GROUPS[feature.name]
        if feature.axes == "body":
            # A vector has three features, a matrix three for each body axis.
            columns = len(feature.parts) // 3
            matrix[place, place] = np.kron(turn.axes, np.eye(columns))
        elif feature.axes == "rotors":
            matrix[place, place] = np.eye(4)[list(turn.order)]
    return matrix


@inlined
def features(b, moves):
    """Write the features of a loaded block, in the units of the table and without noise.

    They go to ``b.feature``, float32.

    :param moves: whether references move or have a heading.
    """
    _features_at_rest(b, b)
    if moves:
        _relate(b)
        _turn(b)


@inner(fastmath=True, forceinline=False)
def _features_at_rest(b, out):
    # The same block twice, and no part of the caller: LLVM cannot tell how far the numbers of two
    # sizes that one pointer leads to lie apart, and would not vectorise the loop.
    for lane in range(LANES):
        r = rotation(b.quaternion, lane)
        v = to_body(r, vector(b.velocity, lane))
        offset = subtract(vector(b.position, lane), vector(b.target, lane))
        store(out.observed_position, lane, offset)
        # From world to body: the columns of r
        x, y, z = transposed(r)
        store(out.observed_rotation, lane, x)
        store(out.observed_rotation[3:], lane, y)
        store(out.observed_rotation[6:], lane, z)
        store(out.observed_velocity, lane, v)
        store(out.observed_body_rates, lane, vector(b.body_rates, lane))


@inlined
def heading_of(b, lane):
    """Return cosine and sine of the heading whose frame a lane observes; the world's if none is
    commanded.
    """
    cosine, sine = b.target_heading[0, lane], b.target_heading[1, lane]
    return (cosine if cosine * cosine + sine * sine > 0.0 else 1.0), sine


@fast
def _relate(b):
    """Make the velocity relative to that of a reference, in place."""
    for lane in range(LANES):
        x, y, z = vector(b.target_velocity, lane)
        velocity = float32(x), float32(y), float32(z)
        for row in range(3):
            axis = vector_at(b.observed_rotation, 3 * row, lane)
            b.observed_velocity[row, lane] -= dot(velocity, axis)


@fast
def _turn(b):
    """Turn the world axes of features to the heading of a reference, in place; body rates become
    relative to its rate.
    """
    for lane in range(LANES):
        c, s = heading_of(b, lane)
        cosine, sine = float32(c), float32(s)
        rate = float32(b.target_heading_rate[0, lane])
        for row in range(3):
            turn(b.observed_rotation, 3 * row, lane, cosine, sine)
            b.observed_body_rates[row, lane] -= rate * b.observed_rotation[3 * row + 2, lane]
        turn(b.observed_position, 0, lane, cosine, sine)


@inlined
def with_noise(b, k, lane):
    """Return feature k of a lane with its noise, in its unit. Relative noise on its own is
    multiplied by the feature including its sign.
    """
    feature = b.feature[k, lane]
    noise = b.noise[k, lane]
    relative = b.noise_level[lane] * feature
    fixed = b.additive[lane] / b.inverse_std[k, lane]
    both = feature + math.sqrt(relative * relative + fixed * fixed) * noise
    alone = feature * (float32(1.0) + b.noise_level[lane] * noise)
    return both if b.additive[lane] > float32(0.0) else alone


@fast
def _disturb_and_scale(b):
    """Add noise to ``b.feature`` and scale it by Eq. 3.16, in place."""
    feature = b.feature
    added = float32(0.0)
    for lane in range(LANES):
        added = max(added, b.additive[lane])
    for k in range(OBSERVATION_SIZE):
        for lane in range(LANES):
            if added == float32(0.0):
                # Relative noise alone, the usual case, needs no square root.
                noisy = feature[k, lane] * (float32(1.0) + b.noise_level[lane] * b.noise[k, lane])
            else:
                noisy = with_noise(b, k, lane)
            feature[k, lane] = (noisy - b.mean[k, lane]) * b.inverse_std[k, lane]


@inlined
def observe(b, moves):
    """Write the scaled features of a loaded block with their noise to ``b.feature``.

    The noise belongs to the row's episode and step: it stays the same until the stream advances.
    """
    features(b, moves)
    random_words(b, OBSERVATION_NOISE)
    standard_normals(b)
    _disturb_and_scale(b)
