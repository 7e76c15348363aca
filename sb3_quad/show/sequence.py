"""The motion sequence of a flight in one picture: several poses with their times (cf. the thesis's
Fig. A.1).
"""

from collections.abc import Sequence
from contextlib import closing
from typing import NamedTuple

import numpy as np

from sb3_quad.base.arrays import FloatArray, Image
from sb3_quad.envs.rendering.camera import Camera, Lens, broadside, framing_camera
from sb3_quad.envs.rendering.models import span
from sb3_quad.envs.rendering.picture import Trail
from sb3_quad.envs.rendering.scene import Scene
from sb3_quad.show.episodes import Recording
from sb3_quad.show.labels import side_by_side, tag_size, with_header, with_tags

SETTLED = 0.25  # m: for a sequence, a flight is over once it stays that near its target
VEHICLE_SHARE = 0.15  # of the picture's height that a vehicle is drawn across at least
LARGEST = 6.0  # how much larger than life it is drawn at most
APART = 0.8  # between poses in the picture, in the vehicle's drawn breadth


class _View(NamedTuple):
    """How all panels of a sequence are seen."""

    camera: Camera
    size: float  # how much larger than life vehicles are drawn
    breadth: float  # of a drawn vehicle, m

    def project(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Where points, (n, 3), are in the picture, (n, 2), and how broad vehicles are there, (n,);
        pixels.
        """
        screen, lens = self.camera.project(points), self.camera.lens
        return screen[:, :2], self.breadth * lens.height / (2.0 * lens.slope * screen[:, 2])


def sequence(recordings: Sequence[Recording], width: int, height: int) -> Image:
    """One panel for each recording, all seen by the same camera; as many poses as do not hide one
    another.

    :param width: of a panel, its header not counted, pixels; ``height`` likewise.
    :return: uint8 (height, about panels * width, 3).
    """
    ends = [_end(recording) for recording in recordings]
    view = _view(recordings, ends, Lens(width, height))
    panels = [
        _panel(each, _steps(each, end, view), end, view)
        for each, end in zip(recordings, ends, strict=True)
    ]
    return side_by_side(panels, columns=len(panels))


def _end(recording: Recording) -> int:
    """The step after which the vehicle stays at its target, or the last one."""
    away = np.flatnonzero(recording.state.distance > SETTLED)
    return min(int(away[-1]) + 1 if away.size else 0, len(recording.times) - 1)


def _view(recordings: Sequence[Recording], ends: Sequence[int], lens: Lens) -> _View:
    paths = [
        recording.state.position[: end + 1] for recording, end in zip(recordings, ends, strict=True)
    ]
    points = np.concatenate([*paths, *(recording.targets for recording in recordings)])
    forward, breadth, enlarged = broadside(points), 2.0 * span(recordings[0].vehicle), 1.0
    for _ in range(5):  # a larger vehicle needs a camera farther away
        camera = framing_camera(points, 0.8 * enlarged * breadth, forward, lens)
        depth = float(np.median((points - camera.eye) @ camera.axes[0]))
        enlarged = float(np.clip(VEHICLE_SHARE * 2.0 * lens.slope * depth / breadth, 1.0, LARGEST))
    return _View(camera, enlarged, enlarged * breadth)


def _steps(recording: Recording, end: int, view: _View) -> list[int]:
    """The steps of the poses: each that hides none before it, the pushes, and how the flight was
    lost.
    """
    places, breadth = view.project(recording.state.position[: end + 1])
    shown = {
        0,
        *(push for push in recording.pushes if push <= end),
        *([end] if recording.lost else []),
    }
    for step in range(1, end + 1):
        if np.linalg.norm(places[[*shown]] - places[step], axis=1).min() > APART * breadth[step]:
            shown.add(step)
    return sorted(shown)


def _panel(recording: Recording, steps: Sequence[int], end: int, view: _View) -> Image:
    trail = Trail(recording.state.position[: end + 1], recording.colour, 0.05 * view.breadth)
    with closing(
        Scene(recording.vehicle, None, len(steps), len(recording.targets), view.size)
    ) as scene:
        scene.place([recording.pose(step, seconds=0.0) for step in steps], recording.targets)
        pixels = scene.picture(view.camera, [trail])
    size = max(12, round(view.camera.lens.height / 34))
    tag = round(0.92 * size)
    pixels = with_tags(pixels, _time_tags(recording, steps, view, tag), tag)
    if recording.lost:
        lines = [f"{recording.lost} after {recording.times[-1]:.2f} s"]
    elif end < len(recording.times) - 1:
        lines = [f"within {SETTLED:g} m of its target from {recording.times[end]:.2f} s on"]
    else:
        lines = [
            f"{recording.state.distance[end]:.2f} m from its target after {recording.times[end]:.2f} s"
        ]
    if view.size > 1.05:
        lines.append(f"vehicle drawn {view.size:.1f} × its size")
    arrows = (
        "; arrows: force (red), torque (violet)"
        if any(recording.wrench[step].any() for step in steps)
        else ""
    )
    lines.append(f"green hoops: target{arrows}")
    return with_header(pixels, recording.name, lines, recording.colour, size)


def _time_tags(
    recording: Recording, steps: Sequence[int], view: _View, size: int
) -> list[tuple[str, tuple[float, float]]]:
    """The time of each pose and where it is written: above it, inside the picture."""
    tags = []
    for step, (column, row), breadth in zip(
        steps, *view.project(recording.state.position[list(steps)]), strict=True
    ):
        text = f"{recording.times[step]:.2f} s"
        half = 0.5 * np.array(tag_size(text, size))
        middle = np.clip([column, row - 0.4 * breadth - half[1]], half, view.camera.lens[:2] - half)
        tags.append((text, (float(middle[0]), float(middle[1]))))
    return tags
