"""Pictures of a flight: a camera that follows the vehicle towards its target, in a window or as arrays."""

from __future__ import annotations

import time

import numpy as np

from sb3_quad.base.arrays import FloatArray, Image
from sb3_quad.base.bullet import p
from sb3_quad.drawing.camera import ChaseCamera
from sb3_quad.drawing.models import rotor_turning
from sb3_quad.drawing.scene import Pose, Scene
from sb3_quad.drawing.window import point_window, start_drawing
from sb3_quad.envs.bullet import BulletBody
from sb3_quad.simulation.state import POSITION, ROTOR_SPEEDS, TARGET
from sb3_quad.vehicles.vehicle import Vehicle

RENDER_MODES = ("human", "rgb_array")
WINDOW_FPS = 25.0  # frames a second; PyBullet's window lets the simulation wait for each


class Renderer:
    """Draws one vehicle, its target and the wrench that acts on it; the flight is the same with and without it.

    :param body: the simulation. If it has a window, that is drawn into, in real time.
    :param width: of the pictures, pixels; ``height`` likewise.
    """

    def __init__(self, vehicle: Vehicle, body: BulletBody, width: int, height: int) -> None:
        self.vehicle, self.client = vehicle, body.client
        self.width, self.height, self.human = width, height, body.has_window
        self.rotor_angles = np.zeros(4)
        self.shown_at = time.perf_counter()
        self.frames_due = 1.0
        # PyBullet would draw the collision sphere.
        p.changeVisualShape(body.body, -1, rgbaColor=(0.0, 0.0, 0.0, 0.0), physicsClientId=self.client)
        self.scene = Scene(vehicle, self.client)
        self.chase = ChaseCamera(self.scene.scale)
        if self.human:
            start_drawing(self.client)

    def reset(self, state: FloatArray) -> None:
        """A new episode: the camera jumps to where ``state``, (STATE_SIZE,), says."""
        self.rotor_angles = np.zeros(4)
        self.chase = ChaseCamera(self.scene.scale)
        self.chase.turn(state, 1.0)

    def render(self, state: FloatArray, wrench: FloatArray) -> Image | None:
        """Draw a state, (STATE_SIZE,), and the wrench that acts, (12,); once for each control step.

        :return: uint8 (height, width, 3). None if there is a window: it is drawn WINDOW_FPS times a second, and this call
            waits until real time has caught up.
        """
        self.chase.turn(state, 0.04)
        self.rotor_angles += rotor_turning(self.vehicle, state[ROTOR_SPEEDS]) * self.vehicle.control_step
        if not self.human:
            self._place(state, wrench)
            return self.scene.picture(self.chase.camera(state), self.width, self.height)
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
        return None

    def _place(self, state: FloatArray, wrench: FloatArray) -> None:
        self.scene.place([Pose(state, wrench, self.rotor_angles)], state[None, TARGET])
