"""Cameras, and where to put them so that everything is in the picture. The world frame has z up;
lengths are in m.
"""

import math
from typing import NamedTuple

import numpy as np

from sb3_quad.base.arrays import FloatArray
from sb3_quad.simulation.state import POSITION, TARGET

SLOPE = math.tan(math.radians(15.0))  # see Lens; small, so that near and far are nearly of one size
CHASE_SLOPE = math.tan(math.radians(27.0))
CHASE_MARGIN = 0.6  # around vehicle and target, m, for the default vehicle
ASIDE = math.radians(9.0)  # between the direction to the target and that of a chasing camera
STEEPEST = math.radians(70.0)  # elevation of a chasing camera
DOWN = math.radians(5.0)  # how far a camera that frames points looks down
LOWEST = (-math.inf, -math.inf, 0.3)  # where a camera is at least, m


class Lens(NamedTuple):
    """What a camera's pictures are like."""

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
        """Column, row (pixels from the top left corner) and depth (m) at which points, (n, 3), are
        seen; (n, 3).
        """
        width, height, slope = self.lens
        forward, right, up = self.axes @ (points - self.eye).T
        scale = height / 2.0 / (np.maximum(forward, 1e-6) * slope)
        return np.stack([width / 2.0 + scale * right, height / 2.0 - scale * up, forward], axis=1)


def direction(course: float, elevation: float) -> FloatArray:
    """The unit vector, (3,), at an angle ``course`` about z and an angle ``elevation`` above the
    horizon, rad.
    """
    level = math.cos(elevation)
    return np.array([level * math.cos(course), level * math.sin(course), math.sin(elevation)])


def broadside(points: FloatArray) -> FloatArray:
    """The direction, (3,), in which a camera sees the spread of ``points``, (n, 3), best; a little
    downwards.
    """
    spread = np.cov(points[:, :2].T) if len(points) > 2 else np.eye(2)
    x, y = np.linalg.eigh(spread)[1][:, 0]
    return direction(math.atan2(y, x) if (y, x) > (0.0, 0.0) else math.atan2(-y, -x), -DOWN)


def framing_camera(points: FloatArray, margin: float, forward: FloatArray, lens: Lens) -> Camera:
    """The nearest camera that sees balls of radius ``margin`` at all points.

    :param points: (n, 3), world frame, m.
    :param forward: where it looks, a unit vector, (3,), not vertical.
    """
    axes, slopes = _axes(forward), lens.slopes
    local = points @ axes.T
    across, room = local[:, 1:], margin - slopes * local[:, :1]
    # How far it must see, in the plane through the origin, to the left and down, and to the right
    # and up.
    before, after = (room - across).max(axis=0), (room + across).max(axis=0)
    distance = float((0.5 * (before + after) / slopes).max())
    return Camera(
        np.maximum(np.array([-distance, *(0.5 * (after - before))]) @ axes, LOWEST), axes, lens
    )


class ChaseCamera:
    """A camera behind the vehicle as seen from its target and a little aside, which has both in its
    picture.

    :param scale: the vehicle's size, in that of the default one.
    :param width: of its pictures, pixels; ``height`` likewise.
    """

    def __init__(self, scale: float, width: int, height: int) -> None:
        self.scale, self.lens = scale, Lens(width, height, CHASE_SLOPE)
        self.course, self.elevation = ASIDE, -ASIDE

    def follow(self, state: FloatArray, share: float) -> Camera:
        """The camera for ``state``, (STATE_SIZE,), turned towards the target by a share of the
        angle.
        """
        x, y, z = state[TARGET] - state[POSITION]
        if math.hypot(x, y, z) > self.scale:  # nearer targets would turn it to and fro
            self.course += share * math.remainder(
                math.atan2(y, x) + ASIDE - self.course, 2.0 * math.pi
            )
            elevation = float(np.clip(math.atan2(z, math.hypot(x, y)) - ASIDE, -STEEPEST, STEEPEST))
            self.elevation += share * (elevation - self.elevation)
        both = np.stack([state[POSITION], state[TARGET]])
        return framing_camera(
            both, CHASE_MARGIN * self.scale, direction(self.course, self.elevation), self.lens
        )


def _axes(forward: FloatArray) -> FloatArray:
    """Forward, right and up of a camera without roll, (3, 3)."""
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    return np.stack([forward, right, np.cross(right, forward)])
