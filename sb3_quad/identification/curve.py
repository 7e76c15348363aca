"""The thrust of a motor over its command, and the response of the vehicle to it, by regression."""

from collections.abc import Sequence
from itertools import permutations
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.types import FloatArray
from sb3_quad.envs.simulation.state import BODY_RATES
from sb3_quad.envs.vehicles.vehicle import Vehicle
from sb3_quad.identification.flight_log import Log

# The powers of a command that its thrust consists of, by the kind of the command
POWERS = {"thrust": (1,), "rotor_speed": (2,), "share": (0, 1, 2)}
# The sum of three correlations that speaks for another order
LEAST_BETTER = 0.25


class Curve(NamedTuple):
    """Thrust of a motor over its command."""

    kind: str  #: of the command, a key of ``POWERS``
    coefficients: FloatArray  #: of the powers, N

    def thrust(self, commands: FloatArray) -> FloatArray:
        """Return thrusts, N, of commands of any shape."""
        terms = powers(self.kind, commands)
        return np.asarray(terms @ self.coefficients)


def powers(kind: str, commands: FloatArray) -> FloatArray:
    """Return the powers of commands that their thrusts consist of, along a new last axis."""
    terms = [commands**power for power in POWERS[kind]]
    return np.stack(terms, axis=-1)


def lagged(values: FloatArray, gain: float, step: float) -> FloatArray:
    """Return the response of a first-order lag to values, (n, columns), that begins at rest."""
    kept = np.exp(-gain * step)
    begin = kept * values[:1]
    response: FloatArray
    response, _ = lfilter([1.0 - kept], [1.0, -kept], values, axis=0, zi=begin)
    return response


def fit_curve(logs: Sequence[Log], vehicle: Vehicle) -> Curve:
    """Return the curve of commands in N, or else the one that fits what carries the vehicle.

    Its motors have the lag and the delay of the vehicle.
    """
    if logs[0].kind == "thrust":
        return Curve("thrust", np.ones(1))
    delay = vehicle.delay * vehicle.control_step
    curve, _ = regress(logs, vehicle, vehicle.motor_gain_up, delay)
    return curve


def regress(
    logs: Sequence[Log], vehicle: Vehicle, gain: float, delay: float
) -> tuple[Curve, float]:
    """Fit the curve for motors with a lag and a delay to the specific force along z (least squares
    over all flights).

    :return: the curve, and the root mean square of the rest, m/s².
    """
    kind = logs[0].kind
    regressors = []
    forces = []
    for log in logs:
        terms = powers(kind, log.mean_commands(delay)).sum(axis=1)
        response = lagged(terms, gain, log.step)
        # A row's command acts until the next one, where the force of that row is.
        rows = np.flatnonzero(log.flying[1:])
        regressors.append(response[rows] / vehicle.mass)
        forces.append(log.force[rows + 1, 2])
    left = np.concatenate(regressors)
    right = np.concatenate(forces)
    # Hardly excited powers must not be taken for large numbers that cancel each other.
    scale = np.linalg.norm(left, axis=0)
    coefficients = np.linalg.lstsq(left / scale, right, rcond=1e-4)[0] / scale
    return Curve(kind, coefficients), float(np.std(right - left @ coefficients))


def refuse_other_order(logs: Sequence[Log], vehicle: Vehicle, thrusts: FloatArray) -> None:
    """Refuse logs that turn as with rotors in another order, or props that turn the other way.

    In a calm flight, the controller's answer to a turn hides what the motors do, so the liveliest
    one counts most.

    :param thrusts: commanded, of all rows of all logs, in the vehicle's order, (n, 4), N.
    :raises ConfigError: with the axes that answer otherwise, and the order that fits.
    """
    orders = [*permutations(range(4))]
    agreements = [_agreement(logs, vehicle, thrusts[:, order]) for order in orders]
    both = np.vstack([agreements, agreements * np.array([1.0, 1.0, -1.0])])
    best = both.sum(axis=1).argmax()
    better = both[best] - both[0]
    if better.sum() < LEAST_BETTER:
        return
    named = [("roll", "pitch", "yaw")[axis] for axis in np.flatnonzero(better > 0.1)]
    turned, best = divmod(best, len(orders))
    order = [motor + 1 for motor in orders[best]]
    props = ""
    if turned:
        props = ", with props that turn the other way (rotor_directions)"
    raise ConfigError(
        f"{logs[0].path}: {' and '.join(named)}: the motors of {vehicle.name} turn it otherwise; "
        f"the log fits its motors in the order {order}{props}; check axes and signs, too"
    )


def _agreement(logs: Sequence[Log], vehicle: Vehicle, thrusts: FloatArray) -> FloatArray:
    """Return the correlation of body accelerations with moments about each axis, (3,), for that lag
    up to 0.1 s where it is largest; 0 where nothing changes.
    """
    step = logs[0].step
    flying = np.concatenate([log.flying for log in logs])
    rates = np.concatenate([log.motion[:, BODY_RATES] for log in logs])
    moments = lagged(thrusts, 30.0, step) @ vehicle.mixer[1:].T
    near = max(round(0.02 / step), 1)
    turned = np.roll(rates, -near, axis=0) - rates
    correlations = []
    for lag in range(0, 5 * near, near):
        later = np.roll(turned, -lag, axis=0)
        both = np.hstack([later, moments])[flying]
        with np.errstate(divide="ignore", invalid="ignore"):
            matrix = np.corrcoef(both.T)
        correlations.append(np.diagonal(matrix, 3))
    known = np.nan_to_num(correlations)
    largest = np.abs(known).argmax(axis=0)
    return np.asarray(known[largest, range(3)])
