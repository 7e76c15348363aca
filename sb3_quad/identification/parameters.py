"""The parameters of a vehicle that logs can tell, as a vector for least squares."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from sb3_quad.base.types import FloatArray, StrDict
from sb3_quad.envs.simulation.state import BODY_RATES
from sb3_quad.envs.vehicles.vehicle import LARGEST_STEP, MAX_PHYSICS_STEP, Vehicle
from sb3_quad.identification.curve import Curve
from sb3_quad.identification.flight_log import Log

Key = tuple[str, int]
"""A field of the vehicle and the element of it, or ``curve`` or ``delay``."""
DELAY: Key = ("delay", 0)
AXES = ("x", "y", "z")
# Below this standard deviation of a body rate, its axis is not excited, rad/s.
LEAST_RATE = 0.05
# The most that the logarithm of a positive parameter may change
LARGEST_CHANGE = 2.5
LARGEST_DAMPING = 3.0  # times the typical one
FASTEST = LARGEST_STEP["exact"] / MAX_PHYSICS_STEP  # 1/s


class Guess(NamedTuple):
    """A vehicle, and the effect of its commands."""

    vehicle: Vehicle  #: with the control step of the logs and no delay
    curve: Curve
    delay: float  #: from a command to its effect, s


class Term(NamedTuple):
    """A field of a vehicle that is fitted."""

    field: str
    unit: str
    elements: Sequence[int] = (0,)
    #: what a typical vehicle has, times 1; 0 if the value is positive and its logarithm is fitted
    typical: str = ""
    needs_motion: bool = False  #: whether body rates and specific force alone do not tell it
    is_signed: bool = False


# A typical value is a product of these powers: of the mass, the moments of inertia, the speed of a
# rotor in hover, and a rate of 1 or some 1/s.
TERMS = (
    Term("motor_gain_up", "1/s"),
    Term("inertia", "kg m²", (0, 1)),
    Term("moment_thrust_ratio", "m"),
    Term("drag", "N s/m", (0, 1, 2), "mass", needs_motion=True),
    Term("rotor_drag", "kg/rad", (0, 1, 2), "mass_by_speed", needs_motion=True),
    Term("translational_lift", "kg/m", (0,), "mass", needs_motion=True),
    Term("airspeed_moment", "kg m/rad", (0, 1), "inertia_by_speed", True, is_signed=True),
    Term("rate_damping", "N m s/rad", (0, 1, 2), "inertia"),
)
ANY = Term("", "")
FIELDS = {term.field: term for term in TERMS if term.field in Vehicle.model_fields}


def typical(term: Term, vehicle: Vehicle, element: int) -> float:
    """Return the size that a linear parameter typically has, in its unit."""
    speeds = 4.0 * vehicle.hover_rotor_speed
    sizes = {
        "mass": 0.3 * vehicle.mass,
        "mass_by_speed": 0.3 * vehicle.mass / speeds,
        "inertia": 3.0 * vehicle.inertia[element],
        "inertia_by_speed": 10.0 * vehicle.inertia[element] / speeds,
    }
    return sizes[term.typical]


def keys_for(logs: Sequence[Log], start: Guess) -> tuple[list[Key], dict[Key, str]]:
    """Return the parameters to fit, and for others why the logs do not tell them."""
    keys: list[Key] = [("curve", k) for k in range(len(start.curve.coefficients))]
    keys.append(DELAY)
    held = {}
    for term in FIELDS.values():
        for element in term.elements:
            reason = _unknown(term, element, logs, start)
            if reason:
                held[term.field, element] = reason
            else:
                keys.append((term.field, element))
    return keys, held


def _unknown(term: Term, element: int, logs: Sequence[Log], start: Guess) -> str:
    """Return why logs do not tell a parameter; empty if they may."""
    if term.needs_motion and not all(log.has_motion for log in logs):
        return "the logs hold no velocity"
    if term.field == "motor_gain_up" and start.curve.kind == "rotor_speed":
        return "the logs hold the speeds themselves"
    # Rotors turn with nearly the same mean speed all the time.
    with_speed = any(getattr(start.vehicle, "rotor_drag", ()))
    if term.field == ("drag" if with_speed else "rotor_drag"):
        return "the other kind of drag explains the same"
    axis = 2 if term.field == "moment_thrust_ratio" else element
    if term.field in ("inertia", "moment_thrust_ratio", "rate_damping"):
        rates = np.concatenate([log.motion[log.flying, BODY_RATES] for log in logs])
        if rates[:, axis].std() < LEAST_RATE:
            return f"the flights hardly turn about {AXES[axis]}"
    return ""


def value(guess: Guess, key: Key) -> float:
    """Return a parameter."""
    field, element = key
    if field == "curve":
        return float(guess.curve.coefficients[element])
    if field == "delay":
        return guess.delay
    return float(np.ravel(getattr(guess.vehicle, field))[element])


def unit(key: Key, kind: str) -> str:
    """Return the unit of a parameter."""
    field, _ = key
    if field == "curve":
        return {"rotor_speed": "N s²", "thrust": "1"}.get(kind, "N")
    return "s" if field == "delay" else FIELDS[field].unit


class Scaling:
    """The vector of least squares: 0 at the start, about 1 for a large change.

    :param start: where it is 0.
    :param keys: its elements.
    """

    def __init__(self, start: Guess, keys: Sequence[Key]) -> None:
        self.start = start
        self.keys = keys
        self.begin = np.array([value(start, key) for key in keys])
        #: what changes a linear parameter by 1; 0 where the logarithm changes
        self.sizes = np.array([_size(start, key) for key in keys])
        signed = [key[0] == "curve" or FIELDS.get(key[0], ANY).is_signed for key in keys]
        low = np.where(signed, -np.inf, 0.0)
        linear = np.divide(low - self.begin, np.maximum(self.sizes, 1e-30))
        is_linear = self.sizes > 0.0
        self.least = np.where(is_linear, linear, -LARGEST_CHANGE) - 1e-9
        self.most = np.where(is_linear, np.inf, LARGEST_CHANGE)
        # More would be the controller's damping, which the commands contain.
        damped = [key[0] == "rate_damping" for key in keys]
        self.most[damped] = linear[damped] + LARGEST_DAMPING
        self.low = low
        self.high = np.array([FASTEST if key[0] == "motor_gain_up" else np.inf for key in keys])

    def values(self, vector: FloatArray) -> FloatArray:
        """Return the parameters of a vector, (keys,)."""
        logarithmic = self.begin * np.exp(np.clip(vector, -LARGEST_CHANGE, LARGEST_CHANGE))
        linear = self.begin + self.sizes * vector
        return np.clip(np.where(self.sizes > 0.0, linear, logarithmic), self.low, self.high)

    def widths(self, vector: FloatArray, widths: FloatArray) -> FloatArray:
        """Return widths of the parameters by those of the vector."""
        return np.where(self.sizes > 0.0, self.sizes, self.values(vector)) * widths

    def guess(self, vector: FloatArray) -> Guess:
        """Return what a vector means."""
        found = dict(zip(self.keys, self.values(vector).tolist(), strict=True))
        return with_values(self.start, found)


def _size(start: Guess, key: Key) -> float:
    """Return what changes a linear parameter much, in its unit; 0 for one that is positive."""
    field, element = key
    if field == "delay":
        return 0.01
    if field == "curve":
        coefficients = start.curve.coefficients
        return abs(coefficients[0]) if len(coefficients) == 1 else start.vehicle.hover_thrust
    return typical(FIELDS[field], start.vehicle, element) if FIELDS[field].typical else 0.0


def with_values(start: Guess, found: Mapping[Key, float]) -> Guess:
    """Return a guess with other values of some parameters.

    The third moment of inertia keeps its ratio to the sum of the others.
    """
    coefficients = start.curve.coefficients.copy()
    fields: dict[str, FloatArray] = {}
    delay = start.delay
    for (field, element), number in found.items():
        if field == "curve":
            coefficients[element] = number
        elif field == "delay":
            delay = number
        else:
            default = np.array(getattr(start.vehicle, field), float)
            np.atleast_1d(fields.setdefault(field, np.atleast_1d(default)))[element] = number
    if "inertia" in fields:
        before = start.vehicle.inertia
        inertia = fields["inertia"]
        inertia[2] = before[2] * inertia[:2].sum() / sum(before[:2])
    changes: StrDict = {}
    for field, numbers in fields.items():
        is_number = np.ndim(getattr(start.vehicle, field)) == 0
        changes[field] = float(numbers[0]) if is_number else tuple(numbers.tolist())
    if "motor_gain_up" in changes:
        changes["motor_gain"] = changes.pop("motor_gain_up")
    vehicle = start.vehicle.model_copy(update=changes) if changes else start.vehicle
    return Guess(vehicle, start.curve._replace(coefficients=coefficients), delay)
