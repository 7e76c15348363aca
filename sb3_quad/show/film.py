"""Recorded flights as the frames of a film: a panel for each, its camera following vehicle and target."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt

from sb3_quad.drawing.backdrop import Camera
from sb3_quad.drawing.framing import FIELD_OF_VIEW, broadside, following_cameras, framing_camera
from sb3_quad.drawing.labels import side_by_side, with_header
from sb3_quad.drawing.lines import project
from sb3_quad.drawing.palette import colours_of, rgb, rgb255
from sb3_quad.drawing.scenery import rotor_turning
from sb3_quad.drawing.stage import Pose, Scene, Stage, Trail
from sb3_quad.show.recording import Recording
from sb3_quad.simulation.state import POSITION, TARGET

FloatArray = npt.NDArray[np.float64]
Frame = npt.NDArray[np.uint8]

FPS = 25
HOLD = 1.0  # the last picture stays for that long, s
MARGIN = 0.9  # around vehicle and target, m, for a vehicle of the default one's size
PANELS_ABREAST = 3
SMALL = 0.2  # a vehicle whose breadth is less of the picture's height is shown from near as well
CLOSE_UP, GAP = 0.34, 8  # side of that picture, of the panel's; its distance from the edges, pixels


class Film:
    """Frames of several flights side by side, which start together and are seen from one direction.

    :param recordings: one for each panel.
    :param width: of a panel, pixels; ``height`` likewise, its header not counted.
    :param speed: of time in the film; 0.5 is slow motion.
    """

    def __init__(self, recordings: Sequence[Recording], width: int, height: int, speed: float = 1.0) -> None:
        last = max(float(recording.times[-1]) for recording in recordings)
        times = np.minimum(np.arange(round((last / speed + HOLD) * FPS) + 1) * speed / FPS, last)
        colours = colours_of([recording.name for recording in recordings])
        ahead = broadside(np.concatenate([sight(recording) for recording in recordings]))
        self._panels = [_Panel(each, times, ahead, colours[each.name], width, height) for each in recordings]
        self.n_frames = len(times)

    def frames(self) -> Iterator[Frame]:
        """Its frames, uint8 (height, width, 3), all of one size, FPS of them a second."""
        for number in range(self.n_frames):
            yield side_by_side([panel.picture(number) for panel in self._panels], PANELS_ABREAST)

    def close(self) -> None:
        """Give the simulations back; calling it twice is fine."""
        for panel in self._panels:
            panel.stage.close()


def sight(recording: Recording) -> FloatArray:
    """The points of a flight that a camera's direction is chosen by, (n, 3), m."""
    return np.concatenate([recording.path[::5], recording.targets])


class _Panel:
    """One flight of a film, at the given times (s) of its frames."""

    def __init__(
        self, recording: Recording, times: FloatArray, ahead: FloatArray, colour: str, width: int, height: int
    ) -> None:
        self.recording, self.times, self.colour = recording, times, colour
        self.width, self.height, self.ahead = width, height, ahead
        self.steps = [recording.at(seconds) for seconds in times]
        self.stage = Stage(recording.vehicle)
        seen = [recording.state[:, step][np.array([[0, 1, 2], [17, 18, 19]])] for step in self.steps]
        frame_seconds = max(float(times[1] - times[0]), 1e-3)
        self.cameras = following_cameras(seen, frame_seconds, MARGIN * self.stage.scale, width / height, ahead)
        self.side = round(CLOSE_UP * min(width, height))
        self.corner = self._free_corner(seen)
        turning = rotor_turning(recording.vehicle, recording.state)
        self.rotor_angles = np.cumsum(turning, axis=1) * recording.vehicle.control_step
        self.font_size = max(12, round(height / 26))
        self.shown: tuple[int, Frame] | None = None

    def picture(self, number: int) -> Frame:
        """Frame ``number`` of this flight."""
        if self.shown is not None and self._stands(number):
            return self.shown[1]
        recording, step = self.recording, self.steps[number]
        state = recording.state[:, step]
        pose = Pose(state, recording.wrench_around(step), self.rotor_angles[:, step])
        trail = Trail(recording.path[: step + 1 : 2], rgb(self.colour), 0.03 * self.stage.scale, opacity=0.75)
        scene = Scene([pose], state[None, TARGET], [trail])
        pixels = self.stage.picture(scene, self.cameras[number], FIELD_OF_VIEW, self.width, self.height)
        self._add_close_up(pixels, scene, self.cameras[number])
        frame = with_header(pixels, recording.name, [self._caption(number)], rgb255(self.colour), self.font_size)
        self.shown = number, frame
        return frame

    def _add_close_up(self, pixels: Frame, scene: Scene, camera: Camera) -> None:
        """In a corner, the vehicle from near, where it is small in the picture."""
        position = scene.poses[0].state[None, POSITION]
        span = self.stage.vehicles[0].span
        if span > SMALL * float((position - camera.eye)[0] @ camera.axes[0]) * camera.slope:
            return
        near = framing_camera(position, 1.15 * span, 1.0, self.ahead)
        left, top = self.corner
        side = self.side
        pixels[top - 2 : top + side + 2, left - 2 : left + side + 2] = 255
        pixels[top : top + side, left : left + side] = self.stage.picture(scene, near, FIELD_OF_VIEW, side, side)

    def _free_corner(self, seen: list[FloatArray]) -> tuple[int, int]:
        """Left and top of the corner in which vehicle and target are seen least."""
        right, bottom = self.width - self.side - GAP, self.height - self.side - GAP
        places = [
            project(camera, points, self.width, self.height)[:, :2] for camera, points in zip(self.cameras, seen, strict=True)
        ]
        spots = np.concatenate(places)

        def hidden(corner: tuple[int, int]) -> int:
            return int(((spots > np.array(corner) - GAP) & (spots < np.array(corner) + self.side + GAP)).all(axis=1).sum())

        return min([(GAP, bottom), (right, bottom), (GAP, GAP), (right, GAP)], key=hidden)

    def _stands(self, number: int) -> bool:
        """Whether nothing has moved since the frame that is shown: the flight is over, and the camera rests."""
        assert self.shown is not None
        before = self.shown[0]
        moved = float(np.abs(self.cameras[number].eye - self.cameras[before].eye).max())
        over = self.steps[before] == self.steps[number] == len(self.recording.times) - 1
        return over and moved < 1e-3 and self._caption(before) == self._caption(number)

    def _caption(self, number: int) -> str:
        recording, step = self.recording, self.steps[number]
        if step == len(recording.times) - 1 and recording.lost:
            return f"{recording.times[-1]:5.2f} s   {recording.lost}"
        height = recording.state[POSITION, step][2]
        force = float(np.linalg.norm(recording.wrench_around(step)[:6]))
        push = f"   force {force:.1f} N" if force else ""
        return f"{recording.times[step]:5.2f} s   {recording.error[step]:.2f} m from target   {height:.1f} m high{push}"
