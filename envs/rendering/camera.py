"""Cameras, placed so that everything is in the picture.

The world frame has z up; lengths are in m.
"""

import math
from typing import NamedTuple

import numpy as np

from sb3_quad.base.types import FloatArray

SLOPE = math.tan(math.radians(15.0))  # see Lens; small, so that distance hardly changes sizes
WIDE = math.tan(math.radians(27.0))  # of a single vehicle
MARGIN = 0.6  # around a vehicle and its target, m, for the default vehicle
ASIDE = math.radians(9.0)  # between the direction to the target and that of a chasing camera
STEEPEST = math.radians(70.0)  # elevation of a chasing camera's direction
# How far cameras look down: one that frames points, and one that shows a target's path
DOWN = math.radians(5.0)
ON_PATH = math.radians(40.0)
LOWEST = (-math.inf, -math.inf, 0.3)  # lower bounds of a camera's position, m


class Lens(NamedTuple):
    """The size of a camera's pictures and its field of view."""

    width: int  # pixels
    height: int
    slope: float = SLOPE  # tangent of half the vertical field of view

    @property
    def slopes(self) -> FloatArray:
        """Tangents of half the fields of view, horizontal and vertical, (2,)."""
        return np.array([self.slope * (self.width / self.height), self.slope])


class Camera(NamedTuple):
    """A pinhole camera without roll."""

    eye: FloatArray  # its position, (3,)
    axes: FloatArray  # forward, right and up, (3, 3), a unit vector per row
    lens: Lens

    def project(self, points: FloatArray) -> FloatArray:
        """Return column, row (pixels from the top left corner) and depth (m) of points, (n, 3), in
        the picture; (n, 3).
        """
        width, height, slope = self.lens
        forward, right, up = self.axes @ (points - self.eye).T
        # A point at or behind the camera gets a place far outside the picture.
        scale = height / 2.0 / (np.maximum(forward, 1e-6) * slope)
        return np.stack([width / 2.0 + scale * right, height / 2.0 - scale * up, forward], axis=1)


def direction(course: float, elevation: float) -> FloatArray:
    """Return the unit vector, (3,), at an angle ``course`` about z and an angle ``elevation`` above
    the horizon, rad.
    """
    level = math.cos(elevation)
    return np.array([level * math.cos(course), level * math.sin(course), math.sin(elevation)])


def broadside(points: FloatArray, down: float = DOWN) -> FloatArray:
    """Return the direction, (3,), in which a camera sees the spread of points best.

    :param points: (n, 3), n > 1.
    :param down: how far it looks down, rad.
    """
    spread = np.cov(points[:, :2].T)
    # The direction of the least spread, always with the same one of its two signs, so that similar
    # flights are seen from the same side.
    x, y = np.linalg.eigh(spread)[1][:, 0]
    return direction(math.atan2(y, x) % math.pi, -down)


def chasing(way: FloatArray) -> FloatArray:
    """Return the direction, (3,), of a camera behind a vehicle and a little aside.

    :param way: vector from the vehicle to its target, (3,).
    """
    x, y, z = way
    elevation = math.atan2(z, math.hypot(x, y)) - ASIDE
    elevation = np.clip(elevation, -STEEPEST, STEEPEST)
    return direction(math.atan2(y, x) + ASIDE, elevation)


def framing_camera(points: FloatArray, margin: float, forward: FloatArray, lens: Lens) -> Camera:
    """Return the nearest camera that sees balls of radius ``margin`` at all points.

    :param points: (n, 3), world frame, m.
    :param forward: direction of the camera, a unit vector, (3,), not vertical.
    """
    # Level: the camera does not roll.
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    axes = np.stack([forward, right, np.cross(right, forward)])
    local = points @ axes.T
    across = local[:, 1:]
    room = margin - lens.slopes * local[:, :1]
    # How far it must see, in the plane through the origin, to the left and down, and to the right
    # and up.
    before = (room - across).max(axis=0)
    after = (room + across).max(axis=0)
    distance = (0.5 * (before + after) / lens.slopes).max()
    eye = np.array([-distance, *(0.5 * (after - before))]) @ axes
    return Camera(np.maximum(eye, LOWEST), axes, lens)
