"""Pictures of a flight: a camera that follows the vehicle towards its target, in a window or as arrays."""

from __future__ import annotations

import math
import time

import numpy as np
import numpy.typing as npt
import pybullet as p

from sb3_quad.drawing.backdrop import Camera
from sb3_quad.drawing.chase import FIELD_OF_VIEW, ChaseCamera
from sb3_quad.drawing.scenery import RING, DrawnTarget, DrawnVehicle, DrawnWrench, rotor_turning, scale_of, take_picture
from sb3_quad.envs.bullet import BulletBody
from sb3_quad.simulation.state import POSITION, TARGET
from sb3_quad.vehicles.vehicle import Vehicle

FloatArray = npt.NDArray[np.float64]

RENDER_MODES = ("human", "rgb_array")
WINDOW_FPS = 25.0  # frames a second; PyBullet's window lets the simulation wait for each


class Renderer:
    """Draws one vehicle, its target and the wrench that acts on it.

    What it adds to the simulation has no mass and touches nothing, so that a flight is the same with and without it.

    :param body: the simulation. If it has a window, that is drawn into, in real time; else it must have its looks.
    :param width: of the pictures, pixels; ``height`` likewise.
    """

    def __init__(self, vehicle: Vehicle, body: BulletBody, width: int, height: int) -> None:
        self.vehicle, self.client = vehicle, body.client
        self.width, self.height, self.human = width, height, body.has_window
        self.rotor_angles = np.zeros(4)
        self.chase = ChaseCamera(scale_of(vehicle))
        self.shown_at = time.perf_counter()
        self.frames_due = 1.0
        if self.human:
            furnish_window(self.client)
            # The window draws a link in one colour, and its collision sphere where it has no looks.
            p.changeVisualShape(body.body, -1, rgbaColor=(0.0, 0.0, 0.0, 0.0), physicsClientId=self.client)
        self.drawn = DrawnVehicle(vehicle, self.client, frame=self.human)
        self.target = DrawnTarget(self.client, scale_of(vehicle))
        self.wrench = DrawnWrench(self.client, scale_of(vehicle))
        if self.human:
            p.configureDebugVisualizer(p.COV_ENABLE_RENDERING, 1, physicsClientId=self.client)

    def reset(self, state: FloatArray) -> None:
        """A new episode: the camera jumps to column 0 of ``state``, (STATE_SIZE, n)."""
        self.rotor_angles[:] = 0.0
        self.chase.reset(state[:, 0])
        self._place(state[:, 0], np.zeros(12))

    def render(self, state: FloatArray, wrench: FloatArray) -> npt.NDArray[np.uint8] | None:
        """Draw column 0 of ``state``, (STATE_SIZE, n), and of ``wrench``, (12, n).

        :return: uint8 (height, width, 3); None in human mode.
        """
        self.chase.turn(state[:, 0], 0.04)
        self.rotor_angles += rotor_turning(self.vehicle, state[:, :1])[:, 0] * self.vehicle.control_step
        if self.human:
            self._show(state[:, 0], wrench[:, 0])
            return None
        self._place(state[:, 0], wrench[:, 0])
        shadows = np.array([[*state[POSITION, 0][:2], self.drawn.span], [*state[TARGET, 0][:2], RING * self.target.scale]])
        discs = self.drawn.rotor_discs(state[:, 0])
        camera = self.chase.camera(state[:, 0])
        return take_picture(self.client, camera, FIELD_OF_VIEW, self.width, self.height, shadows, discs).pixels

    def _place(self, state: FloatArray, wrench: FloatArray) -> None:
        """Move all that is only drawn to where it belongs."""
        self.drawn.place(state, self.rotor_angles)
        self.target.place(state[TARGET], state[None, POSITION])
        self.wrench.place(state, wrench)

    def _show(self, state: FloatArray, wrench: FloatArray) -> None:
        """Wait until real time has caught up, and show what is to be seen WINDOW_FPS times a second."""
        self.frames_due += WINDOW_FPS * self.vehicle.control_step
        if self.frames_due >= 1.0:
            self.frames_due %= 1.0
            self._place(state, wrench)
            point_window(self.client, self.chase.camera(state), state[POSITION])
        self.shown_at += self.vehicle.control_step
        ahead = self.shown_at - time.perf_counter()
        if ahead > 0:
            time.sleep(ahead)
        else:
            self.shown_at -= ahead  # too slow for real time: do not hurry afterwards


def furnish_window(client: int) -> None:
    """Give a PyBullet window a ground, and take away what is not to be seen; it does not draw until it is told to."""
    import pybullet_data

    hidden = (p.COV_ENABLE_RENDERING, p.COV_ENABLE_GUI, p.COV_ENABLE_MOUSE_PICKING, p.COV_ENABLE_KEYBOARD_SHORTCUTS)
    for option in hidden:
        p.configureDebugVisualizer(option, 0, physicsClientId=client)
    plane = f"{pybullet_data.getDataPath()}/plane.urdf"
    ground = p.loadURDF(plane, useFixedBase=True, globalScaling=2.0, physicsClientId=client)
    p.setCollisionFilterGroupMask(ground, -1, 0, 0, physicsClientId=client)
    p.changeVisualShape(ground, -1, specularColor=(0.1, 0.1, 0.1), physicsClientId=client)


def point_window(client: int, camera: Camera, towards: FloatArray) -> None:
    """Look through a window from where ``camera`` is, and draw it; ``towards``: what it looks at, (3,)."""
    forward = camera.axes[0]
    distance = float(np.linalg.norm(towards - camera.eye))
    p.resetDebugVisualizerCamera(
        cameraDistance=distance,
        cameraYaw=math.degrees(math.atan2(forward[1], forward[0])) - 90.0,
        cameraPitch=math.degrees(math.asin(np.clip(forward[2], -0.999, 0.999))),
        cameraTargetPosition=(camera.eye + distance * forward).tolist(),
        physicsClientId=client,
    )
    p.configureDebugVisualizer(p.COV_ENABLE_SINGLE_STEP_RENDERING, 1, physicsClientId=client)
