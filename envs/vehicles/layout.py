"""Layouts: a vehicle's order of rotors and body axes, and how one layout becomes another."""

import itertools
import math
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple

import numpy as np
from pydantic import Field

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.types import FloatArray, StrDict
from sb3_quad.base.validate import Frozen, Quantity

if TYPE_CHECKING:
    from sb3_quad.envs.vehicles.vehicle import Vehicle

# Rotors count as in the same place up to this angle, seen from the middle of the rotors.
TOLERANCE = math.radians(20.0)
# Angles that differ by less count as equal, since published positions are rounded.
_SLACK = math.radians(1.0)
_EIGHTH = math.pi / 4
# Signs of x and y
FRONT_LEFT = (1, 1)
FRONT_RIGHT = (1, -1)
REAR_LEFT = (-1, 1)
REAR_RIGHT = (-1, -1)
ORDERS = {
    "betaflight": (REAR_RIGHT, FRONT_RIGHT, REAR_LEFT, FRONT_LEFT),
    "px4": (FRONT_RIGHT, REAR_LEFT, FRONT_LEFT, REAR_RIGHT),
    "ardupilot": (FRONT_RIGHT, REAR_LEFT, FRONT_LEFT, REAR_RIGHT),
    "crazyflie": (FRONT_RIGHT, REAR_RIGHT, REAR_LEFT, FRONT_LEFT),
}
"""Places of motors 1 to 4 of an X by flight stack; sources in docs/vehicles.md."""


class NamedLayout(Frozen):
    """The rotors of an X, numbered as a flight stack numbers them."""

    rotor_order: Literal["betaflight", "px4", "ardupilot", "crazyflie"]
    """the flight stack whose motors 1 to 4 these are"""
    props: Literal["in", "out"] = "in"
    """in: the front left rotor turns clockwise seen from above, as all four have it; out: not"""
    arm_length: Quantity
    """from the middle of the rotors to each, m"""
    arm_angle: Annotated[float, Field(gt=0.0, lt=90.0)] = 45.0
    """from forward to the front arms, degrees; above 45 the rotors are farther apart in width than
    in length
    """
    center_of_mass: tuple[float, float] = (0.0, 0.0)
    """x and y of the centre of mass from the middle of the rotors, m: [-0.01, 0] is behind it"""

    def rotors(self) -> StrDict:
        """Return ``rotor_positions`` and ``rotor_directions`` of a vehicle."""
        angle = math.radians(self.arm_angle)
        signs = np.array(ORDERS[self.rotor_order])
        arm = self.arm_length * np.array([math.cos(angle), math.sin(angle)])
        # A rotor that turns clockwise turns the body anticlockwise, which is positive.
        clockwise = 1 if self.props == "in" else -1
        return {
            "rotor_positions": (signs * arm - self.center_of_mass).tolist(),
            "rotor_directions": (clockwise * signs.prod(axis=1)).tolist(),
        }


class Turn(NamedTuple):
    """From a vehicle's own axes and rotors to those of a layout."""

    angle: float = 0.0
    """Angle by which the vectors of the body turn about z, rad."""
    order: tuple[int, ...] = (0, 1, 2, 3)
    """Rotor k of the layout is the vehicle's rotor ``order[k]``."""

    @property
    def axes(self) -> FloatArray:
        """Rotation from the own body frame to the layout's, (3, 3)."""
        cosine = math.cos(self.angle)
        sine = math.sin(self.angle)
        return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])

    @property
    def own(self) -> list[int]:
        """Rotor k of the vehicle is the layout's rotor ``own[k]``."""
        return [self.order.index(k) for k in range(4)]


def find_turn(own: "Vehicle", other: "Vehicle") -> Turn:
    """Return the turn that brings the rotors of a vehicle to where those of another are.

    Each rotor comes to one with the same sign of its yaw moment. Among turns that fit equally well,
    this is the smallest.

    :raises ConfigError: no turn does that.
    """
    # Places in the plane, seen from their middle, as complex numbers: a turn is a factor.
    places = np.dot(own.rotor_positions, (1.0, 1.0j))
    places = places - places.mean()
    goals = np.dot(other.rotor_positions, (1.0, 1.0j))
    goals = goals - goals.mean()
    fits = {}
    for order in itertools.permutations(range(4)):
        if tuple(own.rotor_directions[k] for k in order) != other.rotor_directions:
            continue
        between = np.exp(1j * np.angle(goals * places[[*order]].conj()))
        angle = float(np.angle(between.sum()))
        misfit = np.abs(np.angle(between * np.exp(-1j * angle))).max()
        eighth = round(angle / _EIGHTH) * _EIGHTH
        if abs(angle - eighth) < _SLACK:
            angle = eighth
        fits[Turn(angle, order)] = float(misfit)
    least = min(fits.values())
    if least >= TOLERANCE:
        raise ConfigError(
            "rotor_layout: rotor layouts are incompatible: no yaw rotation and renumbering maps"
            f" the rotors of {own.name} (position and spin direction) onto those of {other.name}"
        )
    fitting = [turn for turn, misfit in fits.items() if misfit < least + _SLACK]
    return min(fitting, key=lambda turn: (round(abs(turn.angle), 6), -turn.angle))
