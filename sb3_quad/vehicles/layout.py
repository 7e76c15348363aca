"""Layouts: the order of a vehicle's rotors and its body axes, and how those of one vehicle become
those of another.
"""

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sb3_quad.base.arrays import FloatArray

TOLERANCE = math.radians(
    20.0
)  # by which rotors in the same place may differ, seen from the centre of mass
_SLACK = math.radians(
    1.0
)  # of angles that are taken for equal, since published positions are rounded


class Turn(NamedTuple):
    """From a vehicle's own axes and rotors to those of a layout.

    :param angle: of the body axes about z, rad: a vector of the body is turned by it.
    :param order: rotor k of the layout is the vehicle's rotor ``order[k]``.
    """

    angle: float = 0.0
    order: tuple[int, ...] = (0, 1, 2, 3)

    @property
    def axes(self) -> FloatArray:
        """(3, 3), from the own body frame to the layout's."""
        cosine, sine = math.cos(self.angle), math.sin(self.angle)
        return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])

    @property
    def own(self) -> list[int]:
        """Rotor k of the vehicle is the layout's rotor ``own[k]``."""
        return [self.order.index(k) for k in range(4)]


def find_turn(
    ours: npt.ArrayLike,
    our_directions: Sequence[int],
    theirs: npt.ArrayLike,
    their_directions: Sequence[int],
) -> Turn | None:
    """The turn that brings rotors to where others are, each to one with the same sign of its yaw
    moment; None: there is none.

    Of turns that fit equally well it is the smallest.

    :param ours: x, y of each rotor, (4, 2), m; ``theirs`` likewise.
    """
    places, goals = (np.asarray(each) @ (1.0, 1.0j) for each in (ours, theirs))
    found: list[tuple[float, Turn]] = []
    for order in itertools.permutations(range(4)):
        if [our_directions[k] for k in order] != [*their_directions]:
            continue
        apart = np.exp(1j * np.angle(goals * places[[*order]].conj()))
        angle = float(np.angle(apart.sum()))
        misfit = float(np.abs(np.angle(apart * np.exp(-1j * angle))).max())
        eighth = round(angle / (math.pi / 4)) * (math.pi / 4)
        found.append((misfit, Turn(eighth if abs(angle - eighth) < _SLACK else angle, order)))
    least = min(misfit for misfit, _ in found)
    fitting = [turn for misfit, turn in found if misfit < least + _SLACK]
    return (
        min(fitting, key=lambda turn: (round(abs(turn.angle), 6), -turn.angle))
        if least < TOLERANCE
        else None
    )
