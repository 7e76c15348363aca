"""Pictures of a vehicle, its target and trails over a chequered ground, drawn by Pillow.

PyBullet's software renderer takes thirty times as long, nearly all of it for the ground.
"""

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from PIL import Image as Pillow
from PIL import ImageDraw

from sb3_quad.base.types import FloatArray
from sb3_quad.envs.rendering.camera import Camera
from sb3_quad.envs.simulation.state import POSITION, QUATERNION, TARGET, rotation_matrices
from sb3_quad.envs.vehicles.vehicle import Vehicle

Colour: TypeAlias = tuple[int, int, int]

FRONT = (237, 82, 26)
DARK = (33, 36, 43)
MARKER = (26, 184, 71)
# Colours of both kinds of tiles, and of the sky
GROUND = [239, 239, 239, 162, 186, 224, 214, 228, 243]
SKY = 2
TILE = 5.0  # side of a tile of the ground, m
REFERENCE_ARM = 0.24  # of the default vehicle, m
BALL = 0.08  # radius of a target, m, for a vehicle of the default size
NEAR = 0.05  # distances between which things are drawn, m
FAR = 120.0
LINE = 0.006  # width of a trail, in heights of the picture
CORNERS = 32  # of a rotor's disc


class Trail(NamedTuple):
    """The line that a vehicle has flown along."""

    points: FloatArray  # (n, 3), m, world frame
    colour: str | Colour  # as Pillow takes it, such as #rrggbb


def relative_size(vehicle: Vehicle) -> float:
    """Return the size of a vehicle relative to the default one; distances in pictures scale with
    it.
    """
    return vehicle.arm_length / REFERENCE_ARM


def rotor_radius(vehicle: Vehicle) -> float:
    """Return the radius at which neighbouring rotors are drawn just clear of each other, m."""
    pairs = itertools.combinations(vehicle.rotor_positions, 2)
    return 0.44 * min(itertools.starmap(math.dist, pairs))


def draw(
    vehicle: Vehicle, state: FloatArray, camera: Camera, trails: Sequence[Trail] = ()
) -> Pillow.Image:
    """Return the picture of a vehicle in its ``state``, (STATE_SIZE,), of its target, and of trails
    over both.
    """
    picture = _ground(camera)
    pen = ImageDraw.Draw(picture)
    _draw_ball(pen, state[TARGET], BALL * relative_size(vehicle), MARKER, camera)
    _draw_vehicle(pen, vehicle, state, camera)
    for trail in trails:
        _draw_trail(pen, trail, camera)
    return picture


def _ground(camera: Camera) -> Pillow.Image:
    """Return the picture of ground and sky."""
    width, height, slope = camera.lens
    forward, right, up = camera.axes.astype(np.float32)
    eye = camera.eye.astype(np.float32)
    # A pixel is this wide at a depth of 1 m.
    pixel = np.float32(2.0 * slope / height)
    columns = pixel * (np.arange(width, dtype=np.float32) + 0.5 - width / 2)
    rows = pixel * (np.arange(height, dtype=np.float32) + 0.5 - height / 2)
    rays = forward - np.outer(rows, up)
    # The camera does not roll, so all points of a row have the same depth.
    is_near = rays[:, 2] < -eye[2] / FAR
    depth = -eye[2] / rays[is_near, 2]
    number = np.zeros((depth.size, width), np.uint16)
    for axis in range(2):
        middle = (eye[axis] + depth * rays[is_near, axis]) / TILE
        aside = np.outer(depth / TILE, columns * right[axis])
        # Conversion to whole numbers rounds down where all are positive.
        number += (aside + (middle + 4096.0)[:, None]).astype(np.uint16)
    colours = np.full((height, width), SKY, np.uint8)
    colours[is_near] = number & 1
    picture = Pillow.fromarray(colours)
    picture.putpalette(GROUND)
    return picture.convert("RGB")


def _draw_vehicle(
    pen: ImageDraw.ImageDraw, vehicle: Vehicle, state: FloatArray, camera: Camera
) -> None:
    """Draw a hub, a beam to each rotor, and over them the discs that the rotors sweep."""
    arm = vehicle.arm_length
    position = state[POSITION]
    rotation = rotation_matrices(state[QUATERNION][None])[0]
    turn = np.linspace(0.0, 2.0 * np.pi, CORNERS)
    circle = rotor_radius(vehicle) * np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], axis=1)
    discs = []
    for x, y in vehicle.rotor_positions:
        outline = circle + np.array([x, y, 0.15 * arm])
        points = camera.project(position + outline @ rotation.T)
        discs.append((points, FRONT if x > 0.0 else DARK))
    # What is farther away is drawn first.
    discs.sort(key=lambda disc: -disc[0][:, 2].mean())
    for x, y in vehicle.rotor_positions:
        beam = np.stack([position, position + rotation @ (x, y, 0.15 * arm)])
        _draw_trail(pen, Trail(beam, DARK), camera)
    _draw_ball(pen, position, 0.3 * arm, DARK, camera)
    for points, colour in discs:
        pen.polygon(points[:, :2].ravel().tolist(), colour, DARK)


def _draw_ball(
    pen: ImageDraw.ImageDraw, middle: FloatArray, radius: float, colour: Colour, camera: Camera
) -> None:
    """Draw a ball of a radius in m around ``middle``, (3,)."""
    column, row, depth = camera.project(middle[None])[0]
    if depth > NEAR:
        pixels = max(1.0, radius * camera.lens.height / (2.0 * camera.lens.slope * depth))
        pen.ellipse([column - pixels, row - pixels, column + pixels, row + pixels], colour)


def _draw_trail(pen: ImageDraw.ImageDraw, trail: Trail, camera: Camera) -> None:
    """Draw a trail, except for what is behind the camera."""
    width = max(2, round(LINE * camera.lens.height))
    screen = camera.project(trail.points)
    is_ahead = screen[:, 2] > NEAR
    for k in np.flatnonzero(is_ahead[:-1] & is_ahead[1:]):
        pen.line(screen[k : k + 2, :2].ravel().tolist(), trail.colour, width)
