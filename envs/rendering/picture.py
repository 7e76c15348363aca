"""What PyBullet does not draw: sky and ground behind its bodies, trails and turning rotors laid over them.

Points are in the world frame, m; colours are red, green, blue in [0, 1]; row 0 of a picture is its top.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.colors import to_rgb
from PIL import Image as Pillow
from PIL import ImageDraw

from sb3_quad.base.arrays import Float32Array, FloatArray
from sb3_quad.envs.rendering.camera import Camera, Lens

NEAR, FAR = 0.05, 120.0
SUPERSAMPLING = 2  # PyBullet's software renderer draws hard edges
SKY_HORIZON = np.array([0.87, 0.92, 0.96], dtype=np.float32)
SKY_ZENITH = np.array([0.36, 0.58, 0.86], dtype=np.float32)
GROUND_LIGHT = np.array([0.61, 0.69, 0.55], dtype=np.float32)
GROUND_DARK = np.array([0.50, 0.60, 0.46], dtype=np.float32)
SQUARE = 2.0  # side of the ground's squares, m
SHADOW = 0.45  # share of the light that a shadow takes
VISIBILITY = 90.0  # distance at which 1/e of the ground is still seen through the haze, m
THINNEST = 1.4  # width of a line at least, pixels


class Overlay(NamedTuple):
    """What is laid over a picture: a line through points, or with no width the flat shape that they surround."""

    points: FloatArray  # (n, 3)
    colour: Any  # as matplotlib takes it
    opacity: float
    width: float | None = None  # m


def backdrop(camera: Camera, shadows: FloatArray) -> Float32Array:
    """Sky, and chequered ground with shadows and haze, (height, width, 3).

    :param shadows: centre x, y and radius of each shadow on the ground, (k, 3).
    """
    axes, (width, height, slope) = camera.axes.astype(np.float32), camera.lens
    x = np.float32(slope / height) * (2.0 * np.arange(width, dtype=np.float32) + 1.0 - width)
    y = np.float32(slope / height) * (height - 1.0 - 2.0 * np.arange(height, dtype=np.float32))
    rise = axes[0, 2] + y * axes[2, 2]  # of a row's rays, whose part along forward is 1; a camera without roll
    share = np.clip(1.6 * rise / np.sqrt(1.0 + y * y), 0.0, 1.0)
    picture = np.repeat((SKY_HORIZON + share[:, None] * (SKY_ZENITH - SKY_HORIZON))[:, None], width, axis=1)
    first = int((rise > -1e-3).sum())
    eye_x, eye_y, eye_z = camera.eye.tolist()
    if first == height or eye_z <= 0.0:
        return picture
    y, along = y[first:, None], -eye_z / rise[first:, None]
    east = eye_x + along * (axes[0, 0] + x * axes[1, 0] + y * axes[2, 0])
    north = eye_y + along * (axes[0, 1] + x * axes[1, 1] + y * axes[2, 1])
    distance = along * np.sqrt(1.0 + x * x + y * y)
    # What a pixel covers of the ground, in squares; finer squares blur into their mean instead of flickering.
    footprint = along * along * (2.0 * slope / height / eye_z / SQUARE)
    soft = np.maximum(0.5 * np.pi * footprint, 0.02)
    wave = np.clip(np.sin(np.pi / SQUARE * east) / soft, -1.0, 1.0) * np.clip(np.sin(np.pi / SQUARE * north) / soft, -1.0, 1.0)
    dark = 0.5 + 0.5 * wave * np.clip(2.0 - 2.0 * footprint, 0.0, 1.0)
    light = np.ones_like(dark)
    for centre_x, centre_y, radius in shadows.tolist():
        away = np.hypot(east - centre_x, north - centre_y) / radius
        light *= 1.0 - SHADOW * np.clip(1.8 - 1.6 * away, 0.0, 1.0)
    clear = np.exp(distance / -VISIBILITY)[..., None]
    ground = light[..., None] * (GROUND_LIGHT + dark[..., None] * (GROUND_DARK - GROUND_LIGHT))
    picture[first:] = SKY_HORIZON + clear * (ground - SKY_HORIZON)
    return picture


def draw_overlays(overlays: Sequence[Overlay], camera: Camera, depth: Float32Array) -> Pillow.Image:
    """Overlays where nothing of less ``depth``, (height, width), m, is before them; elsewhere the picture is transparent."""
    high, wide = depth.shape
    picture, away = Pillow.new("RGBA", (wide, high)), Pillow.new("F", (wide, high), np.inf)
    draw, draw_away = ImageDraw.Draw(picture), ImageDraw.Draw(away)
    larger = camera._replace(lens=Lens(wide, high, camera.lens.slope))
    for overlay in overlays:
        screen = larger.project(overlay.points)
        if overlay.width is None:
            centre = np.broadcast_to(screen.mean(axis=0), screen.shape)
            polygons = np.stack([centre, screen, np.roll(screen, 1, axis=0)], axis=1)
        else:
            polygons = _ribbon(screen, overlay.width * high / (2.0 * camera.lens.slope))
        colour = tuple(round(255 * part) for part in (*to_rgb(overlay.colour), overlay.opacity))
        for polygon in polygons[(polygons[:, :, 2] > NEAR).all(axis=1)]:
            corners = polygon[:, :2].clip(-1e4, 1e4).ravel().tolist()
            draw.polygon(corners, fill=colour)
            draw_away.polygon(corners, fill=float(polygon[:, 2].mean()))
    seen = np.asarray(picture).copy()
    seen[..., 3] *= np.asarray(away) < depth
    return Pillow.fromarray(seen)


def _ribbon(screen: FloatArray, width: float) -> FloatArray:
    """A line as quadrilaterals, (n - 1, 4, 3), from points of it, (n, 3); each point a column, a row and a depth.

    :param width: of the line at a depth of 1 m, pixels.
    """
    if len(screen) < 2:
        return np.zeros((0, 4, 3))
    along = np.gradient(screen[:, :2], axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    half = 0.5 * np.maximum(width / np.maximum(screen[:, 2:], NEAR), THINNEST * SUPERSAMPLING)
    aside = np.column_stack([half * along[:, ::-1] * (-1.0, 1.0), np.zeros(len(screen))])
    left, right = screen - aside, screen + aside
    return np.stack([left[:-1], left[1:], right[1:], right[:-1]], axis=1)
