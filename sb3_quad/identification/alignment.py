"""What a flight says about its own sensors.

From the whole flight follow the clock of the vehicle, by the shift at which gyro and attitude agree
best; and how the markers of a motion capture are mounted, so that the specific force of a vehicle
that does not move lies along z.
"""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.types import BoolArray, FloatArray
from sb3_quad.identification.plausible import refuse_unlike
from sb3_quad.identification.series import interpolated

WORTH_A_SHIFT = 0.998
# Clock offsets that are tried, s
OFFSETS = np.append(0.0, np.arange(-0.1, 0.1005, 0.001))


def recorded_attitudes(path: Path, series: FloatArray, grid: FloatArray) -> Rotation:
    """Return the attitudes at the times of a grid.

    :param series: times, s, and quaternions (w, x, y, z), (samples, 5).
    :raises ConfigError: these are no quaternions.
    """
    time = series[:, 0]
    norms = np.linalg.norm(series[:, 1:], axis=1)
    worst = np.abs(norms - 1.0).argmax()
    norm = norms[worst]
    if not 0.9 < norm < 1.1:
        raise ConfigError(f"{path}: row {worst + 1}: qw, qx, qy, qz have length {norm:.3g}")
    recorded = Rotation.from_quat(series[:, 1:], scalar_first=True)
    between = Slerp(time, recorded)
    return between(grid)


def clock_offset(
    path: Path, gyro: FloatArray, attitude: Rotation, grid: FloatArray, flying: BoolArray
) -> float:
    """Return how far the gyro's clock is behind that of the attitude, s.

    :raises ConfigError: they contradict each other.
    """
    step = grid[1] - grid[0]
    turns = attitude[:-2].inv() * attitude[2:]
    rates = turns.as_rotvec() / (2.0 * step)
    rates = np.pad(rates, ((1, 1), (0, 0)), "edge")[flying]
    times = grid[flying]
    gyros = [interpolated(gyro, times + behind) for behind in OFFSETS]
    costs = [np.square(one - rates).sum() for one in gyros]
    best = int(np.argmin(costs))
    # The first one is 0, and noise alone must not move the clock.
    if costs[best] > WORTH_A_SHIFT * costs[0]:
        best = 0
    refuse_unlike(path, "gyro", gyros[best], rates, step)
    return float(OFFSETS[best])


def mounting(attitude: Rotation, velocity: FloatArray, force: FloatArray) -> Rotation:
    """Return the rotation from the vehicle to its markers.

    :param attitude: of the markers, n.
    :param velocity: (n, 3), world frame, m/s.
    :param force: specific force, (n, 3), world frame, m/s².
    """
    inverse = attitude.inv()
    airspeed = inverse.apply(velocity)
    # Drag tilts the mean force of a flight whose mean velocity is not zero.
    causes = np.insert(airspeed, 0, 1.0, axis=1)
    fitted = np.linalg.lstsq(causes, inverse.apply(force), rcond=None)[0]
    x, y, z = fitted[0]
    return Rotation.from_rotvec([-y / z, x / z, 0.0])
