"""The motion sequence of a flight in one picture: several poses with their times (cf. the thesis's Fig. A.1)."""

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
AREA, RATIOS = 290_000, (0.7, 1.6)  # of a panel: pixels, width by height
LARGEST = 6.0  # how much larger than life it is drawn at most
APART = 0.8  # between poses in the picture, in the vehicle's drawn breadth: so far away, a flight asks for one more
SIDES = np.array([[-1, 0], [1, 0], [0, -1], [0, 1], [-0.8, -0.8], [0.8, -0.8], [-0.8, 0.8], [0.8, 0.8]])  # of a pose
NEAR = 0.6  # and with it come those of the other flights at this time that are at least so far from their neighbours


class _View(NamedTuple):
    """How all panels of a sequence are seen."""

    camera: Camera
    size: float  # how much larger than life vehicles are drawn
    breadth: float  # of a drawn vehicle, m

    def project(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Where points, (n, 3), are in the picture, (n, 2), and how broad vehicles are there, (n,); pixels."""
        screen, lens = self.camera.project(points), self.camera.lens
        return screen[:, :2], self.breadth * lens.height / (2.0 * lens.slope * screen[:, 2])


def sequence(
    recordings: Sequence[Recording], times: Sequence[float] | None = None, size: tuple[int, int] | None = None
) -> Image:
    """One panel for each recording, all seen by the same camera.

    :param times: s, at which poses are drawn; None: as many as do not hide one another, at the same times in all panels.
    :param size: width and height of a panel, its header not counted, pixels; None: in the proportions of the flights.
    :return: uint8 (height, about panels * width, 3).
    """
    ends = [_end(recording) if times is None else recording.at(max(times)) for recording in recordings]
    view = _view(recordings, ends, size)
    if times is None:
        chosen = _same_times(recordings, ends, view)
    else:
        chosen = [sorted({recording.at(seconds) for seconds in times}) for recording in recordings]
    panels = [_panel(*each, view) for each in zip(recordings, chosen, ends, strict=True)]
    return side_by_side(panels, columns=len(panels))


def _end(recording: Recording) -> int:
    """The step after which the vehicle stays at its target, or the last one."""
    away = np.flatnonzero(recording.state.distance > SETTLED)
    return min(int(away[-1]) + 1 if away.size else 0, len(recording.times) - 1)


def _view(recordings: Sequence[Recording], ends: Sequence[int], size: tuple[int, int] | None) -> _View:
    paths = [recording.state.position[: end + 1] for recording, end in zip(recordings, ends, strict=True)]
    points = np.concatenate([*paths, *(recording.targets for recording in recordings)])
    forward = broadside(points)
    lens = Lens(*(size or _proportions(points, forward)))
    breadth = 2.0 * span(recordings[0].vehicle)
    enlarged = 1.0
    for _ in range(20):  # a larger vehicle needs a camera farther away
        camera = framing_camera(points, 0.8 * enlarged * breadth, forward, lens)
        depth = float(np.median((points - camera.eye) @ camera.axes[0]))
        wanted = VEHICLE_SHARE * 2.0 * lens.slope * depth / breadth
        enlarged = float(np.clip(0.5 * (enlarged + wanted), 1.0, LARGEST))
    return _View(camera, enlarged, enlarged * breadth)


def _proportions(points: FloatArray, forward: FloatArray) -> tuple[int, int]:
    x, y = forward[:2] / np.linalg.norm(forward[:2])
    high, wide = float(np.ptp(points[:, 2])), float(np.ptp(points[:, 0] * y - points[:, 1] * x))
    ratio = float(np.clip((wide + 0.3 * high + 1.0) / (high + 0.3 * wide + 1.0), *RATIOS))
    width = 2 * round((AREA * ratio) ** 0.5 / 2)
    return width, 2 * round(AREA / width / 2)


def _same_times(recordings: Sequence[Recording], ends: Sequence[int], view: _View) -> list[list[int]]:
    """Steps to be drawn in each panel: one that a flight has room for is drawn in all that it does not hide a pose in."""
    seen = [view.project(each.state.position[: end + 1]) for each, end in zip(recordings, ends, strict=True)]
    chosen: list[list[int]] = [[0] for _ in recordings]
    # When a flight was pushed and how it was lost must be seen.
    shown = [
        {*(push for push in each.pushes if push <= end), *([end] if each.lost else [])}
        for each, end in zip(recordings, ends, strict=True)
    ]
    for step in [*sorted(set().union(*shown)), *range(1, max(ends) + 1)]:
        gaps = {
            k: float(np.linalg.norm(places[chosen[k]] - places[step], axis=1).min() / breadth[step])
            for k, (places, breadth) in enumerate(seen)
            if step <= ends[k]
        }
        asked = any(step in steps for steps in shown) or max(gaps.values()) > APART
        for k, gap in gaps.items():
            if step in shown[k] or (asked and gap > NEAR):
                chosen[k] = sorted({*chosen[k], step})
    return chosen


def _panel(recording: Recording, steps: Sequence[int], end: int, view: _View) -> Image:
    trail = Trail(recording.state.position[: end + 1], recording.colour, 0.05 * view.breadth)
    with closing(Scene(recording.vehicle, None, len(steps), len(recording.targets), view.size)) as scene:
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
        lines = [f"{recording.state.distance[end]:.2f} m from its target after {recording.times[end]:.2f} s"]
    if view.size > 1.05:
        lines.append(f"vehicle drawn {view.size:.1f} × its size")
    arrows = "; arrows: force (red), torque (violet)" if any(recording.wrench[step].any() for step in steps) else ""
    lines.append(f"green hoops: target{arrows}")
    return with_header(pixels, recording.name, lines, recording.colour, size)


def _time_tags(recording: Recording, steps: Sequence[int], view: _View, size: int) -> list[tuple[str, tuple[float, float]]]:
    """The time of each pose and where it is written: beside it, on the side with most room, inside the picture."""
    places, breadth = view.project(recording.state.position[list(steps)])
    taken = [*places]  # what a text keeps away from: poses and the texts before it
    tags = []
    for step, place, reach in zip(steps, places, 0.5 * breadth, strict=True):
        text = f"{recording.times[step]:.2f} s"
        half = 0.5 * np.array(tag_size(text, size))
        around = place + SIDES * (0.8 * reach + half)
        around = around.clip(half, view.camera.lens[:2] - half)
        room = np.linalg.norm(around[:, None] - np.stack(taken), axis=2).min(axis=1)
        chosen = around[int(room.round().argmax())]
        taken.append(chosen)
        tags.append((text, (float(chosen[0]), float(chosen[1]))))
    return tags
