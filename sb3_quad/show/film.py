"""Recorded flights as the frames of a film: a panel for each, its camera following vehicle and target."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from sb3_quad.base.arrays import FloatArray, Image
from sb3_quad.drawing.camera import Camera, broadside, following_cameras, framing_camera
from sb3_quad.drawing.labels import side_by_side, with_header
from sb3_quad.drawing.palette import colours_of, rgb
from sb3_quad.drawing.picture import Overlay
from sb3_quad.drawing.scene import Scene
from sb3_quad.show.recording import Recording
from sb3_quad.simulation.state import TARGET

FPS = 25
HOLD = 1.0  # the last picture stays for that long, s
MARGIN = 0.9  # around vehicle and target, m, for a vehicle of the default one's size
PANELS_ABREAST = 3
SMALL = 0.2  # a vehicle whose breadth is less of the picture's height is shown from near as well
CLOSE_UP, GAP = 0.34, 8  # side of that picture, of the panel's; its distance from the edges, pixels


def frame_times(recordings: Sequence[Recording], speed: float) -> FloatArray:
    """The times of flight, s, that the frames of a film of several flights show."""
    last = max(float(recording.times[-1]) for recording in recordings)
    return np.minimum(np.arange(round((last / speed + HOLD) * FPS) + 1) * speed / FPS, last)


def film_frames(recordings: Sequence[Recording], width: int, height: int, speed: float = 1.0) -> Iterator[Image]:
    """The frames of a film, FPS of them a second, uint8 (height, width, 3), all of one size.

    :param recordings: one for each panel; they start together and are seen from one direction.
    :param width: of a panel, pixels; ``height`` likewise, its header not counted.
    :param speed: of time in the film; 0.5 is slow motion.
    """
    times = frame_times(recordings, speed)
    forward = broadside(np.concatenate([recording.landmarks for recording in recordings]))
    colours = colours_of([recording.name for recording in recordings])
    panels = [_Panel(each, times, forward, colours[each.name], width, height) for each in recordings]
    try:
        for number in range(len(times)):
            yield side_by_side([panel.picture(number) for panel in panels], PANELS_ABREAST)
    finally:
        for panel in panels:
            panel.scene.close()


class _Panel:
    """One flight of a film, at the given times (s) of its frames, seen along ``forward``, (3,)."""

    def __init__(
        self, recording: Recording, times: FloatArray, forward: FloatArray, colour: str, width: int, height: int
    ) -> None:
        self.recording, self.colour, self.forward = recording, colour, forward
        self.width, self.height, self.side = width, height, round(CLOSE_UP * min(width, height))
        self.steps = [recording.at(seconds) for seconds in times]
        self.scene = Scene(recording.vehicle)
        seen = [recording.vehicle_and_target(step) for step in self.steps]
        frame_seconds = max(float(times[1] - times[0]), 1e-3)
        self.cameras = following_cameras(seen, frame_seconds, MARGIN * self.scene.scale, width / height, forward)
        self.corner = self._free_corner(seen)
        self.shown: tuple[object, Image] | None = None

    def picture(self, number: int) -> Image:
        """Frame ``number`` of this flight."""
        step, camera = self.steps[number], self.cameras[number]
        key = step, camera.eye.round(3).tolist()
        if self.shown is None or self.shown[0] != key:
            lines = [self._caption(step)]
            font_size = max(12, round(self.height / 26))
            self.shown = key, with_header(self._draw(step, camera), self.recording.name, lines, self.colour, font_size)
        return self.shown[1]

    def _draw(self, step: int, camera: Camera) -> Image:
        recording, scene, side = self.recording, self.scene, self.side
        scene.place([recording.pose(step)], recording.state[None, TARGET, step])
        trail = Overlay(recording.path[: step + 1 : 2], rgb(self.colour), 0.75, width=0.03 * scene.scale)
        pixels = scene.picture(camera, self.width, self.height, [trail])
        position = recording.path[step]
        if scene.span < SMALL * float((position - camera.eye) @ camera.axes[0]) * camera.slope:
            near = framing_camera(position[None], 1.15 * scene.span, 1.0, self.forward)
            left, top = self.corner
            pixels[top - 2 : top + side + 2, left - 2 : left + side + 2] = 255
            pixels[top : top + side, left : left + side] = scene.picture(near, side, side, [trail])
        return pixels

    def _free_corner(self, seen: Sequence[FloatArray]) -> tuple[int, int]:
        """Left and top of the close-up, in the corner in which vehicle and target are seen least."""
        pairs = zip(self.cameras, seen, strict=True)
        spots = np.concatenate([camera.project(points, self.width, self.height)[:, :2] for camera, points in pairs])
        right, bottom, half = self.width - self.side - GAP, self.height - self.side - GAP, self.side / 2
        corners = [(GAP, bottom), (right, bottom), (GAP, GAP), (right, GAP)]
        return min(corners, key=lambda corner: int((np.abs(spots - corner - half) < half + GAP).all(axis=1).sum()))

    def _caption(self, step: int) -> str:
        recording = self.recording
        if step == len(recording.times) - 1 and recording.lost:
            return f"{recording.times[-1]:5.2f} s   {recording.lost}"
        force = float(np.linalg.norm(recording.wrench_around(step)[:6]))
        push = f"   force {force:.1f} N" if force else ""
        height = recording.path[step, 2]
        return f"{recording.times[step]:5.2f} s   {recording.error[step]:.2f} m from target   {height:.1f} m high{push}"
