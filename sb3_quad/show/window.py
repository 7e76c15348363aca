"""Recorded flights in PyBullet's window, in real time: all vehicles together."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

import numpy as np
import pybullet as p

from sb3_quad.base.errors import ConfigError
from sb3_quad.drawing.camera import broadside, following_cameras
from sb3_quad.drawing.palette import colours_of, rgb
from sb3_quad.drawing.scene import Scene
from sb3_quad.drawing.window import furnish_window, has_display, open_window, point_window, start_drawing
from sb3_quad.show.film import FPS, MARGIN, frame_times
from sb3_quad.show.recording import Recording
from sb3_quad.simulation.state import TARGET

WINDOW_FIELD_OF_VIEW = math.radians(60.0)  # PyBullet's, vertical


def check_window() -> None:
    """See whether a window can be opened, before anything is flown.

    :raises ConfigError: there is no display.
    """
    if not has_display():
        raise ConfigError("no display to open a window on (DISPLAY is not set); --record flight.mp4 makes a film instead")


class Window:
    """PyBullet's window, of which there can be one in a process.

    :raises ConfigError: it cannot be opened.
    """

    def __init__(self, width: int, height: int) -> None:
        check_window()
        self.aspect = width / height
        self.client = open_window(width, height)

    def show(self, recordings: Sequence[Recording], speed: float = 1.0) -> bool:
        """Show flights that start together, each with its name and trail; False as soon as the window has been shut."""
        p.resetSimulation(physicsClientId=self.client)
        p.removeAllUserDebugItems(physicsClientId=self.client)
        furnish_window(self.client)
        colours = colours_of([recording.name for recording in recordings])
        players = [_Player(each, self.client, rgb(colours[each.name])) for each in recordings]
        start_drawing(self.client)
        times = frame_times(recordings, speed)
        seen = [np.concatenate([each.vehicle_and_target(each.at(seconds)) for each in recordings]) for seconds in times]
        forward = broadside(np.concatenate([recording.landmarks for recording in recordings]))
        margin, frame_seconds = MARGIN * players[0].scene.scale, max(speed / FPS, 1e-3)
        cameras = following_cameras(seen, frame_seconds, margin, self.aspect, forward, WINDOW_FIELD_OF_VIEW)
        begun, number = time.perf_counter(), 0
        while number < len(times):
            try:
                for player in players:
                    player.move_to(float(times[number]))
                point_window(self.client, cameras[number], seen[number].mean(axis=0))
            except p.error:  # the window has been shut
                return False
            number = max(number + 1, int((time.perf_counter() - begun) * FPS))  # frames that come too late are left out
            time.sleep(max(0.0, begun + number / FPS - time.perf_counter()))
        return True

    def close(self) -> None:
        """Shut the window; calling it twice is fine."""
        if p.isConnected(self.client):
            p.disconnect(self.client)


class _Player:
    """One flight in the window."""

    def __init__(self, recording: Recording, client: int, colour: tuple[float, float, float]) -> None:
        self.recording, self.client, self.colour = recording, client, colour
        self.scene = Scene(recording.vehicle, client)
        self.drawn_to, self.name = 0, -1

    def move_to(self, seconds: float) -> None:
        recording, step = self.recording, self.recording.at(seconds)
        self.scene.place([recording.pose(step)], recording.state[None, TARGET, step])
        if step == self.drawn_to:
            return
        ends = recording.path[[self.drawn_to, step]].tolist()
        p.addUserDebugLine(*ends, lineColorRGB=self.colour, lineWidth=3.0, physicsClientId=self.client)
        above = (recording.path[step] + np.array([0.0, 0.0, 0.6 * self.scene.scale])).tolist()
        options = {"replaceItemUniqueId": self.name} if self.name >= 0 else {}
        self.name = p.addUserDebugText(
            recording.name, above, textColorRGB=self.colour, textSize=1.2, physicsClientId=self.client, **options
        )
        self.drawn_to = step
