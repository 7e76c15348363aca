"""Scenes, and pictures of them: vehicles in poses, their targets and arrows, in a PyBullet client."""

import math
import weakref
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from PIL import Image as Pillow

from sb3_quad.base.arrays import FloatArray, Image
from sb3_quad.base.bullet import p
from sb3_quad.envs.rendering import models
from sb3_quad.envs.rendering.camera import Camera
from sb3_quad.envs.rendering.models import FRONT, NOWHERE, WHITE, Colour, add_body, move_body
from sb3_quad.envs.rendering.picture import FAR, NEAR, SUPERSAMPLING, Trail, backdrop, draw_trails
from sb3_quad.simulation.state import POSITION, QUATERNION, QuadcopterState
from sb3_quad.vehicles.vehicle import Vehicle

MARKER: Colour = (0.10, 0.72, 0.28, 1.0)
FORCE: Colour = (0.86, 0.10, 0.14, 1.0)
TORQUE: Colour = (0.55, 0.15, 0.75, 1.0)
REFERENCE_ARM = 0.24  # of the default vehicle, m
RING = 0.42  # radius of the rings around a target, m, for a vehicle of the default one's size


class Pose(NamedTuple):
    """A vehicle as it is to be drawn: its state, the wrench that acts on it, and the angles of its
    rotors.
    """

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
        self.client = int(p.connect(p.DIRECT)) if client is None else client
        if (
            client is None
            # Also given back when the object is forgotten without close(): PyBullet's clients are
            # limited
        ):
            self._close = weakref.finalize(self, p.disconnect, self.client)
        self.scale = (
            size * vehicle.arm_length / REFERENCE_ARM
        )  # distances in pictures are multiples of it
        self.span = size * models.span(vehicle)
        self._vehicles = [
            _VehicleBodies(vehicle, self.client, size, self.scale) for _ in range(n_vehicles)
        ]
        ball = [models.Part(p.GEOM_SPHERE, radius=0.14)]
        hoops = [
            models.hoop(RING * self.scale, 0.014 * self.scale, yaw) for yaw in (0.0, math.pi / 2)
        ]
        self._balls = [add_body(ball, MARKER, self.client) for _ in range(n_targets)]
        self._hoops = [
            [add_body(parts, MARKER, self.client) for parts in hoops] for _ in range(n_targets)
        ]
        self._shadows = np.zeros((0, 3))

    def place(self, poses: Sequence[Pose], targets: FloatArray) -> None:
        """Move everything: a pose for each vehicle, and ``targets``, (n_targets, 3)."""
        positions = np.array([pose.state[POSITION] for pose in poses])
        for pose, vehicle in zip(poses, self._vehicles, strict=True):
            vehicle.place(pose)
        for target, ball, hoops in zip(targets, self._balls, self._hoops, strict=True):
            hidden = (
                np.linalg.norm(positions - target, axis=1) < 0.7 * self.scale
            ).any()  # where it would hide a vehicle
            move_body(self.client, ball, NOWHERE if hidden else target.tolist())
            for hoop in hoops:
                move_body(self.client, hoop, target.tolist())
        shadows = [[*positions[-1, :2], self.span]]  # all of them would blacken the ground
        self._shadows = np.array(shadows + [[*target[:2], RING * self.scale] for target in targets])

    def picture(self, camera: Camera, trails: Sequence[Trail] = ()) -> Image:
        """Draw the scene: uint8 (height, width, 3)."""
        wide, high = SUPERSAMPLING * camera.lens.width, SUPERSAMPLING * camera.lens.height
        forward, _, up = camera.axes
        _, _, pixels, buffer, names = p.getCameraImage(
            wide,
            high,
            p.computeViewMatrix(camera.eye.tolist(), (camera.eye + forward).tolist(), up.tolist()),
            p.computeProjectionMatrixFOV(
                2.0 * math.degrees(math.atan(camera.lens.slope)), wide / high, NEAR, FAR
            ),
            lightDirection=(np.array([1.2, 0.6, 6.0]) - 3.0 * forward).tolist(),
            shadow=0,
            lightAmbientCoeff=0.62,
            lightDiffuseCoeff=0.45,
            lightSpecularCoeff=0.08,
            renderer=p.ER_TINY_RENDERER,
            physicsClientId=self.client,
        )
        # Without numpy at PyBullet's build time these are flat tuples.
        bodies = np.asarray(pixels, dtype=np.uint8).reshape(high, wide, 4).copy()
        bodies[..., 3] = 255 * (np.asarray(names).reshape(high, wide) >= 0)
        depth = (
            FAR
            * NEAR
            / (FAR - (FAR - NEAR) * np.asarray(buffer, dtype=np.float32).reshape(high, wide))
        )
        drawn = Pillow.fromarray(bodies)
        draw_trails(drawn, trails, camera, depth)
        small = np.asarray(drawn.reduce(SUPERSAMPLING), dtype=np.float32)
        behind = 255.0 * backdrop(camera, self._shadows)
        return np.asarray(
            behind + small[..., 3:] / 255.0 * (small[..., :3] - behind) + 0.5, dtype=np.uint8
        )

    def close(self) -> None:
        """Give a client of its own back; calling it twice is fine."""
        self._close()


class _VehicleBodies:
    """A vehicle and the arrows of the wrench that acts on it."""

    def __init__(self, vehicle: Vehicle, client: int, size: float, scale: float) -> None:
        self.client = client
        arm, radius = size * vehicle.arm_length, size * models.rotor_radius(vehicle)
        self.centres = np.array(
            [(size * x, size * y, 0.17 * arm) for x, y in vehicle.rotor_positions]
        )
        colours = [FRONT if x > 0 else WHITE for x, _ in vehicle.rotor_positions]
        self.frame = [
            add_body(parts, colour, client)
            for colour, parts in models.frame(arm, self.centres).items()
        ]
        # A rotor's drag on the body is opposed to its sense of turning.
        rotors = [models.rotor(radius, -0.25 * sense) for sense in vehicle.rotor_directions]
        self.rotors = [
            add_body(parts, colour, client) for parts, colour in zip(rotors, colours, strict=True)
        ]
        self.force = add_body(models.arrow(0.5 * scale, 0.012 * scale), FORCE, client)
        self.torque = add_body(models.arrow(0.4 * scale, 0.012 * scale), TORQUE, client)

    def place(self, pose: Pose) -> None:
        """Move it."""
        position, (w, x, y, z) = pose.state[POSITION].tolist(), pose.state[QUATERNION].tolist()
        rotation = QuadcopterState(pose.state[:, None]).rotation[0]
        for body in self.frame:
            move_body(self.client, body, position, (x, y, z, w))
        for body, centre, angle in zip(
            self.rotors, self.centres.tolist(), pose.rotor_angles.tolist(), strict=True
        ):
            turned = p.getQuaternionFromEuler((0.0, 0.0, angle))
            at, attitude = p.multiplyTransforms(position, (x, y, z, w), centre, turned)
            move_body(self.client, body, at, attitude)
        for body, (in_world, in_body) in zip(
            (self.force, self.torque), pose.wrench.reshape(2, 2, 3), strict=True
        ):
            x, y, z = (in_world + rotation @ in_body).tolist()
            along = p.getQuaternionFromEuler(
                (0.0, math.atan2(math.hypot(x, y), z), math.atan2(y, x))
            )
            move_body(self.client, body, position if any((x, y, z)) else NOWHERE, along)
