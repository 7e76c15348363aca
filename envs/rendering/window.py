"""PyBullet's simulations and its window."""

import math
import os
import sys
from functools import partial
from typing import Any

import numpy as np

from sb3_quad.base.errors import ConfigError, raised_as
from sb3_quad.base.types import FloatArray
from sb3_quad.envs.rendering.bullet_client import p
from sb3_quad.envs.rendering.camera import Camera


class Client:
    """PyBullet's functions, bound to a new simulation: ``client.stepSimulation()`` is
    ``p.stepSimulation(physicsClientId=client.number)``.

    :param mode: ``p.DIRECT``, without a display, or ``p.GUI``.
    """

    def __init__(self, mode: int = p.DIRECT, **options: str) -> None:
        self.number = int(p.connect(mode, **options))
        if self.number < 0:
            raise p.error("no connection")

    def __getattr__(self, name: str) -> Any:
        function = partial(getattr(p, name), physicsClientId=self.number)
        # Kept, so that each function is looked up once.
        vars(self)[name] = function
        return function

    def draw_ground(self) -> None:
        """Add PyBullet's chequered ground, which nothing touches: vehicles have no shape that
        collides with it.
        """
        import pybullet_data

        plane = f"{pybullet_data.getDataPath()}/plane.urdf"
        self.loadURDF(plane, useFixedBase=True, globalScaling=5.0)

    def close(self) -> None:
        """End the simulation, unless it has ended already, for example with its window."""
        if self.isConnected():
            self.disconnect()


def has_display() -> bool:
    """Whether a window can be opened; without a display PyBullet would end the whole process."""
    return not sys.platform.startswith("linux") or bool(os.environ.get("DISPLAY"))


def open_window(width: int, height: int) -> Client:
    """Open PyBullet's window, without controls; it draws nothing until
    :func:`start_drawing`.

    :raises ConfigError: there is one already in this process, or it cannot be opened.
    """
    sky = "--background_color_red=0.70 --background_color_green=0.82 --background_color_blue=0.93"
    with raised_as(
        ConfigError,
        "render_mode 'human': PyBullet could not open its window, of which a process can have one; "
        "use render_mode='rgb_array'",
    ):
        client = Client(p.GUI, options=f"--width={width} --height={height} {sky}")
    # Only the scene is shown: no controls, no shortcuts, and nothing before start_drawing().
    for option in (
        p.COV_ENABLE_RENDERING,
        p.COV_ENABLE_GUI,
        p.COV_ENABLE_MOUSE_PICKING,
        p.COV_ENABLE_KEYBOARD_SHORTCUTS,
    ):
        client.configureDebugVisualizer(option, 0)
    return client


def start_drawing(client: Client) -> None:
    """Let a window show what is in it."""
    client.configureDebugVisualizer(p.COV_ENABLE_RENDERING, 1)


def point_window(client: Client, camera: Camera, towards: FloatArray) -> None:
    """Give a window the view of ``camera``, and draw it.

    :param towards: the point that it looks at, (3,).
    """
    forward = camera.axes[0]
    distance = np.linalg.norm(towards - camera.eye)
    client.resetDebugVisualizerCamera(
        cameraDistance=distance,
        cameraYaw=math.degrees(math.atan2(forward[1], forward[0])) - 90.0,
        cameraPitch=math.degrees(math.asin(forward[2])),
        cameraTargetPosition=camera.eye + distance * forward,
    )
    client.configureDebugVisualizer(p.COV_ENABLE_SINGLE_STEP_RENDERING, 1)
