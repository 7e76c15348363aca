"""What no log of a flight shows: wrong units, axes or signs, and motors that rest."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.ndimage import binary_dilation, uniform_filter1d

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.types import BoolArray, FloatArray
from sb3_quad.envs.simulation.state import BODY_RATES
from sb3_quad.envs.vehicles.vehicle import GRAVITY
from sb3_quad.identification.flight_log import Log

# Where the height is unknown, a vehicle flies while its motors get this share of their usual
# command, and not within this time of a start or landing, s.
FLYING_SHARE = 0.55
NEAR_GROUND = 0.5
# The least that a log needs: rotors that spin up, and the longest horizon, s
LEAST_DURATION = 1.0
# Below this, m/s or rad/s, velocities and rates are noise
LEAST_MOTION = 0.2
# Products of what is measured and what it should be, by the squares of the larger one
LEAST_AGREEMENT = 0.1
AVERAGED = 0.1  # s
# Mean commands in flight: N, rad/s, and a part of the full command
LIKELY = {"thrust": (1e-3, 1e3), "rotor_speed": (50.0, 1e4), "share": (0.05, 1.0)}
# Beyond these, single commands are glitches
LARGEST_COMMANDS = {"thrust": 2e3, "rotor_speed": 2e4}
MOST_RATE = 100.0  # rad/s, beyond what gyros measure


def refuse_unlike(
    path: Path, what: str, measured: FloatArray, other: FloatArray, step: float
) -> None:
    """Refuse columns (n, 3) that have another unit, sign or axis than what others say.

    :raises ConfigError: the message names the column.
    """
    # What follows from positions and attitudes is noisy.
    rows = round(AVERAGED / step)
    own = uniform_filter1d(measured, rows, axis=0)
    expected = uniform_filter1d(other, rows, axis=0)
    larger = np.maximum((own**2).sum(axis=0), (expected**2).sum(axis=0))
    agrees = (own * expected).sum(axis=0) >= LEAST_AGREEMENT * larger
    moves = larger > len(own) * LEAST_MOTION**2
    for axis in np.flatnonzero(moves & ~agrees):
        raise ConfigError(
            f"{path}: {what} {'xyz'[axis]} contradicts the motion; check units, axes and the order "
            "of columns"
        )


def in_the_air(log: Log, knows_height: bool) -> Log:
    """Return a log whose rows count only in the air.

    :raises ConfigError: a motor gets nothing; its accelerometer shows other than gravity.
    """
    commands = log.mean_commands()
    flying = log.flying
    if not knows_height:
        flying &= _well_above_ground(commands.mean(axis=1), log.step)
    if flying.sum() * log.step < LEAST_DURATION:
        return replace(log, flying=np.zeros_like(flying))
    means = commands[flying].mean(axis=0)
    low, high = LIKELY[log.kind]
    for motor in np.flatnonzero((means < low) | (means > high)):
        raise ConfigError(
            f"{log.path}: motor M{motor + 1} gets {means[motor]:.3g} on average as {log.kind}, "
            f"where {low:g} to {high:g} is likely; check its unit"
        )
    mean_force = log.force[flying, 2].mean()
    if not 0.6 * GRAVITY < mean_force < 1.6 * GRAVITY:
        raise ConfigError(
            f"{log.path}: the accelerometer shows {mean_force:.3g} m/s² along z in flight, "
            f"where {GRAVITY:g} is likely; check its unit, axes and sign"
        )
    fastest = np.abs(log.motion[flying, BODY_RATES]).max()
    if fastest > MOST_RATE:
        raise ConfigError(f"{log.path}: the gyro shows {fastest:.3g} rad/s; check its unit")
    return log


def _well_above_ground(mean: FloatArray, step: float) -> BoolArray:
    """Whether the mean commands of rows, (n,), are those of flight, and so are those near them."""
    top = mean.max()
    usual = np.quantile(mean[mean >= min(0.2 * top, top)], 0.7)
    is_low = mean <= FLYING_SHARE * usual
    near = binary_dilation(is_low, iterations=round(NEAR_GROUND / step))
    return np.asarray(~near)
