"""The shapes that vehicles, targets and arrows are drawn with, as PyBullet bodies without mass that
touch nothing. Their lengths are in units of their own.
"""

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from sb3_quad.base.bullet import p
from sb3_quad.base.types import FloatArray
from sb3_quad.vehicles.vehicle import Vehicle

Vector: TypeAlias = tuple[float, float, float]
Colour: TypeAlias = tuple[float, float, float, float]

DARK = (0.13, 0.14, 0.17, 1.0)
GREY = (0.55, 0.58, 0.62, 1.0)
FRONT = (0.93, 0.32, 0.10, 1.0)
WHITE = (0.92, 0.93, 0.95, 1.0)
# The drawn rotors turn so much slower than real ones, which would seem to stand or turn backwards
# in a film.
SLOWED = 12.0
# The three steps of an arrow's head: height, in its length, and radius, in its radius.
HEAD = ((0.75, 2.4), (0.85, 1.6), (0.95, 0.8))
NOWHERE = (0.0, 0.0, -1000.0)


class Part(NamedTuple):
    """A part of a body: a box (its sides), a cylinder along z, or a ball.

    The angles are roll, pitch and yaw, rad.
    """

    shape: int
    at: Vector = (0.0, 0.0, 0.0)
    box: Vector = (0.0, 0.0, 0.0)
    radius: float = 0.0
    length: float = 0.0
    angles: Vector = (0.0, 0.0, 0.0)


def add_body(parts: Sequence[Part], unit: float, colour: Colour, client: int) -> int:
    """Add a body of at most 16 parts, out of sight; return its number.

    :param unit: of the parts' lengths, m.
    """
    shapes, places, boxes, radii, lengths, angles = zip(*parts, strict=True)
    # PyBullet takes lists only; tuples crash it.
    shape = p.createVisualShapeArray(
        shapeTypes=list(shapes),
        halfExtents=np.multiply(boxes, unit / 2.0).tolist(),
        radii=np.multiply(radii, unit).tolist(),
        lengths=np.multiply(lengths, unit).tolist(),
        rgbaColors=[colour] * len(parts),
        visualFramePositions=np.multiply(places, unit).tolist(),
        visualFrameOrientations=list(map(p.getQuaternionFromEuler, angles)),
        physicsClientId=client,
    )
    return int(p.createMultiBody(0.0, -1, shape, NOWHERE, physicsClientId=client))


def move_body(
    client: int,
    body: int,
    position: Sequence[float],
    quaternion: Sequence[float] = (0.0, 0.0, 0.0, 1.0),
) -> None:
    """Move a body; the quaternion is (x, y, z, w), as PyBullet's are."""
    p.resetBasePositionAndOrientation(body, position, quaternion, physicsClientId=client)


def rotor_radius(vehicle: Vehicle) -> float:
    """Return the radius at which neighbouring rotors are drawn just clear of each other, m."""
    pairs = itertools.combinations(vehicle.rotor_positions, 2)
    return 0.44 * min(itertools.starmap(math.dist, pairs))


def span(vehicle: Vehicle) -> float:
    """Radius of the vehicle with its rotors, m."""
    return vehicle.arm_length + rotor_radius(vehicle)


def rotor_turning(vehicle: Vehicle, speeds: FloatArray) -> FloatArray:
    """Return the rates of the drawn rotors about body z, of rotor speeds (..., 4), rad/s."""
    return -np.sign(vehicle.rotor_directions) * speeds / SLOWED


def frame(centres: FloatArray) -> dict[Colour, list[Part]]:
    """Return a vehicle without its rotors, by colour: PyBullet's window gives a body one colour
    only. The unit is the arm.

    :param centres: of the rotors, (4, 3).
    """
    parts = {
        DARK: [Part(p.GEOM_CYLINDER, (0.0, 0.0, 0.02), radius=0.30, length=0.14)],
        GREY: [Part(p.GEOM_BOX, (-0.02, 0.0, -0.10), (0.34, 0.20, 0.12))],
        FRONT: [],
    }
    for x, y, z in centres.tolist():
        # A beam from the middle to the rotor, and a motor below it.
        middle = (x / 2, y / 2, 0.02)
        beam = (math.hypot(x, y), 0.09, 0.06)
        colour = FRONT if x > 0 else DARK
        parts[colour].append(Part(p.GEOM_BOX, middle, beam, angles=(0.0, 0.0, math.atan2(y, x))))
        motor = (x, y, 0.45 * z)
        parts[GREY].append(Part(p.GEOM_CYLINDER, motor, radius=0.09, length=0.9 * z))
    return parts


def rotor(pitch: float) -> list[Part]:
    """Return a hub and two blades in the plane z = 0, pitched by an angle, rad. The unit is their
    radius.
    """
    parts = [Part(p.GEOM_CYLINDER, radius=0.09, length=0.16)]
    for side in (1.0, -1.0):
        middle = (0.47 * side, 0.0, 0.0)
        parts.append(Part(p.GEOM_BOX, middle, (0.94, 0.15, 0.02), angles=(side * pitch, 0.0, 0.0)))
    return parts


def arrow(radius: float) -> list[Part]:
    """Return an arrow along +z from the origin; its head has three steps. The unit is its
    length.
    """
    parts = [Part(p.GEOM_CYLINDER, (0.0, 0.0, 0.35), radius=radius, length=0.7)]
    for height, width in HEAD:
        parts.append(Part(p.GEOM_CYLINDER, (0.0, 0.0, height), radius=width * radius, length=0.1))
    return parts


def hoop(thickness: float, yaw: float) -> list[Part]:
    """Return an upright ring around the origin, turned about z by an angle, rad. The unit is its
    radius.
    """
    length = 2.06 * math.tan(math.pi / 16)
    parts = []
    for angle in np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False).tolist():
        level = math.cos(angle)
        place = (-level * math.sin(yaw), level * math.cos(yaw), math.sin(angle))
        angles = (angle, 0.0, yaw)
        parts.append(Part(p.GEOM_CYLINDER, place, radius=thickness, length=length, angles=angles))
    return parts
