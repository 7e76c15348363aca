"""Cameras, and where to put them so that everything is in the picture. The world frame has z up; lengths are in m."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sb3_quad.base.arrays import FloatArray
from sb3_quad.simulation.state import POSITION, TARGET

FIELD_OF_VIEW = math.radians(30.0)  # vertical; narrow, so that near and far are nearly of one size
CHASE_FIELD_OF_VIEW = math.radians(54.0)
ELEVATIONS = math.radians(-45.0), math.radians(52.0)  # of a chasing camera
ELEVATION_AT_TARGET = math.radians(-8.0)
DOWN = math.radians(5.0)  # how far cameras of films look down
LOWEST = 0.3  # height of a camera at least, m
SMOOTHING = 0.35  # standard deviation of a camera's smoothing over time, s


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without roll.

    :param eye: its position, (3,).
    :param axes: forward, right and up, (3, 3), a unit vector per row.
    :param slope: tangent of half the vertical field of view.
    """

    eye: FloatArray
    axes: FloatArray
    slope: float

    def project(self, points: FloatArray, width: int, height: int) -> FloatArray:
        """Column, row (pixels from the top left corner) and depth (m) at which points, (n, 3), are seen; (n, 3)."""
        forward, right, up = self.axes @ (points - self.eye).T
        scale = height / 2.0 / (np.maximum(forward, 1e-6) * self.slope)
        return np.stack([width / 2.0 + scale * right, height / 2.0 - scale * up, forward], axis=1)


def direction(course: float, elevation: float) -> FloatArray:
    """The unit vector, (3,), at an angle ``course`` about z and an angle ``elevation`` above the horizon, rad."""
    level = math.cos(elevation)
    return np.array([level * math.cos(course), level * math.sin(course), math.sin(elevation)])


def broadside(points: FloatArray) -> FloatArray:
    """The direction, (3,), in which a camera sees the spread of ``points``, (n, 3), best; a little downwards."""
    spread = np.cov(points[:, :2].T) if len(points) > 2 else np.eye(2)
    x, y = np.linalg.eigh(spread)[1][:, 0]
    return direction(math.atan2(y, x) if (y, x) > (0.0, 0.0) else math.atan2(-y, -x), -DOWN)


def framing_camera(
    points: FloatArray, margin: float, aspect: float, forward: FloatArray, field_of_view: float = FIELD_OF_VIEW
) -> Camera:
    """The nearest camera, looking along ``forward``, that sees balls of radius ``margin`` at all points.

    :param points: (n, 3), world frame, m.
    :param aspect: width of the picture by its height.
    :param forward: unit vector, (3,), not vertical.
    :param field_of_view: vertical, rad.
    """
    axes, slope = _axes(forward), math.tan(field_of_view / 2)
    half = np.array([slope * aspect, slope])
    before, after = _needed(points @ axes.T, half, margin)
    distance = float((0.5 * (before + after) / half).max())
    return Camera(_above_ground(np.array([-distance, *(0.5 * (after - before))]) @ axes), axes, slope)


def following_cameras(
    points: Sequence[FloatArray],
    frame_seconds: float,
    margin: float,
    aspect: float,
    forward: FloatArray,
    field_of_view: float = FIELD_OF_VIEW,
) -> list[Camera]:
    """A camera for each frame of a film that has that frame's points in its picture and moves smoothly.

    :param points: for each frame (n, 3), m; ``frame_seconds`` of flight lie between two.
    """
    cameras = [framing_camera(each, margin, aspect, forward, field_of_view) for each in points]
    axes, slope = cameras[0].axes, cameras[0].slope
    places = np.array([axes @ camera.eye for camera in cameras])  # along forward, right and up
    reach = math.ceil(3.0 * SMOOTHING / frame_seconds)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) * frame_seconds / SMOOTHING) ** 2)
    padded = np.pad(places, ((reach, reach), (0, 0)), mode="edge")
    smooth = np.stack([np.convolve(column, weights / weights.sum(), "valid") for column in padded.T], axis=1)
    half = np.array([slope * aspect, slope])
    for place, each in zip(smooth, points, strict=True):  # farther away where smoothing has cut something off
        before, after = _needed(each @ axes.T, half, 0.6 * margin)
        place[0] = min(place[0], -(np.maximum(after - place[1:], before + place[1:]) / half).max())
    return [Camera(_above_ground(place @ axes), axes, slope) for place in smooth]


class ChaseCamera:
    """A camera behind the vehicle as seen from its target and a little aside, so that both are in the picture.

    :param scale: the vehicle's size, in that of the default one.
    """

    def __init__(self, scale: float) -> None:
        self.scale, self.course, self.elevation = scale, 0.0, ELEVATION_AT_TARGET

    def turn(self, state: FloatArray, share: float) -> None:
        """Turn towards the target of ``state``, (STATE_SIZE,), by a share of the angle; at it, keep course and level out."""
        x, y, z = state[TARGET] - state[POSITION]
        across = math.hypot(x, y)
        far = math.hypot(across, z) > self.scale
        if far and across > 0.3 * self.scale:
            self.course += share * math.remainder(math.atan2(y, x) - self.course, 2.0 * math.pi)
        elevation = float(np.clip(math.atan2(z, across), *ELEVATIONS)) if far else ELEVATION_AT_TARGET
        self.elevation += share * (elevation - self.elevation)

    def camera(self, state: FloatArray) -> Camera:
        """The camera for ``state``, (STATE_SIZE,)."""
        level, aside = direction(self.course, 0.0), direction(self.course - math.pi / 2, 0.0)
        ahead, above = direction(self.course, self.elevation), direction(self.course, self.elevation + math.pi / 2)
        over = 0.4 - 0.75 * max(self.elevation, 0.0)  # a target far above is seen past the vehicle from below
        eye = _above_ground(state[POSITION] + self.scale * (-1.3 * ahead + 0.35 * aside + over * above))
        forward = _unit(state[POSITION] - eye) + _unit(state[TARGET] - eye) + 0.05 * level  # never straight up or down
        return Camera(eye, _axes(_unit(forward)), math.tan(CHASE_FIELD_OF_VIEW / 2))


def _unit(vector: FloatArray) -> FloatArray:
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-3))


def _axes(forward: FloatArray) -> FloatArray:
    """Forward, right and up of a camera without roll, (3, 3)."""
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    return np.stack([forward, right, np.cross(right, forward)])


def _needed(local: FloatArray, half: FloatArray, margin: float) -> tuple[FloatArray, FloatArray]:
    """How far a camera must see, in the plane through the origin, to the left and down, and to the right and up; (2,) each.

    :param local: (n, 3), points to be seen with ``margin`` around them, along the camera's axes.
    :param half: tangents of half its fields of view, (2,).
    """
    across, room = local[:, 1:], margin - half * local[:, :1]
    return (room - across).max(axis=0), (room + across).max(axis=0)


def _above_ground(eye: FloatArray) -> FloatArray:
    return np.array([eye[0], eye[1], max(eye[2], LOWEST)])
