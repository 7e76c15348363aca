"""The parameters of a vehicle that logs can tell, as a vector for least squares."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from sb3_quad.base.types import FloatArray
from sb3_quad.envs.simulation.state import BODY_RATES
from sb3_quad.envs.vehicles.vehicle import LARGEST_STEP, MAX_PHYSICS_STEP, Vehicle
from sb3_quad.identification.curve import Curve
from sb3_quad.identification.flight_log import Log

# Below this standard deviation of a body rate, its axis is not excited, rad/s.
LEAST_RATE = 0.05
FASTEST = LARGEST_STEP["exact"] / MAX_PHYSICS_STEP  # 1/s


class Term(NamedTuple):
    """A field of a vehicle, or ``curve`` or ``delay``."""

    unit: str
    axes: str = ""  #: of its elements
    needs_motion: bool = False  #: whether body rates and specific force alone do not tell it
    # Limits in the vector
    least: float = 0.0
    most: float = np.inf


TERMS = {
    "curve": Term("N", least=-np.inf),
    "delay": Term("s"),
    "motor_gain_up": Term("1/s", least=0.08, most=12.0),
    "inertia": Term("kg m²", "xy", least=0.08, most=12.0),
    "moment_thrust_ratio": Term("m", least=0.08, most=12.0),
    "drag": Term("N s/m", "xyz", needs_motion=True),
    "rotor_drag": Term("kg/rad", "xyz", needs_motion=True),
    "translational_lift": Term("kg/m", needs_motion=True),
    "airspeed_moment": Term("kg m/rad", "xy", needs_motion=True, least=-np.inf),
    # More would be the controller's damping, which the commands contain.
    "rate_damping": Term("N m s/rad", "xyz", most=3.0),
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
        found = {field: np.ravel(getattr(self.vehicle, field, ())) for field in TERMS}
        found["curve"] = self.curve.coefficients
        found["delay"] = np.array([self.delay])
        found["inertia"] = found["inertia"][:2]
        return found

    def vector(self) -> FloatArray:
        """Return these numbers one after the other."""
        return np.concatenate([*self.numbers().values()])

    def sizes(self) -> FloatArray:
        """Return what changes the flight much: the start of what is positive, or what a typical
        vehicle has; in the order of the vector, and in its units.
        """
        vehicle = self.vehicle
        numbers = self.numbers()
        speeds = vehicle.hover_speed_sum
        inertia = np.array(vehicle.inertia)
        sizes: dict[str, Any] = {
            "delay": 0.01,
            "drag": 0.3 * vehicle.mass,
            "rotor_drag": 0.3 * vehicle.mass / speeds,
            "translational_lift": 0.3 * vehicle.mass,
            "airspeed_moment": 10.0 * inertia[:2] / speeds,
            "rate_damping": 3.0 * inertia,
        }
        if self.curve.kind == "share":
            sizes["curve"] = vehicle.hover_thrust
        found = [np.broadcast_to(sizes.get(f, numbers[f]), len(numbers[f])) for f in numbers]
        return np.concatenate(found)

    def moved(self, vector: FloatArray) -> "Guess":
        """Return a guess with other numbers."""
        numbers = self.numbers()
        ends = np.cumsum([len(one) for one in numbers.values()])
        parts = dict(zip(numbers, np.split(vector, ends[:-1]), strict=True))
        curve = Curve(self.curve.kind, parts.pop("curve"))
        delay = float(parts.pop("delay")[0])
        changes: dict[str, Any] = {}
        for field, values in parts.items():
            changes[field] = values.tolist() if len(values) > 1 else float(values[0])
        *before, third = self.vehicle.inertia
        changes["inertia"].append(third * sum(changes["inertia"]) / sum(before))
        changes["motor_gain"] = min(changes.pop("motor_gain_up"), FASTEST)
        return Guess(self.vehicle.model_copy(update=changes), curve, delay)


def keys_for(logs: Sequence[Log], start: Guess) -> dict[tuple[str, int], str]:
    """Return the field and element of each number of the vector, and why logs do not tell it; an
    empty text if they may.
    """
    has_motion = all(log.has_motion for log in logs)
    motion = np.concatenate([log.motion[log.flying] for log in logs])
    turns = motion[:, BODY_RATES].std(axis=0) > LEAST_RATE
    # Rotors turn with nearly the same mean speed all the time.
    other_drag = "drag" if any(start.vehicle.rotor_drag) else "rotor_drag"
    reasons = {}
    for field, values in start.numbers().items():
        for element in range(len(values)):
            axis = 2 if field == "moment_thrust_ratio" else element
            reason = ""
            if TERMS[field].needs_motion and not has_motion:
                reason = "the logs hold no velocity"
            elif field == "motor_gain_up" and start.curve.kind == "rotor_speed":
                reason = "the logs hold the speeds themselves"
            elif field == other_drag:
                reason = "the other kind of drag explains the same"
            elif field in ("inertia", "moment_thrust_ratio", "rate_damping") and not turns[axis]:
                reason = f"the flights hardly turn about {'xyz'[axis]}"
            reasons[field, element] = reason
    return reasons
