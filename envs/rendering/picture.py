"""The parts of a picture that PyBullet does not draw: sky and ground behind its bodies, and trails.

Points are in the world frame, m; colours are red, green, blue in [0, 1]; row 0 of a picture is its
top.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from PIL import Image as Pillow
from PIL import ImageDraw

from sb3_quad.base.types import Float32Array, FloatArray, Image
from sb3_quad.envs.rendering.camera import Camera

NEAR = 0.05  # distances between which bodies are drawn, m
FAR = 120.0
SUPERSAMPLING = 2  # PyBullet's software renderer draws hard edges
SKY_HORIZON = np.array([0.87, 0.92, 0.96], np.float32)
SKY_ZENITH = np.array([0.36, 0.58, 0.86], np.float32)
GROUND_LIGHT = np.array([0.61, 0.69, 0.55], np.float32)
GROUND_DARK = np.array([0.50, 0.60, 0.46], np.float32)
SQUARE = 2.0  # side of the ground's squares, m
SHADOW = 0.45  # share of the light that a shadow takes
VISIBILITY = 90.0  # distance at which 1/e of the ground is still seen through the haze, m
LINE = 0.006  # width of a trail, in heights of the picture


class Trail(NamedTuple):
    """The line that a vehicle has flown along."""

    points: FloatArray  # (n, 3)
    colour: str  # as Pillow takes it, such as #rrggbb


def backdrop(camera: Camera, shadow: Float32Array) -> Image:
    """Draw sky, and chequered ground with a shadow and haze, uint8 (height, width, 3).

    :param camera: above the ground.
    :param shadow: centre x, y and radius of the shadow on the ground, (3,).
    """
    width, height, slope = camera.lens
    x, y = camera.lens.slopes
    across = np.linspace(-x, x, width, dtype=np.float32)[:, None]
    upwards = np.linspace(y, -y, height, dtype=np.float32)[:, None, None]
    forward, right, up = camera.axes.astype(np.float32)
    # One ray for each pixel, from the eye.
    rays = forward + across * right + upwards * up
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    climb = rays[..., 2:]
    sky = SKY_HORIZON + (1.6 * climb).clip(0.0, 1.0) * (SKY_ZENITH - SKY_HORIZON)
    eye = camera.eye.astype(np.float32)
    # Where a ray meets no ground, it goes so far that haze hides the ground.
    distance = eye[2] / np.maximum(-climb, 1e-6)
    points = eye[:2] + distance * rays[..., :2]
    # Twice the size of a pixel on the ground, in squares. Finer squares blur into their mean
    # instead of flickering.
    blur = distance**2 * (4.0 * slope / height / eye[2] / SQUARE)
    wave = np.sin(np.pi / SQUARE * points).prod(axis=2, keepdims=True) / np.maximum(blur, 0.02)
    dark = 0.5 + 0.5 * wave.clip(-1.0, 1.0) * (2.0 - blur).clip(0.0, 1.0)
    ground = GROUND_LIGHT + dark * (GROUND_DARK - GROUND_LIGHT)
    # The shadow has a soft edge.
    away = np.linalg.norm(points - shadow[:2], axis=2, keepdims=True) / shadow[2]
    ground *= 1.0 - SHADOW * (1.8 - 1.6 * away).clip(0.0, 1.0)
    # The share of the ground that is seen through the haze.
    haze = np.exp(distance / -VISIBILITY)
    return np.asarray(255.0 * (sky + haze * (ground - sky)) + 0.5, np.uint8)


def draw_trails(picture: Pillow.Image, trails: Sequence[Trail], camera: Camera) -> None:
    """Draw trails into a picture taken by ``camera``, except for what is behind it."""
    draw = ImageDraw.Draw(picture)
    width = max(2, round(LINE * picture.height))
    for points, colour in trails:
        screen = camera.project(points)
        is_ahead = screen[:, 2] > NEAR
        for k in np.flatnonzero(is_ahead[:-1] & is_ahead[1:]):
            draw.line(screen[k : k + 2, :2].ravel().tolist(), colour, width)
