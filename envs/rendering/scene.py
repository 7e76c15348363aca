"""The scene in PyBullet's window: vehicles and their targets over its chequered ground.

What is drawn has no mass and touches nothing.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sb3_quad.base.types import FloatArray
from sb3_quad.envs.rendering.bullet_client import p
from sb3_quad.envs.rendering.picture import (
    BALL,
    DARK,
    FRONT,
    MARKER,
    Colour,
    relative_size,
    rotor_radius,
)
from sb3_quad.envs.rendering.window import Client
from sb3_quad.envs.simulation.state import POSITION, QUATERNION, TARGET
from sb3_quad.envs.vehicles.vehicle import Vehicle

NOWHERE = (0.0, 0.0, -1000.0)


class Part(NamedTuple):
    """A part of a body: a box, or an upright cylinder."""

    shape: int
    at: Sequence[float]  # m
    box: Sequence[float] = (0.0, 0.0, 0.0)  # half of its sides, m
    radius: float = 0.0  # m
    length: float = 0.0
    yaw: float = 0.0  # rad


class Scene:
    """Vehicles of one kind, each with its target, which is a green ball.

    :param vehicle: the vehicle to draw.
    :param client: the window.
    :param n_vehicles: vehicles in the scene.
    """

    def __init__(self, vehicle: Vehicle, client: Client, n_vehicles: int = 1) -> None:
        self.client = client
        self.client.draw_ground()
        self._vehicles = [_add_vehicle(self.client, vehicle) for _ in range(n_vehicles)]
        ball = self.client.createVisualShape(
            p.GEOM_SPHERE, radius=BALL * relative_size(vehicle), rgbaColor=_in_bullet(MARKER)
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
        rgbaColors=[_in_bullet(colour)] * len(parts),
        visualFramePositions=np.array(places).tolist(),
        visualFrameOrientations=attitudes,
    )
    return int(client.createMultiBody(0.0, -1, shape, NOWHERE))


def _in_bullet(colour: Colour) -> list[float]:
    """Return a colour as PyBullet takes it."""
    return [*np.divide(colour, 255.0), 1.0]
