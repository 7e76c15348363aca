"""The error of a state estimator: what a controller takes for the state is off, for a while in the
same direction.

A :class:`EstimatorError` is data, ``noise.estimator`` in ``env_kwargs``. ``estimate``, float64
(ESTIMATE_SIZE, n), holds the present errors of n vehicles and their standard deviations, or is
(ESTIMATE_SIZE, 0) if the estimate is exact.
"""

import math

import numpy as np
from pydantic import Field, PositiveFloat

from sb3_quad.base.compiled import LANES, called, inlined
from sb3_quad.base.types import FloatArray
from sb3_quad.base.validate import Frozen
from sb3_quad.envs.simulation.physics import quaternion_product
from sb3_quad.envs.simulation.random import (
    ESTIMATOR,
    STEP,
    random_words,
    standard_normals,
    uniforms,
)
from sb3_quad.envs.simulation.randomization import (
    RANGE,
    Magnitude,
    Share,
    between,
    numbers_of,
)
from sb3_quad.envs.simulation.state import QUATERNION, X, first_rows
from sb3_quad.envs.simulation.vectors import dot, four, scaled, store, vector_at

EXACT = Magnitude(low=0.0, high=0.0)
ERRORS = {"position": 3, "velocity": 3, "body_rates": 3, "attitude": 3}
ESTIMATE = {**ERRORS, "std": 4}
ESTIMATE_SIZE = sum(ESTIMATE.values())
E = first_rows(ESTIMATE)
# Rows of the state to which the errors before that of the attitude are added
_ADDED = (*range(X.quaternion), *range(X.velocity, X.rotor_speeds))
# The numbers that compiled code reads: e^(-dt / time constant), share, and a range for each error
_NUMBERS = {"time_constant": 1, "share": 1, **dict.fromkeys(ERRORS, RANGE)}
N = first_rows(_NUMBERS)
# The uniforms of an episode that share no random word with the normals of its first step
_FIRST_UNIFORM = 10


class EstimatorError(Frozen):
    """What a vehicle's own estimate is off by: on each axis an Ornstein-Uhlenbeck process, whose
    standard deviations are these, from the first step on. A range is sampled for each episode.

    The update is exact for any control step (D. T. Gillespie, "Exact numerical simulation of the
    Ornstein-Uhlenbeck process", Phys. Rev. E 54, 1996). Observations show the estimate, as do the
    integral and the frames in them. Rewards, crashes and metrics are those of the true state.
    """

    position: Magnitude = EXACT
    """world axes, m"""
    velocity: Magnitude = EXACT
    """world axes, m/s"""
    attitude: Magnitude = EXACT
    """components of the rotation vector from the true to the estimated body axes, degrees"""
    body_rates: Magnitude = EXACT
    """body axes, rad/s"""
    time_constant: PositiveFloat = Field(default=0.5, le=1e6)
    """time after which an error has faded to 1/e, s"""
    share: Share = 1.0
    """fraction of the episodes with such errors; in the others the estimate is exact"""

    def numbers(self, control_step: float) -> FloatArray:
        """Return the numbers that :func:`begin_estimate` and :func:`perceive` read.

        :param control_step: s.
        """
        row = numbers_of(self, _NUMBERS)
        row[N.time_constant] = math.exp(-control_step / self.time_constant)
        row[N.attitude : N.attitude + 2] *= math.pi / 180.0
        return row


@called
def begin_estimate(i, streams, numbers, estimate):
    """Sample the standard deviations of row i's episode, in place."""
    if estimate.shape[1] == 0:
        return
    u = uniforms(streams, i, ESTIMATOR)[_FIRST_UNIFORM:]
    is_wrong = np.float64(u[0] < numbers[N.share])
    for k in range(estimate.shape[0] - E.std):
        std = between(numbers, N.position + RANGE * k, u[1 + k], 0.0)
        estimate[E.std + k, i] = is_wrong * std


@called
def perceive(b, count, advances, numbers, estimate):
    """Replace the true states in a block by the estimates.

    :param advances: True: advance the errors by a control step, in place. False: those of a row
        that begins an episode are sampled, and the others stay.
    """
    random_words(b, ESTIMATOR)
    standard_normals(b)
    for lane in range(count):
        i = b.row[lane]
        keeps = numbers[N.time_constant]
        if not advances:
            keeps = np.float64(b.stream[STEP, lane] > 0)
        adds = math.sqrt(1.0 - keeps * keeps)
        for k in range(E.std):
            increment = adds * estimate[E.std + k // 3, i] * b.noise[k, lane]
            estimate[k, i] = keeps * estimate[k, i] + increment
    displace(b, estimate)


@called
def displace(b, estimate):
    """Add errors to the states in a block."""
    for k, row in enumerate(_ADDED):
        for lane in range(LANES):
            b.state[row, lane] += estimate[k, b.row[lane]]
    turn_attitudes(b, b.quaternion, estimate, 1.0)


@called
def turn_attitudes(b, quaternion, estimate, sign):
    """Multiply quaternions of a block, (4, LANES), by those of the attitude errors, in place.

    :param sign: 1, or -1 for the opposite turns. Those carry the gradient with respect to an
        estimated attitude to that with respect to the true one.
    """
    for lane in range(LANES):
        error = scaled(sign, vector_at(estimate, E.attitude, b.row[lane]))
        turned = quaternion_product(four(quaternion, lane), turn_by(error))
        quaternion[0, lane] = turned[0]
        store(quaternion[1:], lane, turned[1:])


@inlined
def turn_by(error):
    """Return the unit quaternion of a rotation vector, rad."""
    half = np.sqrt(dot(error, error)) / 2.0
    return np.cos(half), *scaled(np.sinc(half / np.pi) / 2.0, error)


def estimated(state: FloatArray, estimate: FloatArray) -> FloatArray:
    """Return the estimates of n true states, (STATE_SIZE, n)."""
    array = state.copy()
    array[[*_ADDED]] += estimate[: E.attitude]
    turn = turn_by.py_func(estimate[E.attitude : E.std])
    array[QUATERNION] = quaternion_product.py_func(state[QUATERNION], turn)
    return array
