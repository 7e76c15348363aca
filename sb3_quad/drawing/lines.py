"""Lines in space drawn into a picture, hidden by what is before them."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from sb3_quad.drawing.backdrop import Camera
from sb3_quad.drawing.scenery import NEAR, SUPERSAMPLING, Picture

FloatArray = npt.NDArray[np.float64]


def draw_line(
    picture: Picture,
    camera: Camera,
    points: FloatArray,
    colour: tuple[float, float, float],
    width: float,
    opacity: float = 1.0,
) -> None:
    """Draw a line through ``points`` into a picture, in place.

    :param points: (n, 3), world frame, m.
    :param colour: red, green and blue in [0, 1].
    :param width: m; never drawn thinner than 1.8 pixels.
    """
    height, columns = picture.pixels.shape[:2]
    if len(points) < 2:
        return
    cover = np.zeros((height, columns), dtype=np.float32)
    screen = project(camera, points, columns, height)
    pixels_at_one_metre = height / (2.0 * camera.slope)
    _cover(cover, screen, picture.depth, SUPERSAMPLING, width * pixels_at_one_metre)
    share = (opacity * cover)[:, :, None]
    blended = picture.pixels + share * (255.0 * np.asarray(colour, dtype=np.float32) - picture.pixels)
    picture.pixels[:] = np.round(blended).astype(np.uint8)


def project(camera: Camera, points: FloatArray, width: int, height: int) -> FloatArray:
    """Where points, (n, 3), are seen in a picture: column, row (pixels from the top left corner) and depth (m), (n, 3)."""
    forward, right, up = (points - camera.eye) @ camera.axes.T[:, 0], *((points - camera.eye) @ camera.axes.T[:, 1:]).T
    depth = np.maximum(forward, 1e-6)
    half = height / 2.0
    column = width / 2.0 + half * right / (depth * camera.slope)
    row = half - half * up / (depth * camera.slope)
    return np.column_stack([column, row, forward])


@njit(cache=True, error_model="numpy")
def _cover(cover, screen, depth, samples, width):
    """How much of each pixel a line covers, where nothing is nearer; segments that reach behind the camera are left out.

    :param width: of the line at a depth of 1 m, pixels.
    """
    rows, columns = cover.shape
    for k in range(screen.shape[0] - 1):
        ax, ay, az = screen[k]
        bx, by, bz = screen[k + 1]
        if az < NEAR or bz < NEAR:
            continue
        thick = max(width / az, width / bz, 1.8)
        reach = 0.5 * thick + 1.0
        left, right = max(int(min(ax, bx) - reach), 0), min(int(max(ax, bx) + reach) + 1, columns)
        top, bottom = max(int(min(ay, by) - reach), 0), min(int(max(ay, by) + reach) + 1, rows)
        dx, dy = bx - ax, by - ay
        length2 = dx * dx + dy * dy
        for i in range(top, bottom):
            for j in range(left, right):
                px, py = j + 0.5 - ax, i + 0.5 - ay
                along = min(max((px * dx + py * dy) / length2, 0.0), 1.0) if length2 > 0.0 else 0.0
                away = math.sqrt((px - along * dx) ** 2 + (py - along * dy) ** 2)
                inverse = (1.0 - along) / az + along / bz  # depth is linear in the picture by its inverse
                half = 0.5 * max(width * inverse, 1.8)
                share = min(max(half + 0.5 - away, 0.0), 1.0)
                if share > 0.0:
                    seen = 0
                    for m in range(samples):
                        for n in range(samples):
                            seen += depth[samples * i + m, samples * j + n] * inverse > 1.0
                    share *= seen / (samples * samples)
                    cover[i, j] = max(cover[i, j], share)
