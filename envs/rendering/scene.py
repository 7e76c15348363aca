"""Scenes and their pictures: vehicles in poses, targets and arrows, in a PyBullet client."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from PIL import Image as Pillow

from sb3_quad.base.bullet import p
from sb3_quad.base.types import FloatArray, Image
from sb3_quad.envs.rendering import models
from sb3_quad.envs.rendering.camera import Camera
from sb3_quad.envs.rendering.models import FRONT, NOWHERE, WHITE, add_body, move_body
from sb3_quad.envs.rendering.picture import FAR, NEAR, SUPERSAMPLING, Trail, backdrop, draw_trails
from sb3_quad.envs.rendering.window import disconnect
from sb3_quad.simulation.state import POSITION, QUATERNION
from sb3_quad.vehicles.vehicle import Vehicle

MARKER = (0.10, 0.72, 0.28, 1.0)
FORCE = (0.86, 0.10, 0.14, 1.0)
TORQUE = (0.55, 0.15, 0.75, 1.0)
REFERENCE_ARM = 0.24  # of the default vehicle, m
RING = 0.42  # radius of the rings around a target, m, for a vehicle of the default one's size


class Pose(NamedTuple):
    """A vehicle as it is to be drawn: its state, the wrench on it, and the angles of its rotors."""

    state: FloatArray  # (STATE_SIZE,)
    # (12,): force in the world frame, force in the body frame, N; torques likewise, N m
    wrench: FloatArray
    rotor_angles: FloatArray  # (4,), rad


class Scene:
    """Vehicles of one kind, targets, and arrows of wrenches. What it adds to a client has no mass
    and touches nothing.

    :param vehicle: that is drawn.
    :param client: to draw in; None: one without a display, until :meth:`close`.
    :param n_vehicles: in the scene; ``n_targets`` likewise.
    :param size: how much larger than life everything is drawn.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        client: int | None = None,
        n_vehicles: int = 1,
        n_targets: int = 1,
        size: float = 1.0,
    ) -> None:
        if client is None:
            client = int(p.connect(p.DIRECT))
        self.client = client
        # Distances in pictures are multiples of the scale.
        self.scale = size * vehicle.arm_length / REFERENCE_ARM
        self.span = size * models.span(vehicle)
        self._vehicles = [
            _VehicleBodies(vehicle, client, size, self.scale) for _ in range(n_vehicles)
        ]
        # A target is two hoops that cross, through which a vehicle in it is seen.
        self._targets = []
        for _ in range(n_targets):
            hoops = []
            for yaw in (0.0, math.pi / 2):
                hoops.append(add_body(models.hoop(0.043, yaw), RING * self.scale, MARKER, client))
            self._targets.append(hoops)

    def place(self, poses: Sequence[Pose], targets: FloatArray) -> None:
        """Move everything: a pose for each vehicle, and ``targets``, (n_targets, 3)."""
        for pose, vehicle in zip(poses, self._vehicles, strict=True):
            vehicle.place(pose)
        # Only the last vehicle has a shadow: those of all poses would blacken the ground.
        x, y, _ = poses[-1].state[POSITION]
        self._shadow = np.array([x, y, self.span], np.float32)
        for target, hoops in zip(targets.tolist(), self._targets, strict=True):
            for hoop in hoops:
                move_body(self.client, hoop, target)

    def picture(self, camera: Camera, trails: Sequence[Trail] = ()) -> Image:
        """Draw the scene: uint8 (height, width, 3)."""
        # PyBullet draws the bodies larger, since its edges are hard.
        wide = SUPERSAMPLING * camera.lens.width
        high = SUPERSAMPLING * camera.lens.height
        forward, _, up = camera.axes
        field_of_view = 2.0 * math.degrees(math.atan(camera.lens.slope))
        _, _, pixels, buffer, names = p.getCameraImage(
            wide,
            high,
            p.computeViewMatrix(camera.eye.tolist(), (camera.eye + forward).tolist(), up.tolist()),
            p.computeProjectionMatrixFOV(field_of_view, wide / high, NEAR, FAR),
            lightDirection=(np.array([1.2, 0.6, 6.0]) - 3.0 * forward).tolist(),
            shadow=0,
            lightAmbientCoeff=0.62,
            lightDiffuseCoeff=0.45,
            lightSpecularCoeff=0.08,
            renderer=p.ER_TINY_RENDERER,
            physicsClientId=self.client,
        )
        # Without numpy at PyBullet's build time these are flat tuples.
        bodies = np.array(pixels, dtype=np.uint8).reshape(high, wide, 4)
        bodies[..., 3] = 255 * (np.reshape(names, (high, wide)) >= 0)
        buffer = np.asarray(buffer, dtype=np.float32).reshape(high, wide)
        depth = FAR * NEAR / (FAR - (FAR - NEAR) * buffer)
        drawn = Pillow.fromarray(bodies)
        draw_trails(drawn, trails, camera, depth)
        # The bodies lie over the backdrop where they are opaque.
        drawn = drawn.reduce(SUPERSAMPLING)
        picture = Pillow.fromarray(backdrop(camera, self._shadow))
        picture.paste(drawn, mask=drawn)
        return np.array(picture)

    def close(self) -> None:
        """Give a client of its own back; calling it twice is fine."""
        disconnect(self.client)


class _VehicleBodies:
    """A vehicle and the arrows of the wrench that acts on it."""

    def __init__(self, vehicle: Vehicle, client: int, size: float, scale: float) -> None:
        self.client = client
        arm = size * vehicle.arm_length
        radius = size * models.rotor_radius(vehicle)
        places = np.array(vehicle.rotor_positions) / vehicle.arm_length
        centres = np.column_stack([places, np.full(len(places), 0.17)])
        self.centres = arm * centres
        self.frame = []
        for colour, parts in models.frame(centres).items():
            self.frame.append(add_body(parts, arm, colour, client))
        self.rotors = []
        for (x, _), sense in zip(places, vehicle.rotor_directions, strict=True):
            # A rotor's drag on the body is opposed to its sense of turning.
            blades = models.rotor(-0.25 * sense)
            self.rotors.append(add_body(blades, radius, FRONT if x > 0 else WHITE, client))
        self.force = add_body(models.arrow(0.024), 0.5 * scale, FORCE, client)
        self.torque = add_body(models.arrow(0.03), 0.4 * scale, TORQUE, client)

    def place(self, pose: Pose) -> None:
        """Move it."""
        position = pose.state[POSITION].tolist()
        w, x, y, z = pose.state[QUATERNION].tolist()
        attitude = (x, y, z, w)
        for body in self.frame:
            move_body(self.client, body, position, attitude)
        angles = pose.rotor_angles.tolist()
        for body, centre, angle in zip(self.rotors, self.centres.tolist(), angles, strict=True):
            turned = p.getQuaternionFromEuler((0.0, 0.0, angle))
            moved = p.multiplyTransforms(position, attitude, centre, turned)
            move_body(self.client, body, *moved)
        # The wrench has a part in the world frame and one in the body frame.
        wrench = pose.wrench.reshape(2, 2, 3).tolist()
        for body, (in_world, in_body) in zip((self.force, self.torque), wrench, strict=True):
            x, y, z = np.add(in_world, p.rotateVector(attitude, in_body)).tolist()
            tilt = math.atan2(math.hypot(x, y), z)
            along = p.getQuaternionFromEuler((0.0, tilt, math.atan2(y, x)))
            move_body(self.client, body, position if any((x, y, z)) else NOWHERE, along)
