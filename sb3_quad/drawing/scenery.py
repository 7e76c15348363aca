"""What is drawn into a PyBullet client to be looked at: vehicles, targets and arrows, without mass and untouchable."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pybullet as p

from sb3_quad.drawing import meshes
from sb3_quad.drawing.backdrop import Camera, compose
from sb3_quad.drawing.client import load_urdf_text
from sb3_quad.drawing.urdf import FRONT, WHITE, Colour, arm_length, frame_urdfs, rotor_height, rotor_radius, rotor_urdf
from sb3_quad.simulation.state import POSITION, QUATERNION, ROTOR_SPEEDS, QuadcopterState
from sb3_quad.vehicles.vehicle import Vehicle

FloatArray = npt.NDArray[np.float64]

NEAR, FAR = 0.05, 120.0
SUPERSAMPLING = 2  # PyBullet's software renderer draws hard edges
RING = 0.42  # radius of the rings around the target, m, for a vehicle of REFERENCE_ARM
REFERENCE_ARM = 0.24  # m
MARKER: Colour = (0.10, 0.72, 0.28, 1.0)
FORCE: Colour = (0.86, 0.10, 0.14, 1.0)
TORQUE: Colour = (0.55, 0.15, 0.75, 1.0)
SLOWED = 12.0  # the drawn rotors turn that much slower than real ones, which would seem to stand or turn backwards in a film
_NOWHERE = (0.0, 0.0, -1000.0)
_LEVEL = (0.0, 0.0, 0.0, 1.0)


def scale_of(vehicle: Vehicle) -> float:
    """The vehicle's size, in that of the default one; distances in pictures are multiples of it."""
    return arm_length(vehicle) / REFERENCE_ARM


def rotor_turning(vehicle: Vehicle, state: FloatArray) -> FloatArray:
    """How fast the drawn rotors turn about body z, for the columns of ``state``, (STATE_SIZE, n): (4, n), rad/s."""
    return np.asarray(-np.sign(vehicle.rotor_directions)[:, None] * state[ROTOR_SPEEDS] / SLOWED)


class DrawnVehicle:
    """A vehicle to look at.

    :param frame: draw the frame too, not only the rotors (a simulated body may have its own looks).
    :param size: how much larger than life.
    """

    def __init__(self, vehicle: Vehicle, client: int, frame: bool = True, size: float = 1.0) -> None:
        self.vehicle, self.client, self.size = vehicle, client, size
        load = {"useFixedBase": True, "globalScaling": size}
        self.frame = [load_urdf_text(urdf, client, **load) for urdf in frame_urdfs(vehicle)] if frame else []
        self.rotors = [load_urdf_text(rotor_urdf(vehicle, rotor), client, **load) for rotor in range(4)]

    def place(self, state: FloatArray, rotor_angles: FloatArray) -> None:
        """Move it to where ``state``, a column of (STATE_SIZE, n), says, with its rotors turned by (4,) rad."""
        position, (w, x, y, z) = state[POSITION], state[QUATERNION].tolist()
        attitude = (x, y, z, w)
        for body, centre, angle in zip(self.rotors, self._rotor_centres(state), rotor_angles, strict=True):
            _, turned = p.multiplyTransforms(
                _NOWHERE, attitude, _NOWHERE, (0.0, 0.0, math.sin(angle / 2), math.cos(angle / 2))
            )
            move(body, centre.tolist(), turned, self.client)
        for body in self.frame:
            move(body, position.tolist(), attitude, self.client)

    def hide(self) -> None:
        """Take it out of sight."""
        for body in (*self.rotors, *self.frame):
            move(body, _NOWHERE, _LEVEL, self.client)

    def rotor_discs(self, state: FloatArray) -> FloatArray:
        """Centre, normal, radius and colour of each rotor's disc; (4, 10)."""
        normal = QuadcopterState(state[:, None]).rotation[0][:, 2]
        radius = self.size * rotor_radius(self.vehicle)
        discs = [
            [*centre, *normal, radius, *(FRONT if x > 0 else WHITE)[:3]]
            for centre, (x, _) in zip(self._rotor_centres(state), self.vehicle.rotor_positions, strict=True)
        ]
        return np.array(discs)

    @property
    def span(self) -> float:
        """Radius of the vehicle with its rotors, m."""
        return self.size * (arm_length(self.vehicle) + rotor_radius(self.vehicle))

    def _rotor_centres(self, state: FloatArray) -> FloatArray:
        offsets = np.column_stack([self.vehicle.rotor_positions, np.full(4, rotor_height(self.vehicle))])
        return np.asarray(state[POSITION] + self.size * offsets @ QuadcopterState(state[:, None]).rotation[0].T)


class DrawnTarget:
    """A target to look at: a ball, and rings around it, which stay when the vehicle is there.

    :param scale: of the vehicle, see :func:`scale_of`.
    """

    def __init__(self, client: int, scale: float) -> None:
        self.client, self.scale = client, scale
        self.ball = _add(p.createVisualShape(p.GEOM_SPHERE, radius=0.14, rgbaColor=MARKER, physicsClientId=client), client)
        self.rings = [_add_mesh(meshes.ring(RING * scale, 0.014 * scale), MARKER, client) for _ in range(2)]

    def place(self, target: FloatArray, positions: FloatArray) -> None:
        """Move it to ``target``, (3,); close to one of the vehicles at ``positions``, (n, 3), the ball would hide it."""
        near = (np.linalg.norm(positions - target, axis=1) < 0.7 * self.scale).any()
        move(self.ball, _NOWHERE if near else target.tolist(), _LEVEL, self.client)
        for ring, axis in zip(self.rings, ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)), strict=True):
            move(ring, target.tolist(), from_z_to(np.array(axis)), self.client)


