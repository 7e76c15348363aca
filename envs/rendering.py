"""Pictures of a flight: a camera that follows the vehicle towards its target, in a window or as arrays."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import pybullet as p

from sb3_quad.dynamics.state import POSITION, QUATERNION, ROTOR_SPEEDS, TARGET, QuadcopterState
from sb3_quad.dynamics.vehicle import Vehicle
from sb3_quad.envs import meshes
from sb3_quad.envs.backdrop import Camera, compose
from sb3_quad.envs.bullet import BulletBody, load_urdf_text
from sb3_quad.envs.urdf import FRONT, WHITE, Colour, arm_length, frame_urdfs, rotor_height, rotor_radius, rotor_urdf

FloatArray = npt.NDArray[np.float64]

RENDER_MODES = ("human", "rgb_array")
FIELD_OF_VIEW = math.radians(54.0)  # vertical
ELEVATIONS = math.radians(-45.0), math.radians(52.0)
ELEVATION_AT_TARGET = math.radians(-8.0)
NEAR, FAR = 0.05, 120.0
SUPERSAMPLING = 2  # PyBullet's software renderer draws hard edges
WINDOW_FPS = 25.0  # frames a second; PyBullet's window lets the simulation wait for each
RING = 0.42  # radius of the rings around the target, m
MARKER: Colour = (0.10, 0.72, 0.28, 1.0)
FORCE: Colour = (0.86, 0.10, 0.14, 1.0)
TORQUE: Colour = (0.55, 0.15, 0.75, 1.0)
_NOWHERE = (0.0, 0.0, -1000.0)
_LEVEL = (0.0, 0.0, 0.0, 1.0)


class Renderer:
    """Draws one vehicle, its target and the wrench that acts on it.

    What it adds to the simulation has no mass and touches nothing, so that a flight is the same with and without it.

    :param body: the simulation. If it has a window, that is drawn into, in real time; else it must have its looks.
    :param width: of the pictures, pixels; ``height`` likewise.
    """

    def __init__(self, vehicle: Vehicle, body: BulletBody, width: int, height: int) -> None:
        self.vehicle, self.body, self.client = vehicle, body, body.client
        self.width, self.height, self.human = width, height, body.has_window
        self.scale = arm_length(vehicle) / 0.24  # all distances below suit a vehicle of the default one's size
        self.rotor_angles = np.zeros(4)
        self.direction = np.array([1.0, 0.0, 0.0])  # of the camera: course (x, y) and elevation, rad
        self.shown_at = time.perf_counter()
        self.frames_due = 1.0
        self.frame: list[int] = []
        if self.human:
            self._furnish_window()
        self.rotors = [self._load(rotor_urdf(vehicle, rotor)) for rotor in range(4)]
        self.ball = self._add(p.createVisualShape(p.GEOM_SPHERE, radius=0.14, rgbaColor=MARKER, physicsClientId=self.client))
        self.rings = [self._add_mesh(meshes.ring(RING * self.scale, 0.014), MARKER) for _ in range(2)]
        self.force_arrow = self._add_mesh(meshes.arrow(0.5 * self.scale, 0.012 * self.scale), FORCE)
        self.torque_arrow = self._add_mesh(meshes.arrow(0.4 * self.scale, 0.012 * self.scale), TORQUE)
        if self.human:
            p.configureDebugVisualizer(p.COV_ENABLE_RENDERING, 1, physicsClientId=self.client)

    def reset(self, state: FloatArray) -> None:
        """A new episode: the camera jumps to column 0 of ``state``, (STATE_SIZE, n)."""
        self.rotor_angles[:] = 0.0
        self.direction[:] = 1.0, 0.0, ELEVATION_AT_TARGET
        self._turn_camera(state, 1.0)
        self._place(state, np.zeros(12))

    def render(self, state: FloatArray, wrench: FloatArray) -> npt.NDArray[np.uint8] | None:
        """Draw column 0 of ``state``, (STATE_SIZE, n), and of ``wrench``, (12, n).

        :return: uint8 (height, width, 3); None in human mode.
        """
        self._turn_camera(state, 0.04)
        # The drawn rotors turn slower than the real ones, which would seem to stand or to turn backwards in a film.
        turning = -np.sign(self.vehicle.rotor_directions) * state[ROTOR_SPEEDS, 0]
        self.rotor_angles += turning * self.vehicle.control_step / 12.0
        if self.human:
            self._show(state, wrench)
            return None
        self._place(state, wrench[:, 0])
        return self._picture(state)

    def _place(self, state: FloatArray, wrench: FloatArray) -> None:
        """Move all that is only drawn to where it belongs."""
        position, target = state[POSITION, 0], state[TARGET, 0]
        attitude = _xyzw(state)
        rotation = QuadcopterState(state[:, :1]).rotation[0]
        for body, centre, angle in zip(self.rotors, self._rotor_centres(position, rotation), self.rotor_angles, strict=True):
            _, turned = p.multiplyTransforms(
                _NOWHERE, attitude, _NOWHERE, (0.0, 0.0, math.sin(angle / 2), math.cos(angle / 2))
            )
            self._move(body, centre.tolist(), turned)
        for body in self.frame:
            self._move(body, position.tolist(), attitude)
        # Close to the target the ball would hide the vehicle; the rings around it stay.
        near = float(np.linalg.norm(position - target)) < 0.7 * self.scale
        self._move(self.ball, _NOWHERE if near else target.tolist(), _LEVEL)
        for ring, axis in zip(self.rings, ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)), strict=True):
            self._move(ring, target.tolist(), _from_z_to(np.array(axis)))
        self._point(self.force_arrow, position, wrench[0:3] + rotation @ wrench[3:6])
        self._point(self.torque_arrow, position, wrench[6:9] + rotation @ wrench[9:12])

    def _rotor_centres(self, position: FloatArray, rotation: FloatArray) -> FloatArray:
        offsets = np.column_stack([self.vehicle.rotor_positions, np.full(4, rotor_height(self.vehicle))])
        return np.asarray(position + offsets @ rotation.T)

    def _camera(self, state: FloatArray) -> Camera:
        """Behind the vehicle as seen from its target and a little aside, so that both are in the picture."""
        position, target = state[POSITION, 0], state[TARGET, 0]
        level = np.array([*self.direction[:2], 0.0])
        aside = np.array([level[1], -level[0], 0.0])
        sine, cosine = math.sin(self.direction[2]), math.cos(self.direction[2])
        ahead = cosine * level + np.array([0.0, 0.0, sine])
        above = -sine * level + np.array([0.0, 0.0, cosine])
        over = 0.4 - 0.75 * max(float(self.direction[2]), 0.0)  # a target far above is seen past the vehicle from below
        eye = position + self.scale * (-1.3 * ahead + 0.35 * aside + over * above)
        eye[2] = max(eye[2], 0.15)
        to_vehicle = _unit(position - eye, ahead)
        point = eye + to_vehicle + _unit(target - eye, to_vehicle)
        if np.hypot(*(point - eye)[:2]) < 0.05:  # straight up or down has no horizon
            point = point + 0.1 * level
        return Camera.looking_at(eye, point, FIELD_OF_VIEW)

    def _turn_camera(self, state: FloatArray, share: float) -> None:
        """Turn towards the target by ``share`` of the angle; at the target, keep the course and level out."""
        error = state[TARGET, 0] - state[POSITION, 0]
        away = float(np.linalg.norm(error))
        across = float(np.hypot(*error[:2]))
        elevation = np.clip(math.atan2(error[2], across), *ELEVATIONS) if away > self.scale else ELEVATION_AT_TARGET
        if across > 0.3 * self.scale and away > self.scale:
            course = self.direction[:2] + share * (error[:2] / across - self.direction[:2])
            self.direction[:2] = _unit(course, error[:2] / across)
        self.direction[2] += share * (elevation - self.direction[2])

    def _picture(self, state: FloatArray) -> npt.NDArray[np.uint8]:
        camera = self._camera(state)
        width, height = SUPERSAMPLING * self.width, SUPERSAMPLING * self.height
        forward, _, up = camera.axes
        _, _, pixels, buffer, names = p.getCameraImage(
            width,
            height,
            p.computeViewMatrix(camera.eye.tolist(), (camera.eye + forward).tolist(), up.tolist()),
            p.computeProjectionMatrixFOV(math.degrees(FIELD_OF_VIEW), width / height, NEAR, FAR),
            lightDirection=(np.array([1.2, 0.6, 6.0]) - 3.0 * forward).tolist(),
            shadow=0,
            lightAmbientCoeff=0.62,
            lightDiffuseCoeff=0.45,
            lightSpecularCoeff=0.08,
            renderer=p.ER_TINY_RENDERER,
            physicsClientId=self.client,
        )
        # Without numpy at PyBullet's build time these are flat tuples.
        colours = np.asarray(pixels, dtype=np.uint8).reshape(height, width, 4)
        names = np.asarray(names, dtype=np.int32).reshape(height, width)
        depth = FAR * NEAR / (FAR - (FAR - NEAR) * np.asarray(buffer, dtype=np.float32).reshape(height, width))
        position, target = state[POSITION, 0], state[TARGET, 0]
        span = arm_length(self.vehicle) + rotor_radius(self.vehicle)
        shadows = np.array([[*position[:2], span], [*target[:2], RING * self.scale]])
        picture = np.empty((self.height, self.width, 3), dtype=np.uint8)
        compose(
            colours, names, depth, camera.eye, camera.axes, camera.slope, shadows, self._rotor_discs(state, camera), picture
        )
        return picture

    def _rotor_discs(self, state: FloatArray, camera: Camera) -> FloatArray:
        """Centre, normal, radius and colour of each rotor's disc, the farthest first; (4, 10)."""
        rotation = QuadcopterState(state[:, :1]).rotation[0]
        centres = self._rotor_centres(state[POSITION, 0], rotation)
        discs = [
            [*centre, *rotation[:, 2], rotor_radius(self.vehicle), *(FRONT if x > 0 else WHITE)[:3]]
            for centre, (x, _) in zip(centres, self.vehicle.rotor_positions, strict=True)
        ]
        return np.array(discs)[np.argsort(-np.linalg.norm(centres - camera.eye, axis=1))]

    def _show(self, state: FloatArray, wrench: FloatArray) -> None:
        """Wait until real time has caught up, and show what is to be seen WINDOW_FPS times a second."""
        self.frames_due += WINDOW_FPS * self.vehicle.control_step
        if self.frames_due >= 1.0:
            self.frames_due %= 1.0
            self._place(state, wrench[:, 0])
            camera = self._camera(state)
            forward = camera.axes[0]
            distance = float(np.linalg.norm(state[POSITION, 0] - camera.eye))
            p.resetDebugVisualizerCamera(
                cameraDistance=distance,
                cameraYaw=math.degrees(math.atan2(forward[1], forward[0])) - 90.0,
                cameraPitch=math.degrees(math.asin(np.clip(forward[2], -0.999, 0.999))),
                cameraTargetPosition=(camera.eye + distance * forward).tolist(),
                physicsClientId=self.client,
            )
            p.configureDebugVisualizer(p.COV_ENABLE_SINGLE_STEP_RENDERING, 1, physicsClientId=self.client)
        self.shown_at += self.vehicle.control_step
        ahead = self.shown_at - time.perf_counter()
        if ahead > 0:
            time.sleep(ahead)
        else:
            self.shown_at -= ahead  # too slow for real time: do not hurry afterwards

    def _furnish_window(self) -> None:
        import pybullet_data

        hidden = (p.COV_ENABLE_RENDERING, p.COV_ENABLE_GUI, p.COV_ENABLE_MOUSE_PICKING, p.COV_ENABLE_KEYBOARD_SHORTCUTS)
        for option in hidden:
            p.configureDebugVisualizer(option, 0, physicsClientId=self.client)
        plane = f"{pybullet_data.getDataPath()}/plane.urdf"
        ground = p.loadURDF(plane, useFixedBase=True, globalScaling=2.0, physicsClientId=self.client)
        p.setCollisionFilterGroupMask(ground, -1, 0, 0, physicsClientId=self.client)
        p.changeVisualShape(ground, -1, specularColor=(0.1, 0.1, 0.1), physicsClientId=self.client)
        # The window draws a link in one colour, and its collision sphere where it has no looks.
        p.changeVisualShape(self.body.body, -1, rgbaColor=(0.0, 0.0, 0.0, 0.0), physicsClientId=self.client)
        self.frame = [self._load(urdf) for urdf in frame_urdfs(self.vehicle)]

    def _load(self, urdf: str) -> int:
        return load_urdf_text(urdf, self.client, useFixedBase=True)

    def _add(self, shape: int) -> int:
        return int(p.createMultiBody(0.0, -1, shape, _NOWHERE, physicsClientId=self.client))

    def _add_mesh(self, mesh: meshes.Mesh, colour: Colour) -> int:
        return self._add(p.createVisualShape(p.GEOM_MESH, rgbaColor=colour, physicsClientId=self.client, **mesh))

    def _move(self, body: int, position: Sequence[float], quaternion: Sequence[float]) -> None:
        p.resetBasePositionAndOrientation(body, position, quaternion, physicsClientId=self.client)

    def _point(self, arrow: int, position: FloatArray, direction: FloatArray) -> None:
        """Lay an arrow at ``position``, or hide it where ``direction`` is zero."""
        if not direction.any():
            self._move(arrow, _NOWHERE, _LEVEL)
        else:
            self._move(arrow, position.tolist(), _from_z_to(direction / np.linalg.norm(direction)))


def _unit(vector: FloatArray, otherwise: FloatArray) -> FloatArray:
    """``vector`` as a unit vector, or ``otherwise`` where it has hardly a direction."""
    norm = float(np.linalg.norm(vector))
    return np.asarray(vector / norm) if norm > 1e-3 else otherwise


def _from_z_to(direction: FloatArray) -> tuple[float, float, float, float]:
    """A quaternion (x, y, z, w) that turns the z axis to a unit vector."""
    x, y, z = direction.tolist()
    if z < -0.999999:
        return (1.0, 0.0, 0.0, 0.0)
    norm = math.sqrt(2.0 * (1.0 + z))
    return (-y / norm, x / norm, 0.0, norm / 2.0)


def _xyzw(state: FloatArray) -> tuple[float, float, float, float]:
    w, x, y, z = state[QUATERNION, 0].tolist()
    return (x, y, z, w)
