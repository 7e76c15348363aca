"""The thrust of a motor over its command, and the response of the vehicle to it, by regression."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.imports import require
from sb3_quad.base.types import FloatArray
from sb3_quad.envs.simulation.state import QUATERNION, VELOCITY, rotation_matrices
from sb3_quad.envs.vehicles.layout import ORDERS
from sb3_quad.envs.vehicles.vehicle import Vehicle
from sb3_quad.identification.flight_log import Log

# The powers of a command that its thrust consists of, by the kind of the command
POWERS = {"thrust": (1,), "rotor_speed": (2,), "share": (0, 1, 2)}


class Curve(NamedTuple):
    """Thrust of a motor over its command."""

    kind: str  #: of the command, a key of ``POWERS``
    coefficients: FloatArray  #: of the powers, N

    def thrust(self, commands: FloatArray) -> FloatArray:
        """Return thrusts, N, of commands of any shape."""
        return np.asarray(powers(self.kind, commands) @ self.coefficients)


def powers(kind: str, commands: FloatArray) -> FloatArray:
    """Return the powers of commands that their thrusts consist of, along a new last axis."""
    return np.stack([commands**power for power in POWERS[kind]], axis=-1)


def one_kind(logs: Sequence[Log]) -> str:
    """Return the kind of the commands of logs.

    :raises ConfigError: they have different ones.
    """
    kinds = {log.kind: log.path for log in logs}
    if len(kinds) > 1:
        named = ", ".join(f"{path}: {kind}" for kind, path in kinds.items())
        raise ConfigError(f"logs whose commands differ cannot be taken together ({named})")
    return logs[0].kind


def specific_force(log: Log) -> FloatArray:
    """Return the specific force along z, (n,), m/s²: the accelerometer's, or what follows from the
    motion.
    """
    if log.force is not None:
        return log.force
    force = np.gradient(log.motion[:, VELOCITY], log.step, axis=0)
    force[:, 2] += 9.81
    upward = rotation_matrices(log.motion[:, QUATERNION])[:, :, 2]
    return np.asarray((force * upward).sum(axis=1))


def lagged(values: FloatArray, gain: float, step: float) -> FloatArray:
    """Return the response of a first-order lag to values, (n, columns), that begins at rest."""
    signal = require("scipy.signal", "fit", "the thrust of motors over their commands")
    kept = np.exp(-gain * step)
    ba = [1.0 - kept], [1.0, -kept]
    begin = signal.lfilter_zi(*ba)[:, None] * values[:1]
    return np.asarray(signal.lfilter(*ba, values, axis=0, zi=begin)[0])


def fit_curve(logs: Sequence[Log], vehicle: Vehicle) -> Curve:
    """Return the curve of commands in N, or else the one that fits what carries the vehicle.

    Its motors have the lag and the delay of the vehicle.
    """
    if one_kind(logs) == "thrust":
        return Curve("thrust", np.ones(1))
    return regress(logs, vehicle, vehicle.motor_gain_up, vehicle.delay * vehicle.control_step)[0]


def regress(
    logs: Sequence[Log], vehicle: Vehicle, gain: float, delay: float
) -> tuple[Curve, float]:
    """Fit the curve for motors with a lag and a delay to the specific force along z.

    It adds the thrust of the air that flows past (least squares over all flights).

    :return: the curve, and the root mean square of the rest, m/s².
    """
    kind = one_kind(logs)
    regressors = []
    forces = []
    for log in logs:
        commands = log.mean_commands(delay)
        terms = powers(kind, np.nan_to_num(commands)).sum(axis=1)
        slow = lagged(terms, gain, log.step)
        # A row's command acts until the next one, where the force of that row is.
        regressors.append(slow[:-1][log.flying[1:]] / vehicle.mass)
        forces.append(specific_force(log)[1:][log.flying[1:]])
    left = np.concatenate(regressors)
    right = np.concatenate(forces)
    # Hardly excited powers must not be taken for large numbers that cancel each other.
    scale = np.linalg.norm(left, axis=0)
    coefficients = np.linalg.lstsq(left / scale, right, rcond=1e-4)[0] / scale
    rest = right - left @ coefficients
    return Curve(kind, coefficients), float(np.sqrt(np.mean(rest**2)))


def refuse_other_order(log: Log, vehicle: Vehicle, thrusts: FloatArray) -> None:
    """Refuse a log whose rotors turn the vehicle otherwise than its file says.

    :param thrusts: commanded, in the vehicle's order, (n, 4), N.
    :raises ConfigError: with the axis that answers the wrong way, and an order that would fit.
    """
    agreement = _agreement(log, vehicle.mixer, thrusts)
    wrong = [
        axis
        for axis, value in zip(("roll", "pitch", "yaw"), agreement, strict=True)
        if value < -0.25
    ]
    if not wrong:
        return
    hints = []
    for name, order in ORDERS.items():
        other = [order.index(place) for place in ORDERS[log.order or "crazyflie"]]
        if (_agreement(log, vehicle.mixer, thrusts[:, np.argsort(other)]) > 0.0).all():
            hints.append(f"the order of {name}")
    if wrong == ["yaw"]:
        hints = ["props that turn the other way (rotor_directions)"]
    advice = f"{hints[0]} would fit" if hints else "check axes, signs and the order of the motors"
    raise ConfigError(
        f"{log.path}: {' and '.join(wrong)} answer{'s' * (len(wrong) == 1)} its motors the wrong "
        f"way for {vehicle.name}: {advice}"
    )


def _agreement(log: Log, mixer: FloatArray, thrusts: FloatArray) -> FloatArray:
    """Return the correlation of body accelerations with moments about each axis, (3,), for that lag
    up to 0.1 s where it is largest.
    """
    moments = lagged(np.nan_to_num(thrusts), 30.0, log.step) @ mixer[1:].T
    near = max(round(0.02 / log.step), 1)
    rates = log.motion[:, -3:]
    found = []
    for lag in range(0, round(0.1 / log.step), near):
        turned = rates[lag + near :] - rates[lag:-near]
        count = len(turned)
        rows = log.flying[:count]
        pairs = zip(turned[rows].T, moments[:count][rows].T, strict=True)
        found.append([np.corrcoef(*pair)[0, 1] for pair in pairs])
    best = np.array(found)
    return best[np.abs(best).argmax(axis=0), range(3)]
