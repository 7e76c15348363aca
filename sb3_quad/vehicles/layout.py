"""Layouts: the order of a vehicle's rotors and its body axes, and the turn from one layout to
another.
"""

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sb3_quad.base.arrays import FloatArray

# Rotors in the same place may differ by this angle, seen from the centre of mass.
TOLERANCE = math.radians(20.0)
# Angles that differ by less are taken for equal, since published positions are rounded.
_SLACK = math.radians(1.0)


class Turn(NamedTuple):
    """From a vehicle's own axes and rotors to those of a layout.

    :param angle: rad, about z. Components of a body vector are rotated by it.
    :param order: rotor k of the layout is the vehicle's rotor ``order[k]``.
    """

    angle: float = 0.0
    order: tuple[int, ...] = (0, 1, 2, 3)

    @property
    def axes(self) -> FloatArray:
        """Rotation matrix (3, 3) from the own body frame to the layout's."""
        cosine, sine = math.cos(self.angle), math.sin(self.angle)
        return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])

    @property
    def own(self) -> list[int]:
        """The inverse of ``order``: rotor k of the vehicle is the layout's rotor ``own[k]``."""
        return [self.order.index(k) for k in range(4)]


def find_turn(
    ours: npt.ArrayLike,
    our_directions: Sequence[int],
    theirs: npt.ArrayLike,
    their_directions: Sequence[int],
) -> Turn | None:
    """Return the turn that maps rotors onto others, each onto one with the same spin direction.

    Of turns that fit equally well it is the smallest. None if no turn does within ``TOLERANCE``.

    :param ours: x, y of each rotor, (4, 2), m; ``theirs`` likewise.
    :param our_directions: sign of the yaw moment of each rotor; ``their_directions`` likewise.
    """
    # As complex numbers, whose arguments are the rotors' directions from the centre of mass.
    places = np.asarray(ours) @ (1.0, 1.0j)
    goals = np.asarray(theirs) @ (1.0, 1.0j)
    candidates: list[tuple[float, Turn]] = []
    for order in itertools.permutations(range(4)):
        if [our_directions[k] for k in order] != list(their_directions):
            continue
        # The mean turn of the four rotors, and the largest deviation from it.
        turns = np.exp(1j * np.angle(goals * places[list(order)].conj()))
        angle = float(np.angle(turns.sum()))
        misfit = float(np.abs(np.angle(turns * np.exp(-1j * angle))).max())
        eighth = round(angle / (math.pi / 4)) * (math.pi / 4)
        if abs(angle - eighth) < _SLACK:
            angle = eighth
        candidates.append((misfit, Turn(angle, order)))
    least = min(misfit for misfit, _ in candidates)
    if least >= TOLERANCE:
        return None
    fitting = [turn for misfit, turn in candidates if misfit < least + _SLACK]
    return min(fitting, key=lambda turn: (round(abs(turn.angle), 6), -turn.angle))
