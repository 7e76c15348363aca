"""Layouts: a vehicle's order of rotors and body axes, and how one layout becomes another."""

import itertools
import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.types import FloatArray

if TYPE_CHECKING:
    from sb3_quad.vehicles.vehicle import Vehicle

# Rotors in the same place may differ by this angle, seen from the centre of mass.
TOLERANCE = math.radians(20.0)
# Angles that differ by less are equal, since published positions are rounded.
_SLACK = math.radians(1.0)
_EIGHTH = math.pi / 4


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

    Each comes to one with the same sign of its yaw moment. Of turns that fit equally well it is the
    smallest.

    :raises ConfigError: no turn does that.
    """
    # Places in the plane as complex numbers: a turn is a factor.
    places = np.dot(own.rotor_positions, (1.0, 1.0j))
    goals = np.dot(other.rotor_positions, (1.0, 1.0j))
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
