"""Recorded flights in PyBullet's window, in real time: all vehicles together."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Sequence

import numpy as np

from sb3_quad.base.bullet import p
from sb3_quad.drawing.camera import broadside, following_cameras
from sb3_quad.drawing.palette import colours_of, rgb
from sb3_quad.drawing.scene import Scene
from sb3_quad.drawing.window import furnish_window, open_window, point_window, start_drawing
from sb3_quad.show.film import FPS, MARGIN, frame_times
from sb3_quad.show.recording import Recording
from sb3_quad.simulation.state import TARGET

WINDOW_FIELD_OF_VIEW = math.radians(60.0)  # PyBullet's, vertical


def show_in_window(episodes: Iterable[Sequence[Recording]], width: int, height: int, speed: float) -> None:
    """Show episodes one after the other, until the window is shut; flights of one start together.

    :raises ConfigError: the window cannot be opened.
    """
    client = open_window(width, height)
    try:
        for recordings in episodes:
            _show(client, recordings, width / height, speed)
    except p.error:
        if p.isConnected(client):  # else the window has been shut
            raise
    finally:
        if p.isConnected(client):
            p.disconnect(client)


def _show(client: int, recordings: Sequence[Recording], aspect: float, speed: float) -> None:
    p.resetSimulation(physicsClientId=client)
    p.removeAllUserDebugItems(physicsClientId=client)
    furnish_window(client)
    colours = colours_of([recording.name for recording in recordings])
    players = [_Player(recording, client, rgb(colours[recording.name])) for recording in recordings]
    start_drawing(client)
    times = frame_times(recordings, speed)
    seen = [np.concatenate([each.vehicle_and_target(each.at(seconds)) for each in recordings]) for seconds in times]
    forward = broadside(np.concatenate([recording.landmarks for recording in recordings]))
    margin = MARGIN * players[0].scene.scale
    cameras = following_cameras(seen, speed / FPS, margin, aspect, forward, WINDOW_FIELD_OF_VIEW)
    begun, number = time.perf_counter(), 0
    while number < len(times):
        for player in players:
            player.move_to(float(times[number]))
        point_window(client, cameras[number], seen[number].mean(axis=0))
        number = max(number + 1, int((time.perf_counter() - begun) * FPS))  # frames that come too late are left out
        time.sleep(max(0.0, begun + number / FPS - time.perf_counter()))


class _Player:
    """One flight in the window, with its name and trail."""

    def __init__(self, recording: Recording, client: int, colour: tuple[float, float, float]) -> None:
        self.recording, self.colour = recording, colour
        self.scene = Scene(recording.vehicle, client)
        self.drawn_to, self.name = 0, -1

    def move_to(self, seconds: float) -> None:
        recording, step, client = self.recording, self.recording.at(seconds), self.scene.client
        self.scene.place([recording.pose(step)], recording.state[None, TARGET, step])
        if step == self.drawn_to:
            return
        ends = recording.path[[self.drawn_to, step]].tolist()
        p.addUserDebugLine(*ends, lineColorRGB=self.colour, lineWidth=3.0, physicsClientId=client)
        above = (recording.path[step] + np.array([0.0, 0.0, 0.6 * self.scene.scale])).tolist()
        look = {"textColorRGB": self.colour, "textSize": 1.2, "replaceItemUniqueId": self.name}
        self.name = p.addUserDebugText(recording.name, above, physicsClientId=client, **look)
        self.drawn_to = step
