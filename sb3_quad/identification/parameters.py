"""The parameters of a vehicle that logs can tell, as a vector for least squares."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from sb3_quad.base.types import FloatArray, StrDict
from sb3_quad.envs.simulation.state import BODY_RATES
from sb3_quad.envs.vehicles.vehicle import LARGEST_STEP, MAX_PHYSICS_STEP, Vehicle
from sb3_quad.identification.curve import POWERS, Curve
from sb3_quad.identification.flight_log import Log

# Below this standard deviation of a body rate, its axis is not excited, rad/s.
LEAST_RATE = 0.05
FASTEST = LARGEST_STEP["exact"] / MAX_PHYSICS_STEP  # 1/s


class Term(NamedTuple):
    """A field of a vehicle, or ``curve`` or ``delay``."""

    unit: str
    axes: str = " "  #: of its elements
    # Limits, by the size of :func:`parameters_of`
    least: float = 0.0
    most: float = np.inf
    needs_motion: bool = False  #: whether body rates and specific force alone do not tell it
    needs_turns: bool = False


TERMS = {
    "curve": Term("N", least=-np.inf),
    "delay": Term("s"),
    "motor_gain_up": Term("1/s", least=0.08, most=12.0),
    "inertia": Term("kg m²", "xy", 0.08, 12.0, needs_turns=True),
    "moment_thrust_ratio": Term("m", "z", 0.08, 12.0, needs_turns=True),
    "drag": Term("N s/m", "xyz", needs_motion=True),
    "rotor_drag": Term("kg/rad", "xyz", needs_motion=True),
    "translational_lift": Term("kg/m", needs_motion=True),
    "airspeed_moment": Term("kg m/rad", "xy", -np.inf, needs_motion=True),
    # More would be the controller's damping, which the commands contain.
    "rate_damping": Term("N m s/rad", "xyz", most=3.0, needs_turns=True),
}


class Guess(NamedTuple):
    """A vehicle, and the effect of its commands."""

    vehicle: Vehicle  #: with the control step of the logs and no delay
    curve: Curve
    delay: float  #: from a command to its effect, s

    def numbers(self) -> dict[str, FloatArray]:
        """Return what may be fitted, by the fields of ``TERMS``, (elements,) each.

        Izz keeps its ratio to Ixx + Iyy.
        """
        numbers = {field: np.ravel(getattr(self.vehicle, field, ())) for field in TERMS}
        numbers["curve"] = self.curve.coefficients
        numbers["delay"] = np.array([self.delay])
        numbers["inertia"] = numbers["inertia"][:2]
        return numbers

    def vector(self) -> FloatArray:
        """Return these numbers one after the other."""
        return np.concatenate([*self.numbers().values()])

    def moved(self, vector: FloatArray) -> "Guess":
        """Return a guess with other numbers."""
        changes: StrDict = {}
        rest = vector.tolist()
        for field, before in self.numbers().items():
            changes[field] = rest[: len(before)]
            rest = rest[len(before) :]
        curve = Curve(self.curve.kind, np.array(changes.pop("curve")))
        (delay,) = changes.pop("delay")
        for field in ("motor_gain_up", "moment_thrust_ratio", "translational_lift"):
            (changes[field],) = changes[field]
        vehicle = self.vehicle
        ratio = sum(changes["inertia"]) / sum(vehicle.inertia[:2])
        changes["inertia"].append(ratio * vehicle.inertia[2])
        gain = changes.pop("motor_gain_up")
        if gain != vehicle.motor_gain_up:
            changes["motor_gain"] = min(gain, FASTEST)
        return Guess(vehicle.model_copy(update=changes), curve, delay)


def parameters_of(logs: Sequence[Log], guess: Guess) -> pd.DataFrame:
    """Return a table with a row for each number of the vector.

    Columns: field, name and unit; size, what changes the flight much, in this unit: the guess of
    what is positive, or what a typical vehicle has; least and most, limits by the size; and reason,
    why the logs do not tell it, or nothing if they may.
    """
    motion = np.concatenate([log.motion[log.flying] for log in logs])
    turns = motion[:, BODY_RATES].std(axis=0) > LEAST_RATE
    vehicle = guess.vehicle
    speeds = vehicle.hover_speed_sum
    sizes: dict[str, Any] = {
        "delay": 0.01,
        "drag": 0.3 * vehicle.mass,
        "rotor_drag": 0.3 * vehicle.mass / speeds,
        "translational_lift": 0.3 * vehicle.mass,
        "airspeed_moment": np.array(vehicle.inertia[:2]) * 10.0 / speeds,
        "rate_damping": np.array(vehicle.inertia) * 3.0,
    }
    if guess.curve.kind == "share":
        sizes["curve"] = vehicle.hover_thrust
    # Rotors turn with nearly the same mean speed all the time.
    other_drag = "drag" if any(vehicle.rotor_drag) else "rotor_drag"
    rows = []
    for field, numbers in guess.numbers().items():
        term = TERMS[field]
        for k, size in enumerate(np.broadcast_to(sizes.get(field, numbers), len(numbers))):
            axis = term.axes[k % len(term.axes)]
            reason = ""
            if term.needs_motion and not logs[0].has_motion:
                reason = "the logs hold no velocity"
            elif term.needs_turns and not turns["xyz".index(axis)]:
                reason = f"the flights hardly turn about {axis}"
            elif field == other_drag:
                reason = "the other kind of drag explains the same"
            elif field == "motor_gain_up" and guess.curve.kind == "rotor_speed":
                reason = "the logs hold the speeds themselves"
            name = field.removesuffix("_up")
            if len(numbers) > 1:
                name += f" {axis}"
            if field == "curve":
                name = f"thrust, {guess.curve.kind}^{POWERS[guess.curve.kind][k]}"
            most = term.most
            if field == "motor_gain_up":
                most = min(most, FASTEST / size)
            rows.append((field, name, term.unit, size, term.least, most, reason))
    columns = ["field", "name", "unit", "size", "least", "most", "reason"]
    return pd.DataFrame(rows, columns=columns)
