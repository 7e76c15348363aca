"""A camera that stands still and has everything in its picture."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from sb3_quad.envs.backdrop import Camera

FloatArray = npt.NDArray[np.float64]

FIELD_OF_VIEW = math.radians(30.0)  # vertical; narrow, so that near and far are nearly of one size
ELEVATION = math.radians(10.0)
HIGHEST = 0.3  # the camera's least height, m


def broadside(points: FloatArray) -> FloatArray:
    """The horizontal unit vector, (3,), along which ``points``, (n, 3), spread least: to look along."""
    spread = np.cov(points[:, :2].T) if len(points) > 2 else np.eye(2)
    _, vectors = np.linalg.eigh(spread)
    x, y = vectors[:, 0]
    return np.array([x, y, 0.0]) if (y, x) > (0.0, 0.0) else np.array([-x, -y, 0.0])


def framing_camera(points: FloatArray, margin: float, aspect: float, ahead: FloatArray) -> Camera:
    """The nearest camera, looking along ``ahead`` and a little down, that sees balls of radius ``margin`` at all points.

    :param points: (n, 3), world frame, m.
    :param aspect: width of the picture by its height.
    :param ahead: horizontal unit vector, (3,).
    """
    forward = math.cos(ELEVATION) * ahead - np.array([0.0, 0.0, math.sin(ELEVATION)])
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    axes = np.stack([forward, right, np.cross(right, forward)])
    slope = math.tan(FIELD_OF_VIEW / 2)
    half = np.array([slope * aspect, slope])
    local = points @ axes.T
    centre, distance = np.zeros(2), 0.0
    for _ in range(30):  # where the picture's middle lies depends on the distance, and the other way round
        away = local[:, 1:] - centre
        distance = float(((np.abs(away) + margin) / half - local[:, :1]).max())
        depth = local[:, :1] + distance
        middle = 0.5 * (((away - margin) / depth).min(axis=0) + ((away + margin) / depth).max(axis=0))
        centre = centre + middle * float(depth.mean())
    eye = np.array([-distance, *centre]) @ axes
    eye[2] = max(eye[2], HIGHEST)
    return Camera(eye, axes, slope)
