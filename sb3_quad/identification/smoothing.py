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

AVERAGED = 0.5  # s


def smoothed(log: Log) -> FloatArray:
    """Return the motion of a log with position, attitude and velocity smoothed, (n, 13).

    Gyro and accelerometer tell fast changes, as in a complementary filter. What remains changes
    slowly, and is smoothed (Savgol, second order).
    """
    motion = log.motion.copy()
    attitude = _turned(log)
    force = attitude.apply(log.force) - UPWARD
    motion[:, QUATERNION] = quaternions(attitude)
    motion[:, VELOCITY] = _follow(motion[:, VELOCITY], force, log.step)
    motion[:, POSITION] = _follow(motion[:, POSITION], motion[:, VELOCITY], log.step)
    return motion


def _follow(measured: FloatArray, speed: FloatArray, step: float) -> FloatArray:
    """Return the integral of a speed, (n, 3), that follows what was measured slowly."""
    way = cumulative_trapezoid(speed, dx=step, axis=0, initial=0.0)
    return np.asarray(way + _slowly(measured - way, step))


def _turned(log: Log) -> Rotation:
    """Return the attitudes that follow from the gyro, and the recorded ones slowly."""
    rates = log.motion[:, BODY_RATES]
    turns = Rotation.from_rotvec(0.5 * log.step * (rates[1:] + rates[:-1]))
    by_gyro = Rotation.concatenate([*accumulate(turns, mul, initial=Rotation.identity())])
    drift = (attitudes(log.motion) * by_gyro.inv()).as_quat()
    # Of q and -q, which are the same rotation, the one nearer to the row before
    cosines = np.einsum("ij,ij->i", drift[1:], drift[:-1])
    drift[1:] *= np.cumprod(np.sign(cosines))[:, None]
    return Rotation.from_quat(_slowly(drift, log.step)) * by_gyro


def _slowly(values: FloatArray, step: float) -> FloatArray:
    rows = round(AVERAGED / step) // 2 * 2 + 1
    return np.asarray(savgol_filter(values, rows, 2, axis=0))
