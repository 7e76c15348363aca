"""Scenes and their pictures: vehicles in poses, targets and arrows, in a PyBullet client."""

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from PIL import Image as Pillow

from sb3_quad.base.types import FloatArray
from sb3_quad.envs.rendering import models
from sb3_quad.envs.rendering.bullet_client import p
from sb3_quad.envs.rendering.camera import Camera, Lens
from sb3_quad.envs.rendering.models import FRONT, NOWHERE, WHITE, add_body
from sb3_quad.envs.rendering.picture import FAR, NEAR, SUPERSAMPLING, Trail, backdrop, draw_trails
from sb3_quad.envs.rendering.window import Client
from sb3_quad.envs.simulation.state import POSITION, QUATERNION
from sb3_quad.envs.vehicles.vehicle import Vehicle

MARKER = (0.10, 0.72, 0.28, 1.0)
FORCE = (0.86, 0.10, 0.14, 1.0)
TORQUE = (0.55, 0.15, 0.75, 1.0)
REFERENCE_ARM = 0.24  # of the default vehicle, m
# Radius of the rings around a target and of a shadow, m, for a vehicle of the default size
RING = 0.42
# Drawn rotors turn slower than real ones by this factor; in a film, real speeds would seem to stand
# still or turn backwards.
SLOWED = 12.0
# Attitudes of the two hoops of a target, (x, y, z, w)
LENGTHWISE = (0.0, 0.0, 0.0, 1.0)
CROSSWISE = (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))


class Pose(NamedTuple):
    """A vehicle as it is to be drawn: its state, the wrench on it, and how far its rotors have
    turned.
    """

    state: FloatArray  # (STATE_SIZE,)
    # (12,): force in the world frame, force in the body frame, N; torques likewise, N m
    wrench: FloatArray
    rotor_angles: FloatArray  # (4,), rad, without sign


class Scene:
    """Vehicles of one kind, targets, and arrows of wrenches. What it adds to a client has no mass
    and touches nothing.

    :param vehicle: the vehicle to draw.
    :param client: the client to draw in; None: a new one without a display, until :meth:`close`.
    :param n_vehicles: vehicles in the scene; ``n_targets`` likewise.
    :param size: how much larger than life everything is drawn.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        client: Client | None = None,
        n_vehicles: int = 1,
        n_targets: int = 1,
        size: float = 1.0,
    ) -> None:
        client = client or Client()
        self.client = client
        # Distances in pictures are multiples of the scale.
        self.scale = size * vehicle.arm_length / REFERENCE_ARM
        self._vehicles = [_VehicleBodies(vehicle, client, size) for _ in range(n_vehicles)]
        # A target is two crossing hoops, through which a vehicle inside stays visible.
        self._hoops = [
            add_body(client, models.hoop(), RING * self.scale, MARKER) for _ in range(2 * n_targets)
        ]

    def place(self, poses: Sequence[Pose], targets: FloatArray) -> None:
        """Move everything: a pose for each vehicle, and ``targets``, (n_targets, 3)."""
        for pose, vehicle in zip(poses, self._vehicles, strict=True):
            vehicle.place(pose)
        # Only the last vehicle has a shadow: those of all poses would blacken the ground.
        x, y, _ = poses[-1].state[POSITION]
        self._shadow = np.array([x, y, RING * self.scale], np.float32)
        places = itertools.product(targets, (LENGTHWISE, CROSSWISE))
        for hoop, place in zip(self._hoops, places, strict=True):
            self.client.resetBasePositionAndOrientation(hoop, *place)

    def picture(self, camera: Camera, trails: Sequence[Trail] = ()) -> Pillow.Image:
        """Draw the scene."""
        # PyBullet draws the bodies larger, since its edges are hard.
        width, height, slope = camera.lens
        larger = camera._replace(lens=Lens(SUPERSAMPLING * width, SUPERSAMPLING * height, slope))
        wide, high, _ = larger.lens
        eye = camera.eye
        forward, _, up = camera.axes
        field_of_view = 2.0 * math.degrees(math.atan(slope))
        _, _, pixels, _, names = self.client.getCameraImage(
            wide,
            high,
            p.computeViewMatrix(eye, eye + forward, up),
            p.computeProjectionMatrixFOV(field_of_view, wide / high, NEAR, FAR),
            lightDirection=np.array([1.2, 0.6, 6.0]) - 3.0 * forward,
            shadow=0,
            lightAmbientCoeff=0.62,
            lightDiffuseCoeff=0.45,
            lightSpecularCoeff=0.08,
            renderer=p.ER_TINY_RENDERER,
        )
        # Without numpy at PyBullet's build time these are flat tuples.
        bodies = np.array(pixels, np.uint8).reshape(high, wide, 4)
        bodies[..., 3] = 255 * (np.reshape(names, (high, wide)) >= 0)
        # Bodies are drawn over trails, and both over the backdrop.
        drawn = Pillow.new("RGBA", (wide, high))
        draw_trails(drawn, trails, larger)
        drawn.alpha_composite(Pillow.fromarray(bodies))
        drawn = drawn.convert("RGBa").reduce(SUPERSAMPLING).convert("RGBA")
        picture = Pillow.fromarray(backdrop(camera, self._shadow))
        picture.paste(drawn, mask=drawn)
        return picture

    def close(self) -> None:
        """Close the client; calling it twice is fine."""
        self.client.close()


class _VehicleBodies:
    """A vehicle and the arrows of the wrench that acts on it."""

    def __init__(self, vehicle: Vehicle, client: Client, size: float) -> None:
        self.move = client.resetBasePositionAndOrientation
        arm = size * vehicle.arm_length
        radius = size * models.rotor_radius(vehicle)
        places = np.array(vehicle.rotor_positions) / vehicle.arm_length
        self.centres = arm * np.column_stack([places, np.full(len(places), 0.17)])
        # A rotor's drag on the body opposes its sense of rotation.
        self.senses = np.negative(vehicle.rotor_directions)
        self.frame = []
        for colour, parts in models.frame(places).items():
            self.frame.append(add_body(client, parts, arm, colour))
        self.rotors = []
        for x, _ in places:
            colour = FRONT if x > 0 else WHITE
            self.rotors.append(add_body(client, models.rotor(), radius, colour))
        self.arrows = [
            add_body(client, models.arrow(), 2.1 * arm, FORCE),
            add_body(client, models.arrow(), 1.7 * arm, TORQUE),
        ]

    def place(self, pose: Pose) -> None:
        """Move it."""
        position = pose.state[POSITION]
        # PyBullet's quaternions end with w.
        attitude = np.roll(pose.state[QUATERNION], -1)
        for body in self.frame:
            self.move(body, position, attitude)
        turned = self.senses * pose.rotor_angles / SLOWED
        for body, centre, angle in zip(self.rotors, self.centres, turned, strict=True):
            spin = p.getQuaternionFromEuler((0.0, 0.0, angle))
            self.move(body, *p.multiplyTransforms(position, attitude, centre, spin))
        # The wrench has a part in the world frame and one in the body frame.
        wrench = pose.wrench.reshape(2, 2, 3)
        for body, (in_world, in_body) in zip(self.arrows, wrench, strict=True):
            x, y, z = in_world + p.rotateVector(attitude, in_body)
            tilt = math.atan2(math.hypot(x, y), z)
            along = p.getQuaternionFromEuler((0.0, tilt, math.atan2(y, x)))
            self.move(body, position if any((x, y, z)) else NOWHERE, along)
