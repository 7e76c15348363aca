"""Recorded flights in PyBullet's window, in real time: all vehicles together."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

import numpy as np
import pybullet as p

from sb3_quad.base.errors import ConfigError
from sb3_quad.drawing.client import has_display, open_window
from sb3_quad.drawing.framing import broadside, following_cameras
from sb3_quad.drawing.palette import colours_of, rgb
from sb3_quad.drawing.scenery import DrawnTarget, DrawnVehicle, DrawnWrench, rotor_turning, scale_of
from sb3_quad.envs.rendering import furnish_window, point_window
from sb3_quad.show.film import FPS, HOLD, MARGIN, sight
from sb3_quad.show.recording import Recording
from sb3_quad.simulation.state import POSITION, TARGET

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
        self.width, self.height = width, height
        self.client = open_window(width, height)

    def show(self, recordings: Sequence[Recording], speed: float = 1.0) -> bool:
        """Show flights that start together, each with its name and trail; False as soon as the window has been shut."""
        p.resetSimulation(physicsClientId=self.client)
        p.removeAllUserDebugItems(physicsClientId=self.client)
        furnish_window(self.client)
        players = [_Player(each, self.client, colour) for each, colour in zip(recordings, _colours(recordings), strict=True)]
        p.configureDebugVisualizer(p.COV_ENABLE_RENDERING, 1, physicsClientId=self.client)
        last = max(float(recording.times[-1]) for recording in recordings)
        times = np.minimum(np.arange(round((last / speed + HOLD) * FPS) + 1) * speed / FPS, last)
        seen = [np.concatenate([_where(recording, seconds) for recording in recordings]) for seconds in times]
        ahead = broadside(np.concatenate([sight(recording) for recording in recordings]))
        margin, aspect = MARGIN * scale_of(recordings[0].vehicle), self.width / self.height
        cameras = following_cameras(seen, max(speed / FPS, 1e-3), margin, aspect, ahead, WINDOW_FIELD_OF_VIEW)
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
        scale = scale_of(recording.vehicle)
        self.recording, self.client, self.colour = recording, client, colour
        self.vehicle = DrawnVehicle(recording.vehicle, client)
        self.target, self.wrench = DrawnTarget(client, scale), DrawnWrench(client, scale)
        turning = rotor_turning(recording.vehicle, recording.state)
        self.rotor_angles = np.cumsum(turning, axis=1) * recording.vehicle.control_step
        self.drawn_to = 0
        self.name = -1

    def move_to(self, seconds: float) -> None:
        recording, step = self.recording, self.recording.at(seconds)
        state = recording.state[:, step]
        self.vehicle.place(state, self.rotor_angles[:, step])
        self.target.place(state[TARGET], state[None, POSITION])
        self.wrench.place(state, recording.wrench_around(step))
        if step == self.drawn_to:
            return
        ends = recording.path[[self.drawn_to, step]].tolist()
        p.addUserDebugLine(*ends, lineColorRGB=self.colour, lineWidth=3.0, physicsClientId=self.client)
        above = (state[POSITION] + np.array([0.0, 0.0, 0.6 * scale_of(recording.vehicle)])).tolist()
        options = {"replaceItemUniqueId": self.name} if self.name >= 0 else {}
        self.name = p.addUserDebugText(
            recording.name, above, textColorRGB=self.colour, textSize=1.2, physicsClientId=self.client, **options
        )
        self.drawn_to = step


def _where(recording: Recording, seconds: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    state = recording.state[:, recording.at(seconds)]
    return np.stack([state[POSITION], state[TARGET]])


def _colours(recordings: Sequence[Recording]) -> list[tuple[float, float, float]]:
    return [rgb(colour) for colour in colours_of([recording.name for recording in recordings]).values()]
