"""The shapes that vehicles, targets and arrows are drawn with: PyBullet bodies that have no mass
and touch nothing. Each has its own unit of length.
"""

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from sb3_quad.base.types import FloatArray
from sb3_quad.envs.rendering.bullet_client import p
from sb3_quad.envs.rendering.window import Client
from sb3_quad.envs.vehicles.vehicle import Vehicle

Vector: TypeAlias = tuple[float, float, float]
Colour: TypeAlias = tuple[float, float, float, float]

DARK = (0.13, 0.14, 0.17, 1.0)
GREY = (0.55, 0.58, 0.62, 1.0)
FRONT = (0.93, 0.32, 0.10, 1.0)
WHITE = (0.92, 0.93, 0.95, 1.0)
NOWHERE = (0.0, 0.0, -1000.0)


class Part(NamedTuple):
    """A part of a body: a cylinder along z, or a box (half its sides).

    The angles are roll, pitch and yaw, rad.
    """

    shape: int
    at: Vector
    radius: float = 0.0
    length: float = 0.0
    box: Vector = (0.0, 0.0, 0.0)
    angles: Vector = (0.0, 0.0, 0.0)


def add_body(client: Client, parts: Sequence[Part], unit: float, colour: Colour) -> int:
    """Add a body of at most 16 parts, out of sight; return its number.

    :param unit: unit of the parts' lengths, m.
    """
    shapes, *sizes, angles = zip(*parts, strict=True)
    # PyBullet takes lists only; tuples crash it.
    places, radii, lengths, boxes = (np.multiply(size, unit).tolist() for size in sizes)
    shape = client.createVisualShapeArray(
        shapeTypes=list(shapes),
        halfExtents=boxes,
        radii=radii,
        lengths=lengths,
        rgbaColors=[colour] * len(parts),
        visualFramePositions=places,
        visualFrameOrientations=list(map(p.getQuaternionFromEuler, angles)),
    )
    return int(client.createMultiBody(0.0, -1, shape, NOWHERE))


def rotor_radius(vehicle: Vehicle) -> float:
    """Return the radius at which neighbouring rotors are drawn just clear of each other, m."""
    pairs = itertools.combinations(vehicle.rotor_positions, 2)
    return 0.44 * min(itertools.starmap(math.dist, pairs))


def frame(places: FloatArray) -> dict[Colour, list[Part]]:
    """Return the parts of a vehicle without its rotors, by colour: a body in PyBullet's window can
    have only one. The unit is the arm.

    :param places: positions of the rotors, (4, 2).
    """
    parts = {
        DARK: [Part(p.GEOM_CYLINDER, (0.0, 0.0, 0.02), 0.30, 0.14)],
        GREY: [Part(p.GEOM_BOX, (-0.02, 0.0, -0.10), box=(0.17, 0.10, 0.06))],
        FRONT: [],
    }
    for x, y in places:
        # A beam from the middle to the rotor, and a motor below it.
        middle = (x / 2, y / 2, 0.02)
        beam = (math.hypot(x, y) / 2, 0.045, 0.03)
        colour = FRONT if x > 0 else DARK
        parts[colour].append(
            Part(p.GEOM_BOX, middle, box=beam, angles=(0.0, 0.0, math.atan2(y, x)))
        )
        parts[GREY].append(Part(p.GEOM_CYLINDER, (x, y, 0.08), 0.09, 0.15))
    return parts


def rotor() -> list[Part]:
    """Return a hub and two pitched blades in the plane z = 0. The unit is their radius."""
    return [
        Part(p.GEOM_CYLINDER, (0.0, 0.0, 0.0), 0.09, 0.16),
        Part(p.GEOM_BOX, (0.47, 0.0, 0.0), box=(0.47, 0.075, 0.01), angles=(0.25, 0.0, 0.0)),
        Part(p.GEOM_BOX, (-0.47, 0.0, 0.0), box=(0.47, 0.075, 0.01), angles=(-0.25, 0.0, 0.0)),
    ]


def arrow() -> list[Part]:
    """Return an arrow along +z from the origin; its head has three steps. The unit is its
    length.
    """
    return [
        Part(p.GEOM_CYLINDER, (0.0, 0.0, 0.35), 0.027, 0.7),
        Part(p.GEOM_CYLINDER, (0.0, 0.0, 0.75), 0.065, 0.1),
        Part(p.GEOM_CYLINDER, (0.0, 0.0, 0.85), 0.043, 0.1),
        Part(p.GEOM_CYLINDER, (0.0, 0.0, 0.95), 0.022, 0.1),
    ]


def hoop() -> list[Part]:
    """Return an upright ring around the origin, across the x axis. The unit is its radius."""
    parts = []
    for angle in np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False):
        place = (0.0, math.cos(angle), math.sin(angle))
        parts.append(Part(p.GEOM_CYLINDER, place, 0.043, 0.41, angles=(angle, 0.0, 0.0)))
    return parts
