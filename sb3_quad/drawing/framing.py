"""Cameras that look in one direction and have everything in their picture."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from sb3_quad.drawing.backdrop import Camera

FloatArray = npt.NDArray[np.float64]

FIELD_OF_VIEW = math.radians(30.0)  # vertical; narrow, so that near and far are nearly of one size
ELEVATION = math.radians(5.0)
HIGHEST = 0.3  # the camera's least height, m
SMOOTHING = 0.35  # standard deviation of the camera's smoothing over time, s


def broadside(points: FloatArray) -> FloatArray:
    """The horizontal unit vector, (3,), along which ``points``, (n, 3), spread least: to look along."""
    spread = np.cov(points[:, :2].T) if len(points) > 2 else np.eye(2)
    _, vectors = np.linalg.eigh(spread)
    x, y = vectors[:, 0]
    return np.array([x, y, 0.0]) if (y, x) > (0.0, 0.0) else np.array([-x, -y, 0.0])


def framing_camera(
    points: FloatArray, margin: float, aspect: float, ahead: FloatArray, field_of_view: float = FIELD_OF_VIEW
) -> Camera:
    """The nearest camera, looking along ``ahead`` and a little down, that sees balls of radius ``margin`` at all points.

    :param points: (n, 3), world frame, m.
    :param aspect: width of the picture by its height.
    :param ahead: horizontal unit vector, (3,).
    :param field_of_view: vertical, rad.
    """
    axes = _axes(ahead)
    slope = math.tan(field_of_view / 2)
    half = np.array([slope * aspect, slope])
    local = points @ axes.T
    centre = np.zeros(2)
    for _ in range(30):  # where the picture's middle lies depends on the distance, and the other way round
        distance = _distance(local, centre, half, margin)
        away, depth = local[:, 1:] - centre, local[:, :1] + distance
        middle = 0.5 * (((away - margin) / depth).min(axis=0) + ((away + margin) / depth).max(axis=0))
        centre = centre + middle * float(depth.mean())
    return Camera(_above_ground(np.array([-_distance(local, centre, half, margin), *centre]) @ axes), axes, slope)


def following_cameras(
    points: Sequence[FloatArray],
    frame_seconds: float,
    margin: float,
    aspect: float,
    ahead: FloatArray,
    field_of_view: float = FIELD_OF_VIEW,
) -> list[Camera]:
    """A camera for each frame of a film that has that frame's points in its picture and moves smoothly.

    :param points: for each frame (n, 3), m; ``frame_seconds`` of flight lie between two.
    """
    axes = _axes(ahead)
    slope = math.tan(field_of_view / 2)
    cameras = [framing_camera(each, margin, aspect, ahead, field_of_view) for each in points]
    places = np.array([axes @ camera.eye for camera in cameras])  # along forward, right and up
    reach = math.ceil(3.0 * SMOOTHING / frame_seconds)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) * frame_seconds / SMOOTHING) ** 2)
    padded = np.concatenate([np.repeat(places[:1], reach, axis=0), places, np.repeat(places[-1:], reach, axis=0)])
    smooth = np.stack([np.convolve(padded[:, axis], weights / weights.sum(), "valid") for axis in range(3)], axis=1)
    for place, each in zip(smooth, points, strict=True):  # where smoothing has cut something off, farther away
        place[0] = min(place[0], -_distance(each @ axes.T, place[1:], slope * np.array([aspect, 1.0]), 0.6 * margin))
    return [Camera(_above_ground(place @ axes), axes, slope) for place in smooth]


def _axes(ahead: FloatArray) -> FloatArray:
    """Forward, right and up of a camera that looks along ``ahead`` and a little down, (3, 3)."""
    forward = math.cos(ELEVATION) * ahead - np.array([0.0, 0.0, math.sin(ELEVATION)])
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    return np.stack([forward, right, np.cross(right, forward)])


def _distance(local: FloatArray, centre: FloatArray, half: FloatArray, margin: float) -> float:
    """How far behind the origin a camera must stand to see all of ``local``, (n, 3) along its axes.

    :param centre: where it stands to the right and up, (2,).
    :param half: tangents of half its fields of view, (2,).
    """
    return float(((np.abs(local[:, 1:] - centre) + margin) / half - local[:, :1]).max())


def _above_ground(eye: FloatArray) -> FloatArray:
    return np.array([eye[0], eye[1], max(eye[2], HIGHEST)])
