"""The motion of a log without most of its noise, from where predictions begin."""

from itertools import accumulate
from operator import mul

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation

from sb3_quad.base.types import FloatArray
from sb3_quad.envs.simulation.state import BODY_RATES, POSITION, QUATERNION, VELOCITY
from sb3_quad.identification.flight_log import UPWARD, Log, attitudes, quaternions

# s
AVERAGED = 0.5
RATES_AVERAGED = 0.025


def smoothed(log: Log) -> FloatArray:
    """Return the motion of a log without most of its noise, (n, 13).

    Gyro and accelerometer tell fast changes, as in a complementary filter. What remains changes
    slowly, and is smoothed (Savgol, second order); body rates are over a shorter time.
    """
    motion = log.motion.copy()
    motion[:, BODY_RATES] = _smooth(motion[:, BODY_RATES], log.step, RATES_AVERAGED)
    attitude = _turned(log)
    force = attitude.apply(log.force) - UPWARD
    motion[:, QUATERNION] = quaternions(attitude)
    motion[:, VELOCITY] = _follow(motion[:, VELOCITY], force, log.step)
    motion[:, POSITION] = _follow(motion[:, POSITION], motion[:, VELOCITY], log.step)
    return motion


def _follow(measured: FloatArray, speed: FloatArray, step: float) -> FloatArray:
    """Return the integral of a speed, (n, 3), that follows what was measured slowly."""
    way = cumulative_trapezoid(speed, dx=step, axis=0, initial=0.0)
    drift = _smooth(measured - way, step)
    followed: FloatArray = way + drift
    return followed


def _turned(log: Log) -> Rotation:
    """Return the attitudes that follow from the gyro, and the recorded ones slowly."""
    rates = log.motion[:, BODY_RATES]
    means = 0.5 * (rates[1:] + rates[:-1])
    turns = Rotation.from_rotvec(log.step * means)
    begin = Rotation.identity()
    by_gyro = Rotation.concatenate([*accumulate(turns, mul, initial=begin)])
    drift = attitudes(log.motion) * by_gyro.inv()
    quaternion = drift.as_quat()
    # Of q and -q, which are the same rotation, the one nearer to the row before
    cosines = np.einsum("ij,ij->i", quaternion[1:], quaternion[:-1])
    signs = np.cumprod(np.sign(cosines))
    quaternion[1:] *= signs[:, None]
    slow = _smooth(quaternion, log.step)
    return Rotation.from_quat(slow) * by_gyro


def _smooth(values: FloatArray, step: float, time: float = AVERAGED) -> FloatArray:
    half = round(time / step) // 2
    smooth: FloatArray = savgol_filter(values, 2 * half + 1, 2, axis=0)
    return smooth
