"""A scene of its own for pictures of recorded flights: vehicles in poses, targets, arrows and trails."""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import pybullet as p

from sb3_quad.drawing.backdrop import Camera
from sb3_quad.drawing.lines import draw_line
from sb3_quad.drawing.scenery import RING, DrawnTarget, DrawnVehicle, DrawnWrench, scale_of, take_picture
from sb3_quad.simulation.state import POSITION
from sb3_quad.vehicles.vehicle import Vehicle

FloatArray = npt.NDArray[np.float64]
Colour: TypeAlias = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Pose:
    """A vehicle as it is to be drawn.

    :param state: (STATE_SIZE,); ``wrench`` that acts on it, (12,).
    :param rotor_angles: (4,), rad.
    """

    state: FloatArray
    wrench: FloatArray
    rotor_angles: FloatArray


@dataclass(frozen=True, eq=False)
class Trail:
    """A line through ``points``, (n, 3), world frame, m; ``width`` in m."""

    points: FloatArray
    colour: Colour
    width: float = 0.03
    opacity: float = 1.0


@dataclass(frozen=True, eq=False)
class Scene:
    """What is to be seen: vehicles, targets (k, 3), and lines."""

    poses: Sequence[Pose]
    targets: FloatArray
    trails: Sequence[Trail] = field(default_factory=tuple)


class Stage:
    """Draws scenes without a display.

    :param vehicle: that is drawn.
    :param n_vehicles: at most in a scene; ``n_targets`` likewise.
    :param size: how much larger than life vehicles, targets and arrows are drawn.
    """

    def __init__(self, vehicle: Vehicle, n_vehicles: int = 1, n_targets: int = 1, size: float = 1.0) -> None:
        self.client = int(p.connect(p.DIRECT))
        # Also runs when the object is forgotten without close(): PyBullet's clients are limited.
        self._close = weakref.finalize(self, p.disconnect, self.client)
        self.scale = size * scale_of(vehicle)
        self.vehicles = [DrawnVehicle(vehicle, self.client, size=size) for _ in range(n_vehicles)]
        self.wrenches = [DrawnWrench(self.client, self.scale) for _ in range(n_vehicles)]
        self.targets = [DrawnTarget(self.client, self.scale) for _ in range(n_targets)]

    def picture(self, scene: Scene, camera: Camera, field_of_view: float, width: int, height: int) -> npt.NDArray[np.uint8]:
        """Draw a scene: uint8 (height, width, 3); ``field_of_view`` vertical, rad, the camera's."""
        positions = np.array([pose.state[POSITION] for pose in scene.poses])
        for vehicle, wrench in zip(self.vehicles[len(scene.poses) :], self.wrenches[len(scene.poses) :], strict=True):
            vehicle.hide()
            wrench.hide()
        for pose, vehicle, wrench in zip(scene.poses, self.vehicles, self.wrenches, strict=False):
            vehicle.place(pose.state, pose.rotor_angles)
            wrench.place(pose.state, pose.wrench)
        for drawn, target in zip(self.targets, scene.targets, strict=True):
            drawn.place(target, positions)
        discs = [vehicle.rotor_discs(pose.state) for pose, vehicle in zip(scene.poses, self.vehicles, strict=False)]
        shadows = [[*positions[-1, :2], self.vehicles[0].span]]  # all of them would blacken the ground
        shadows += [[*target[:2], RING * self.scale] for target in scene.targets]
        picture = take_picture(self.client, camera, field_of_view, width, height, np.array(shadows), np.concatenate(discs))
        for trail in scene.trails:
            draw_line(picture, camera, trail.points, trail.colour, trail.width, trail.opacity)
        return picture.pixels

    def close(self) -> None:
        """Give the simulation back; calling it twice is fine."""
        self._close()
