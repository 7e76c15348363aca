"""What PyBullet's software renderer cannot draw, by ray casting: sky, chequered ground with shadows, turning rotors.

Points and vectors are in the world frame, m; colours are red, green, blue in [0, 1]; row 0 of a picture is its top.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

FloatArray = npt.NDArray[np.float64]

SKY_HORIZON = (0.87, 0.92, 0.96)
SKY_ZENITH = (0.36, 0.58, 0.86)
GROUND_LIGHT = (0.61, 0.69, 0.55)
GROUND_DARK = (0.50, 0.60, 0.46)
SQUARE = 2.0  # side of the ground's squares, m
SHADOW = 0.45  # share of the light that a shadow takes
VISIBILITY = 90.0  # distance at which 1/e of the ground is still seen through the haze, m


@dataclass(frozen=True)
class Camera:
    """A pinhole camera.

    :param eye: where it is, (3,).
    :param axes: forward, right and up, (3, 3), a unit vector per row.
    :param slope: tangent of half the vertical field of view.
    """

    eye: FloatArray
    axes: FloatArray
    slope: float

    @staticmethod
    def looking_at(eye: FloatArray, point: FloatArray, field_of_view: float) -> Camera:
        """A camera without roll; ``field_of_view`` vertical, rad; ``point`` not straight above or below ``eye``."""
        forward = (point - eye) / np.linalg.norm(point - eye)
        right = np.cross(forward, (0.0, 0.0, 1.0))
        right /= np.linalg.norm(right)
        return Camera(eye, np.stack([forward, right, np.cross(right, forward)]), math.tan(field_of_view / 2))


@njit(cache=True, error_model="numpy")
def compose(samples, names, depth, eye, axes, slope, shadows, discs, out):
    """Draw what PyBullet has drawn before sky and ground, and translucent rotors over it.

    :param samples: uint8 (s height, s width, 4), PyBullet's colours, s samples per pixel and direction.
    :param names: int32 (s height, s width), not negative where PyBullet has drawn something.
    :param depth: float64 or float32 (s height, s width), its distance along the camera's forward, m.
    :param shadows: (k, 3), centre x, y and radius of each.
    :param discs: (k, 10), centre, unit normal, radius and colour of each, the farthest first.
    :param out: uint8 (height, width, 3).
    """
    height, width = out.shape[0], out.shape[1]
    s = samples.shape[0] // height
    colour = np.empty(3)
    for row in range(height):
        y = (height - 1.0 - 2.0 * row) / height * slope
        for column in range(width):
            x = (2.0 * column + 1.0 - width) / height * slope
            rx = axes[0, 0] + x * axes[1, 0] + y * axes[2, 0]
            ry = axes[0, 1] + x * axes[1, 1] + y * axes[2, 1]
            rz = axes[0, 2] + x * axes[1, 2] + y * axes[2, 2]
            _behind(rx, ry, rz, eye, 2.0 * slope / height, shadows, colour)
            red, green, blue, solid = 0.0, 0.0, 0.0, 0
            nearest = np.inf
            for i in range(s * row, s * row + s):
                for j in range(s * column, s * column + s):
                    if names[i, j] >= 0:
                        red += samples[i, j, 0]
                        green += samples[i, j, 1]
                        blue += samples[i, j, 2]
                        solid += 1
                        nearest = min(nearest, depth[i, j])
            empty = 1.0 - solid / (s * s)
            share = 1.0 / (255.0 * s * s)
            colour[0] = empty * colour[0] + share * red
            colour[1] = empty * colour[1] + share * green
            colour[2] = empty * colour[2] + share * blue
            for k in range(discs.shape[0]):
                opacity = _opacity(rx, ry, rz, eye, discs[k], nearest)
                for channel in range(3):
                    colour[channel] += opacity * (discs[k, 7 + channel] - colour[channel])
            for channel in range(3):
                out[row, column, channel] = np.uint8(min(max(255.0 * colour[channel] + 0.5, 0.0), 255.0))


@njit(cache=True, error_model="numpy")
def _behind(rx, ry, rz, eye, pixel, shadows, colour):
    """The colour of sky or ground in the direction of a ray; ``pixel``: the angle a pixel covers, rad."""
    length = math.sqrt(rx * rx + ry * ry + rz * rz)
    if rz > -1e-4 or eye[2] <= 0.0:
        rise = min(max(1.6 * rz / length, 0.0), 1.0)
        for channel in range(3):
            colour[channel] = SKY_HORIZON[channel] + rise * (SKY_ZENITH[channel] - SKY_HORIZON[channel])
        return
    x, y = eye[0] - eye[2] / rz * rx, eye[1] - eye[2] / rz * ry
    distance = -eye[2] / rz * length
    # What a pixel covers of the ground, in squares; finer squares blur into their mean instead of flickering.
    footprint = distance * distance / eye[2] * pixel / SQUARE
    soft = max(0.5 * math.pi * footprint, 0.02)
    wave = min(max(math.sin(math.pi * x / SQUARE) / soft, -1.0), 1.0)
    wave *= min(max(math.sin(math.pi * y / SQUARE) / soft, -1.0), 1.0)
    dark = 0.5 + 0.5 * wave * min(max(2.0 - 2.0 * footprint, 0.0), 1.0)
    light = 1.0
    for k in range(shadows.shape[0]):
        away = math.sqrt((x - shadows[k, 0]) ** 2 + (y - shadows[k, 1]) ** 2) / shadows[k, 2]
        light *= 1.0 - SHADOW * min(max(1.8 - 1.6 * away, 0.0), 1.0)
    clear = math.exp(-distance / VISIBILITY)
    for channel in range(3):
        ground = light * (GROUND_LIGHT[channel] + dark * (GROUND_DARK[channel] - GROUND_LIGHT[channel]))
        colour[channel] = SKY_HORIZON[channel] + clear * (ground - SKY_HORIZON[channel])


@njit(cache=True, error_model="numpy")
def _opacity(rx, ry, rz, eye, disc, nearest):
    """How much of a turning rotor's disc a ray meets, where nothing is nearer."""
    slant = disc[3] * rx + disc[4] * ry + disc[5] * rz
    if abs(slant) < 1e-6:
        return 0.0
    cx, cy, cz = disc[0] - eye[0], disc[1] - eye[1], disc[2] - eye[2]
    hit = (disc[3] * cx + disc[4] * cy + disc[5] * cz) / slant
    if hit <= 0.0 or hit >= nearest:
        return 0.0
    ox, oy, oz = hit * rx - cx, hit * ry - cy, hit * rz - cz
    away = (ox * ox + oy * oy + oz * oz) / (disc[6] * disc[6])
    return 0.16 + 0.22 * away * away * away if away < 1.0 else 0.0  # denser at the rim, as a turning rotor looks
