"""The motion sequence of a flight in one picture: several poses with their times (cf. the thesis's Fig. A.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sb3_quad.drawing.backdrop import Camera
from sb3_quad.drawing.framing import FIELD_OF_VIEW, broadside, framing_camera
from sb3_quad.drawing.labels import Box, Canvas, overlap, side_by_side, tag_box, with_header
from sb3_quad.drawing.lines import project
from sb3_quad.drawing.palette import colours_of, rgb, rgb255
from sb3_quad.drawing.scenery import rotor_turning
from sb3_quad.drawing.stage import Pose, Scene, Stage, Trail
from sb3_quad.drawing.urdf import arm_length, rotor_radius
from sb3_quad.show.recording import Recording

FloatArray = npt.NDArray[np.float64]
Picture = npt.NDArray[np.uint8]

SETTLED = 0.25  # m: for a sequence, a flight is over once it stays that near its target
VEHICLE_SHARE = 0.15  # of the picture's height that a vehicle is drawn across at least
AREA, RATIOS = 290_000, (0.7, 1.6)  # of a panel: pixels, width by height
LARGEST = 6.0  # how much larger than life it is drawn at most
APART = 0.8  # least distance between poses in the picture, in the vehicle's drawn breadth


@dataclass(frozen=True, eq=False)
class _View:
    """How all panels of a sequence are seen."""

    camera: Camera
    width: int
    height: int
    size: float  # how much larger than life vehicles are drawn
    breadth: float  # of a drawn vehicle, m

    def project(self, points: FloatArray) -> FloatArray:
        return project(self.camera, points, self.width, self.height)

    def pixels(self, depth: FloatArray | float) -> FloatArray:
        """The breadth of a vehicle at a depth, pixels."""
        return np.asarray(self.breadth * self.height / (2.0 * self.camera.slope * np.asarray(depth)))


def sequence(
    recordings: Sequence[Recording], times: Sequence[float] | None = None, size: tuple[int, int] | None = None
) -> Picture:
    """One panel for each recording, all seen by the same camera.

    :param times: s, at which poses are drawn; None: as many as do not hide one another.
    :param size: width and height of a panel, its header not counted, pixels; None: in the proportions of the flights.
    :return: uint8 (height, about panels * width, 3).
    """
    ends = [_end(recording) if times is None else recording.at(max(times)) for recording in recordings]
    width, height = size or _proportions(recordings, ends)
    view = _view(recordings, ends, width, height)
    colours = colours_of([recording.name for recording in recordings])
    panels = []
    for recording, end in zip(recordings, ends, strict=True):
        chosen = _apart(recording, end, view) if times is None else _at(recording, times)
        panels.append(_panel(recording, chosen, end, view, colours[recording.name]))
    return side_by_side(panels, columns=len(panels))


def _end(recording: Recording) -> int:
    """The step after which the vehicle stays at its target, or the last one."""
    away = np.flatnonzero(recording.error > SETTLED)
    return min(int(away[-1]) + 1 if away.size else 0, len(recording.times) - 1)


def _at(recording: Recording, times: Sequence[float]) -> list[int]:
    return sorted({recording.at(seconds) for seconds in times})


def _points(recordings: Sequence[Recording], ends: Sequence[int]) -> FloatArray:
    paths = [recording.path[: end + 1] for recording, end in zip(recordings, ends, strict=True)]
    return np.concatenate([*paths, *(recording.targets for recording in recordings)])


def _proportions(recordings: Sequence[Recording], ends: Sequence[int]) -> tuple[int, int]:
    points = _points(recordings, ends)
    x, y, _ = broadside(points)
    high = float(np.ptp(points[:, 2]))
    wide = float(np.ptp(points[:, 0] * y - points[:, 1] * x))
    ratio = float(np.clip((wide + 0.3 * high + 1.0) / (high + 0.3 * wide + 1.0), *RATIOS))
    width = 2 * round((AREA * ratio) ** 0.5 / 2)
    return width, 2 * round(AREA / width / 2)


def _view(recordings: Sequence[Recording], ends: Sequence[int], width: int, height: int) -> _View:
    points = _points(recordings, ends)
    vehicle = recordings[0].vehicle
    breadth = 2.0 * (arm_length(vehicle) + rotor_radius(vehicle))
    ahead = broadside(points)
    size = 1.0
    for _ in range(20):  # a larger vehicle needs a camera farther away
        camera = framing_camera(points, 0.6 * size * breadth, width / height, ahead)
        depth = float(np.median(project(camera, points, width, height)[:, 2]))
        wanted = VEHICLE_SHARE * 2.0 * camera.slope * depth / breadth
        size = float(np.clip(0.5 * (size + wanted), 1.0, LARGEST))
    return _View(camera, width, height, size, size * breadth)


def _apart(recording: Recording, end: int, view: _View) -> list[int]:
    """Steps whose poses do not hide one another: each is the first that is clear of those before it."""
    screen = view.project(recording.path[: end + 1])
    breadth = view.pixels(screen[:, 2])

    def clear_of(steps: Sequence[int], step: int) -> npt.NDArray[np.bool_]:
        gaps = np.linalg.norm(screen[steps, :2] - screen[step, :2], axis=1)
        return np.asarray(gaps > APART * breadth[step])

    chosen = [0]
    for step in range(1, end + 1):
        if clear_of(chosen, step).all():
            chosen.append(step)
    # When it was pushed, and how it was lost, is to be seen: what would hide that gives way.
    for step in (*(push for push in recording.pushes if push <= end), *([end] if recording.lost else [])):
        chosen = [each for each in chosen if each == 0 or clear_of([each], step)[0]]
        chosen = sorted({*chosen, step})
    return chosen


def _panel(recording: Recording, chosen: Sequence[int], end: int, view: _View, colour: str) -> Picture:
    angles = np.cumsum(rotor_turning(recording.vehicle, recording.state), axis=1) * recording.vehicle.control_step
    poses = [Pose(recording.state[:, k], recording.wrench[:, k], angles[:, k]) for k in chosen]
    trail = Trail(recording.path[: end + 1], rgb(colour), width=0.05 * view.breadth, opacity=0.85)
    stage = Stage(recording.vehicle, len(poses), len(recording.targets), view.size)
    try:
        pixels = stage.picture(Scene(poses, recording.targets, [trail]), view.camera, FIELD_OF_VIEW, view.width, view.height)
    finally:
        stage.close()
    canvas = Canvas(pixels)
    size = max(12, round(view.height / 34))
    _tag_times(canvas, recording, chosen, view, round(0.92 * size))
    lines = [_outcome(recording, end)]
    if view.size > 1.05:
        lines.append(f"vehicle drawn {view.size:.1f} × its size")
    return with_header(canvas.pixels, recording.name, lines, rgb255(colour), size)


def _tag_times(canvas: Canvas, recording: Recording, chosen: Sequence[int], view: _View, size: int) -> None:
    """The time beside each pose, where it hides least."""
    screen = view.project(recording.path[list(chosen)])
    half = 0.5 * view.pixels(screen[:, 2])
    vehicles: list[Box] = [(x - r, y - r, x + r, y + r) for (x, y, _), r in zip(screen, 0.8 * half, strict=True)]
    taken = [*vehicles]
    path = view.project(recording.path[::3])[:, :2]
    for step, (x, y, _), reach in zip(chosen, screen, half, strict=True):
        text = f"{recording.times[step]:.2f} s"
        places = []
        for angle in np.radians(np.arange(0, 360, 30)):
            centre = (x + (reach + 2.6 * size) * np.cos(angle), y + (reach + 1.2 * size) * np.sin(angle))
            box = tag_box(text, centre, size)
            outside = overlap(box, (0, 0, view.width, view.height)) < 0.999 * (box[2] - box[0]) * (box[3] - box[1])
            crossed = ((path > box[:2]) & (path < box[2:])).all(axis=1).sum()
            places.append((1e6 * outside + sum(overlap(box, other) for other in taken) + 4.0 * crossed, centre))
        _, centre = min(places)
        taken.append(canvas.tag(text, centre, size))


def _outcome(recording: Recording, end: int) -> str:
    if recording.lost:
        return f"{recording.lost} after {recording.times[-1]:.2f} s"
    if end < len(recording.times) - 1:
        return f"within {SETTLED:g} m of its target from {recording.times[end]:.2f} s on"
    return f"{recording.error[end]:.2f} m from its target after {recording.times[end]:.2f} s"
