"""PyBullet's window."""

import math
import os
import sys

import numpy as np

from sb3_quad.base.bullet import p
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.types import FloatArray
from sb3_quad.envs.rendering.camera import Camera


def has_display() -> bool:
    """Whether a window can be opened; without a display PyBullet would end the whole process."""
    return not sys.platform.startswith("linux") or bool(os.environ.get("DISPLAY"))


def open_window(width: int, height: int) -> int:
    """Open PyBullet's window, with a ground and without controls; it draws nothing until
    :func:`start_drawing`.

    :return: its client.
    :raises ConfigError: there is one already in this process, or it cannot be opened.
    """
    sky = "--background_color_red=0.70 --background_color_green=0.82 --background_color_blue=0.93"
    try:
        client = int(p.connect(p.GUI, options=f"--width={width} --height={height} {sky}"))
    except p.error:
        raise ConfigError(
            "render_mode 'human': PyBullet opens one window per process, and one is open already"
        ) from None
    if client < 0:
        raise ConfigError(
            "render_mode 'human': PyBullet could not open its window; use render_mode='rgb_array'"
        )
    # Only the scene is shown: no controls, no shortcuts, and nothing before start_drawing().
    for option in (
        p.COV_ENABLE_RENDERING,
        p.COV_ENABLE_GUI,
        p.COV_ENABLE_MOUSE_PICKING,
        p.COV_ENABLE_KEYBOARD_SHORTCUTS,
    ):
        p.configureDebugVisualizer(option, 0, physicsClientId=client)
    import pybullet_data

    # The ground is drawn only; vehicles must not collide with it.
    plane = f"{pybullet_data.getDataPath()}/plane.urdf"
    ground = p.loadURDF(plane, useFixedBase=True, globalScaling=2.0, physicsClientId=client)
    p.setCollisionFilterGroupMask(ground, -1, 0, 0, physicsClientId=client)
    return client


def start_drawing(client: int) -> None:
    """Let a window show what is in it."""
    p.configureDebugVisualizer(p.COV_ENABLE_RENDERING, 1, physicsClientId=client)


def point_window(client: int, camera: Camera, towards: FloatArray) -> None:
    """Look through a window from where ``camera`` is, and draw it; ``towards``: what it looks at,
    (3,).
    """
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


def disconnect(client: int) -> None:
    """Close a window or another client, unless that has been done, as by shutting the window."""
    if p.isConnected(client):
        p.disconnect(client)
