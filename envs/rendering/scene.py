"""Scenes and their pictures: vehicles and their targets over PyBullet's chequered ground.

What is drawn has no mass and touches nothing.
"""

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from PIL import Image as Pillow
from PIL import ImageDraw

from sb3_quad.base.types import FloatArray
from sb3_quad.envs.rendering.bullet_client import p
from sb3_quad.envs.rendering.camera import Camera
from sb3_quad.envs.rendering.window import Client
from sb3_quad.envs.simulation.state import POSITION, QUATERNION, TARGET
from sb3_quad.envs.vehicles.vehicle import Vehicle

Colour: TypeAlias = tuple[float, float, float, float]

FRONT = (0.93, 0.32, 0.10, 1.0)
DARK = (0.13, 0.14, 0.17, 1.0)
MARKER = (0.10, 0.72, 0.28, 1.0)
REFERENCE_ARM = 0.24  # of the default vehicle, m
BALL = 0.08  # radius of a target, m, for a vehicle of the default size
NOWHERE = (0.0, 0.0, -1000.0)
NEAR = 0.05  # distances between which bodies are drawn, m
FAR = 120.0
LINE = 0.006  # width of a trail, in heights of the picture


class Part(NamedTuple):
    """A part of a body: a box, or an upright cylinder."""

    shape: int
    at: Sequence[float]  # m
    box: Sequence[float] = (0.0, 0.0, 0.0)  # half of its sides, m
    radius: float = 0.0  # m
    length: float = 0.0
    yaw: float = 0.0  # rad


class Trail(NamedTuple):
    """The line that a vehicle has flown along."""

    points: FloatArray  # (n, 3), m, world frame
    colour: str  # as Pillow takes it, such as #rrggbb


class Scene:
    """Vehicles of one kind, each with its target, which is a green ball.

    :param vehicle: the vehicle to draw.
    :param client: the client to draw in; None: a new one without a display, until :meth:`close`.
    :param n_vehicles: vehicles in the scene.
    """

    def __init__(self, vehicle: Vehicle, client: Client | None = None, n_vehicles: int = 1) -> None:
        self.client = client or Client()
        # Distances in pictures are multiples of the scale.
        self.scale = vehicle.arm_length / REFERENCE_ARM
        self.client.draw_ground()
        self._vehicles = [_add_vehicle(self.client, vehicle) for _ in range(n_vehicles)]
        ball = self.client.createVisualShape(
            p.GEOM_SPHERE, radius=BALL * self.scale, rgbaColor=MARKER
        )
        self._targets = [
            self.client.createMultiBody(0.0, -1, ball, NOWHERE) for _ in range(n_vehicles)
        ]

    def place(self, states: FloatArray) -> None:
        """Move everything to the vehicles' states, (STATE_SIZE, n_vehicles)."""
        move = self.client.resetBasePositionAndOrientation
        for state, bodies, target in zip(states.T, self._vehicles, self._targets, strict=True):
            # PyBullet's quaternions end with w.
            attitude = np.roll(state[QUATERNION], -1)
            for body in bodies:
                move(body, state[POSITION], attitude)
            move(target, state[TARGET], (0.0, 0.0, 0.0, 1.0))

    def picture(self, camera: Camera, trails: Sequence[Trail] = ()) -> Pillow.Image:
        """Draw the scene, and trails over it."""
        width, height, slope = camera.lens
        forward, _, up = camera.axes
        field_of_view = 2.0 * math.degrees(math.atan(slope))
        _, _, pixels, *_ = self.client.getCameraImage(
            width,
            height,
            p.computeViewMatrix(camera.eye, camera.eye + forward, up),
            p.computeProjectionMatrixFOV(field_of_view, width / height, NEAR, FAR),
            shadow=0,
            renderer=p.ER_TINY_RENDERER,
        )
        # Without numpy at PyBullet's build time these are a flat tuple.
        rows = np.array(pixels, np.uint8).reshape(height, width, 4)
        picture = Pillow.fromarray(rows).convert("RGB")
        for trail in trails:
            _draw_trail(picture, trail, camera)
        return picture

    def close(self) -> None:
        """Close the client; calling it twice is fine."""
        self.client.close()


def _add_vehicle(client: Client, vehicle: Vehicle) -> list[int]:
    """Add a vehicle out of sight; return the numbers of its bodies: its front and its rear.

    A body in PyBullet's window can have only one colour.
    """
    arm = vehicle.arm_length
    radius = rotor_radius(vehicle)
    front: list[Part] = []
    rear = [Part(p.GEOM_CYLINDER, (0.0, 0.0, 0.0), radius=0.3 * arm, length=0.2 * arm)]
    for x, y in vehicle.rotor_positions:
        # A beam from the middle to the rotor, and the disc that the rotor sweeps.
        beam = Part(
            p.GEOM_BOX,
            (x / 2, y / 2, 0.0),
            box=(math.hypot(x, y) / 2, 0.05 * arm, 0.04 * arm),
            yaw=math.atan2(y, x),
        )
        disc = Part(p.GEOM_CYLINDER, (x, y, 0.15 * arm), radius=radius, length=0.04 * arm)
        side = front if x > 0 else rear
        side += [beam, disc]
    return [_add_body(client, front, FRONT), _add_body(client, rear, DARK)]


def _add_body(client: Client, parts: Sequence[Part], colour: Colour) -> int:
    """Add a body of at most 16 parts, out of sight; return its number."""
    shapes, places, boxes, radii, lengths, yaws = zip(*parts, strict=True)
    attitudes = [p.getQuaternionFromEuler((0.0, 0.0, yaw)) for yaw in yaws]
    # PyBullet takes lists only; tuples crash it.
    shape = client.createVisualShapeArray(
        shapeTypes=list(shapes),
        halfExtents=np.array(boxes).tolist(),
        radii=list(radii),
        lengths=list(lengths),
        rgbaColors=[colour] * len(parts),
        visualFramePositions=np.array(places).tolist(),
        visualFrameOrientations=attitudes,
    )
    return int(client.createMultiBody(0.0, -1, shape, NOWHERE))


def rotor_radius(vehicle: Vehicle) -> float:
    """Return the radius at which neighbouring rotors are drawn just clear of each other, m."""
    pairs = itertools.combinations(vehicle.rotor_positions, 2)
    return 0.44 * min(itertools.starmap(math.dist, pairs))


def _draw_trail(picture: Pillow.Image, trail: Trail, camera: Camera) -> None:
    """Draw a trail into a picture taken by ``camera``, except for what is behind it."""
    draw = ImageDraw.Draw(picture)
    width = max(2, round(LINE * picture.height))
    screen = camera.project(trail.points)
    is_ahead = screen[:, 2] > NEAR
    for k in np.flatnonzero(is_ahead[:-1] & is_ahead[1:]):
        draw.line(screen[k : k + 2, :2].ravel().tolist(), trail.colour, width)