class DrawnWrench:
    """Arrows of a force and a torque at a vehicle."""

    def __init__(self, client: int, scale: float) -> None:
        self.client = client
        self.force = _add_mesh(meshes.arrow(0.5 * scale, 0.012 * scale), FORCE, client)
        self.torque = _add_mesh(meshes.arrow(0.4 * scale, 0.012 * scale), TORQUE, client)

    def place(self, state: FloatArray, wrench: FloatArray) -> None:
        """Lay the arrows of ``wrench``, (12,), at a column of ``state``; one that is zero is hidden.

        The rows of a wrench: force in the world frame, force in the body frame, torques likewise.
        """
        rotation = QuadcopterState(state[:, None]).rotation[0]
        self._point(self.force, state[POSITION], wrench[0:3] + rotation @ wrench[3:6])
        self._point(self.torque, state[POSITION], wrench[6:9] + rotation @ wrench[9:12])

    def hide(self) -> None:
        """Take them out of sight."""
        for arrow in (self.force, self.torque):
            move(arrow, _NOWHERE, _LEVEL, self.client)

    def _point(self, arrow: int, position: FloatArray, direction: FloatArray) -> None:
        if not direction.any():
            move(arrow, _NOWHERE, _LEVEL, self.client)
        else:
            move(arrow, position.tolist(), from_z_to(direction / np.linalg.norm(direction)), self.client)


class Picture(NamedTuple):
    """A picture, and what lines drawn into it later need to know."""

    pixels: npt.NDArray[np.uint8]
    """(height, width, 3)"""
    depth: npt.NDArray[np.float32]
    """(SUPERSAMPLING height, SUPERSAMPLING width), distance of what is seen along the camera's forward, m"""


def take_picture(
    client: int, camera: Camera, field_of_view: float, width: int, height: int, shadows: FloatArray, discs: FloatArray
) -> Picture:
    """Draw everything in a client, the backdrop behind it and rotors before it.

    :param field_of_view: vertical, rad; the camera's.
    :param shadows: centre x, y and radius of each shadow on the ground, (k, 3).
    :param discs: as of :meth:`DrawnVehicle.rotor_discs`, (n, 10).
    """
    wide, high = SUPERSAMPLING * width, SUPERSAMPLING * height
    forward, _, up = camera.axes
    _, _, pixels, buffer, names = p.getCameraImage(
        wide,
        high,
        p.computeViewMatrix(camera.eye.tolist(), (camera.eye + forward).tolist(), up.tolist()),
        p.computeProjectionMatrixFOV(math.degrees(field_of_view), wide / high, NEAR, FAR),
        lightDirection=(np.array([1.2, 0.6, 6.0]) - 3.0 * forward).tolist(),
        shadow=0,
        lightAmbientCoeff=0.62,
        lightDiffuseCoeff=0.45,
        lightSpecularCoeff=0.08,
        renderer=p.ER_TINY_RENDERER,
        physicsClientId=client,
    )
    # Without numpy at PyBullet's build time these are flat tuples.
    colours = np.asarray(pixels, dtype=np.uint8).reshape(high, wide, 4)
    names = np.asarray(names, dtype=np.int32).reshape(high, wide)
    depth = FAR * NEAR / (FAR - (FAR - NEAR) * np.asarray(buffer, dtype=np.float32).reshape(high, wide))
    farthest_first = discs[np.argsort(-np.linalg.norm(discs[:, :3] - camera.eye, axis=1))]
    picture = np.empty((height, width, 3), dtype=np.uint8)
    compose(colours, names, depth, camera.eye, camera.axes, camera.slope, shadows, farthest_first, picture)
    return Picture(picture, depth)


def move(body: int, position: Sequence[float], quaternion: Sequence[float], client: int) -> None:
    """Move a drawn body; the quaternion is (x, y, z, w), as PyBullet's are."""
    p.resetBasePositionAndOrientation(body, position, quaternion, physicsClientId=client)


def from_z_to(direction: FloatArray) -> tuple[float, float, float, float]:
    """A quaternion (x, y, z, w) that turns the z axis to a unit vector."""
    x, y, z = direction.tolist()
    if z < -0.999999:
        return (1.0, 0.0, 0.0, 0.0)
    norm = math.sqrt(2.0 * (1.0 + z))
    return (-y / norm, x / norm, 0.0, norm / 2.0)


def _add(shape: int, client: int) -> int:
    return int(p.createMultiBody(0.0, -1, shape, _NOWHERE, physicsClientId=client))


def _add_mesh(mesh: meshes.Mesh, colour: Colour, client: int) -> int:
    return _add(p.createVisualShape(p.GEOM_MESH, rgbaColor=colour, physicsClientId=client, **mesh), client)
