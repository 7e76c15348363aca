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
Disc: TypeAlias = tuple[FloatArray, Colour]  # its outline in the picture, (CORNERS, 3)

FRONT = (237, 82, 26)
DARK = (33, 36, 43)
MARKER = (26, 184, 71)
# Colours of both kinds of tiles, of the ground farther away than FAR, and of the sky
GROUND = [239, 239, 239, 162, 186, 224, 200, 213, 232, 214, 228, 243]
HAZE, SKY = 2, 3
TILE = 5.0  # side of a tile of the ground, m
REFERENCE_ARM = 0.24  # of the default vehicle, m
BALL = 0.08  # radius of a target, m, for a vehicle of the default size
NEAR = 0.05  # distances between which things are drawn, m
FAR = 120.0
LINE = 0.006  # width of a trail, in heights of the picture
CORNERS = 32  # of a rotor's disc
DARKER = 0.7  # brightness of edges, beams, and what is seen from below


class Trail(NamedTuple):
    """The line that a vehicle has flown along."""

    points: FloatArray  # (n, 3), m, world frame
    colour: str  # as Pillow takes it, such as #rrggbb


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
    target = camera.project(state[TARGET][None])
    is_hidden = (state[TARGET] - state[POSITION]) @ camera.axes[0] > 0.0
    # What is nearer is drawn over the other.
    if not is_hidden:
        _draw_vehicle(pen, vehicle, state, camera)
    _draw_ball(pen, target, BALL * relative_size(vehicle), MARKER, camera)
    if is_hidden:
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
    colours = np.empty((height, width), np.uint8)
    colours[:] = np.where(rays[:, 2:] < 0.0, HAZE, SKY)
    colours[is_near] = number & 1
    picture = Pillow.fromarray(colours)
    picture.putpalette(GROUND)
    return picture.convert("RGB")


def _draw_vehicle(
    pen: ImageDraw.ImageDraw, vehicle: Vehicle, state: FloatArray, camera: Camera
) -> None:
    """Draw a hub, and for each rotor a beam and the disc that it sweeps."""
    arm = vehicle.arm_length
    position = state[POSITION]
    rotation = rotation_matrices(state[QUATERNION][None])[0]
    turn = np.linspace(0.0, 2.0 * np.pi, CORNERS, endpoint=False)
    circle = rotor_radius(vehicle) * np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], axis=1)
    middle = camera.project(position[None])
    discs = []
    for x, y in vehicle.rotor_positions:
        rotor = np.array([x, y, 0.15 * arm])
        outline = camera.project(position + (rotor + circle) @ rotation.T)
        discs.append((outline, FRONT if x > 0.0 else DARK))
    # What is farther away is drawn first.
    discs.sort(key=lambda disc: -disc[0][:, 2].mean())
    is_above = (camera.eye - position) @ rotation[:, 2] > 0.0
    if is_above:
        _draw_frame(pen, discs, middle, arm, camera)
    for outline, colour in discs:
        shade = colour if is_above else _darker(colour)
        pen.polygon(outline[:, :2].ravel().tolist(), shade, _darker(shade))
    if not is_above:
        _draw_frame(pen, discs, middle, arm, camera)


def _draw_frame(
    pen: ImageDraw.ImageDraw, discs: list[Disc], middle: FloatArray, arm: float, camera: Camera
) -> None:
    """Draw a hub at ``middle``, in the picture, and beams to the discs."""
    width = max(1, round(_pixels(0.1 * arm, middle, camera)))
    for outline, colour in discs:
        rotor = outline.mean(axis=0, keepdims=True)
        ends = np.concatenate([middle, rotor])[:, :2]
        pen.line(ends.ravel().tolist(), _darker(colour), width)
    _draw_ball(pen, middle, 0.25 * arm, DARK, camera)


def _draw_ball(
    pen: ImageDraw.ImageDraw, middle: FloatArray, radius: float, colour: Colour, camera: Camera
) -> None:
    """Draw a ball of a radius in m whose ``middle``, in the picture, is (1, 3)."""
    column, row, depth = middle[0]
    if depth > NEAR:
        pen.circle((column, row), max(1.0, _pixels(radius, middle, camera)), colour)


def _pixels(length: float, at: FloatArray, camera: Camera) -> float:
    """Return a length in m in pixels, at a place (1, 3) in the picture."""
    _, height, slope = camera.lens
    return float(length * height / (2.0 * slope * max(at[0, 2], NEAR)))


def _darker(colour: Colour) -> Colour:
    red, green, blue = (int(DARKER * part) for part in colour)
    return red, green, blue


def _draw_trail(pen: ImageDraw.ImageDraw, trail: Trail, camera: Camera) -> None:
    """Draw a trail, except for what is behind the camera."""
    width = max(2, round(LINE * camera.lens.height))
    screen = camera.project(trail.points)
    is_ahead = screen[:, 2] > NEAR
    for k in np.flatnonzero(is_ahead[:-1] & is_ahead[1:]):
        pen.line(screen[k : k + 2, :2].ravel().tolist(), trail.colour, width)
