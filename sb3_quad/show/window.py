"""Recorded flights in PyBullet's window, in real time: all vehicles together."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

import numpy as np
from matplotlib.colors import to_rgb

from sb3_quad.base.bullet import p
from sb3_quad.drawing.camera import Lens, broadside, following_cameras
from sb3_quad.drawing.scene import Scene
from sb3_quad.drawing.window import disconnect, open_window, point_window, start_drawing
from sb3_quad.show.film import FPS, MARGIN, frame_times
from sb3_quad.show.recording import Recording

WINDOW_SLOPE = math.tan(math.radians(30.0))  # PyBullet's


def show_in_window(episodes: Sequence[Sequence[Recording]], width: int, height: int, speed: float) -> None:
    """Show episodes one after the other, until the window is shut; flights of one start together.

    :raises ConfigError: the window cannot be opened.
    """
    client = open_window(width, height)
    try:
        n = len(episodes[0])
        scene = Scene(episodes[0][0].vehicle, client, n_vehicles=n, n_targets=n)
        start_drawing(client)
        for recordings in episodes:
            p.removeAllUserDebugItems(physicsClientId=client)
            _play(scene, recordings, Lens(width, height, WINDOW_SLOPE), speed)
    except p.error:
        if p.isConnected(client):  # else the window has been shut
            raise
    finally:
        disconnect(client)


def _play(scene: Scene, recordings: Sequence[Recording], lens: Lens, speed: float) -> None:
    times, client = frame_times(recordings, speed), scene.client
    seen = [np.concatenate([each.vehicle_and_target(each.at(seconds)) for each in recordings]) for seconds in times]
    forward = broadside(np.concatenate([recording.landmarks for recording in recordings]))
    cameras = following_cameras(seen, speed / FPS, MARGIN * scene.scale, forward, lens)
    drawn_to, labels = [0] * len(recordings), [-1] * len(recordings)
    begun, number = time.perf_counter(), 0
    while number < len(times):
        now = [(recording, recording.at(times[number])) for recording in recordings]
        targets = np.stack([recording.state.target[step] for recording, step in now])
        scene.place([recording.pose(step) for recording, step in now], targets)
        for k, (recording, step) in enumerate(now):
            if step > drawn_to[k]:
                ends, colour = recording.state.position[[drawn_to[k], step]], to_rgb(recording.colour)
                p.addUserDebugLine(*ends.tolist(), lineColorRGB=colour, lineWidth=3.0, physicsClientId=client)
                above = (ends[1] + (0.0, 0.0, 0.6 * scene.scale)).tolist()
                look = {"textColorRGB": colour, "textSize": 1.2, "replaceItemUniqueId": labels[k]}
                labels[k] = p.addUserDebugText(recording.name, above, physicsClientId=client, **look)
                drawn_to[k] = step
        point_window(client, cameras[number], seen[number].mean(axis=0))
        number = max(number + 1, int((time.perf_counter() - begun) * FPS))  # frames that come too late are left out
        time.sleep(max(0.0, begun + number / FPS - time.perf_counter()))
