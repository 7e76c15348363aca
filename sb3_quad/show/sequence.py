"""The motion sequence of a flight in one picture: several poses with their times (cf. the thesis's
Fig. A.1).
"""

from contextlib import closing
from typing import NamedTuple

import numpy as np
from PIL import Image as Pillow
from PIL import ImageDraw

from sb3_quad.base.types import FloatArray, Image
from sb3_quad.envs.rendering.camera import Camera, Lens, framing_camera
from sb3_quad.envs.rendering.models import rotor_radius
from sb3_quad.envs.rendering.scene import Scene
from sb3_quad.show.episodes import Episode, Recording, landmarks, outlook
from sb3_quad.show.labels import INK, PLATE, font, side_by_side, with_header

SETTLED = 0.25  # m: in a sequence, a flight is over once it stays this close to its target
VEHICLE_SHARE = 0.15  # least breadth of a drawn vehicle, as a share of the picture's height
LARGEST = 6.0  # the most that it is enlarged
APART = 0.95  # between poses in the picture, in the vehicle's drawn breadth
AROUND = np.array([[0, 1, -1, 0], [-1, 0, 0, 1]]).T  # where its time may be; above it is best
COVERED = 0.4  # half the breadth that text should not cover, in a pose's drawn breadth


class View(NamedTuple):
    """The camera and the size of the vehicles, the same in all panels of a sequence."""

    camera: Camera
    size: float  # how much larger than life vehicles are drawn
    breadth: float  # of a drawn vehicle, m

    def project(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the places of points, (n, 3), in the picture, (n, 2), and the breadths of vehicles
        there, (n,); pixels.
        """
        screen = self.camera.project(points)
        lens = self.camera.lens
        return screen[:, :2], self.breadth * lens.height / (2.0 * lens.slope * screen[:, 2])


def sequence(recordings: Episode, width: int, height: int) -> Image:
    """Draw one panel for each recording, all seen by the same camera, with as many poses as do not
    hide one another.

    :param width: width of a panel, not counting its header, pixels; ``height`` likewise.
    :return: uint8 (height, about panels * width, 3).
    """
    # One view for all panels, so that their poses can be compared.
    settled = [until_settled(recording) for recording in recordings]
    view = view_of(settled, Lens(width, height))
    return side_by_side([_panel(recording, view) for recording in settled], len(settled))


def until_settled(recording: Recording) -> Recording:
    """Return a flight without the part after the vehicle stays at its target."""
    if recording.lost or recording.follows:
        return recording
    last = int(np.flatnonzero(recording.state.distance > SETTLED).max(initial=-1)) + 1
    return recording.until(last)


def view_of(recordings: Episode, lens: Lens) -> View:
    """Return the view that has all flights in its picture."""
    points = landmarks(recordings)
    forward = outlook(recordings)
    vehicle = recordings[0].vehicle
    breadth = 2.0 * (vehicle.arm_length + rotor_radius(vehicle))
    size = 1.0
    # A larger vehicle needs a camera farther away, from which it must be drawn larger.
    for _ in range(5):
        camera = framing_camera(points, 0.8 * size * breadth, forward, lens)
        depth = np.median((points - camera.eye) @ camera.axes[0])
        size = float(np.clip(VEHICLE_SHARE * 2.0 * lens.slope * depth / breadth, 1.0, LARGEST))
    return View(camera, size, size * breadth)


def pose_steps(recording: Recording, view: View) -> list[int]:
    """The steps of the poses: those that hide none before them, the disturbances, and the crash."""
    places, breadth = view.project(recording.state.position)
    # The start, the disturbances and the crash are shown in any case.
    shown = [0, *recording.disturbances]
    if recording.lost:
        shown.append(len(places) - 1)
    # Show those of the others that are clear of all poses before them.
    for step, place in enumerate(places):
        apart = np.linalg.norm(places[shown] - place, axis=1).min()
        if apart > APART * breadth[step]:
            shown.append(step)
    return sorted(set(shown))


def _panel(recording: Recording, view: View) -> Pillow.Image:
    steps = pose_steps(recording, view)
    # For a moving target, hoops mark the place at the end.
    targets = recording.state.target[-1:] if recording.follows else recording.targets
    with closing(Scene(recording.vehicle, None, len(steps), len(targets), view.size)) as scene:
        scene.place([recording.pose(step, seconds=0.0) for step in steps], targets)
        picture = scene.picture(view.camera, recording.trails(recording.state.n))
    # The texts grow with the picture, but stay legible in a small one.
    size = max(12, round(view.camera.lens.height / 34))
    draw_times(ImageDraw.Draw(picture, "RGBA"), recording, steps, view, round(0.92 * size))
    lines = [recording.end]
    if not recording.lost and not recording.follows and recording.state.distance[-1] <= SETTLED:
        lines = [f"within {SETTLED:g} m of its target from {recording.times[-1]:.2f} s on"]
    # Explain what a reader could misunderstand: an enlarged vehicle, hoops and arrows.
    if view.size > 1.05:
        lines.append(f"vehicle drawn {view.size:.1f} × its size")
    signs = "green line: path of the target" if recording.follows else "green hoops: target"
    if recording.wrench[steps].any():
        signs += "; arrows: force (red), torque (violet)"
    return with_header(picture, recording, [*lines, signs], size)


def draw_times(
    draw: ImageDraw.ImageDraw, recording: Recording, steps: list[int], view: View, size: int
) -> None:
    """Write the time of each pose on a small plate beside it, inside the picture, where it covers
    least; a plate without room clear of the others is left out.

    :param size: font size, pixels.
    """
    places, breadths = view.project(recording.state.position)
    # What should not be covered: the points of the path, the poses, and then the plates. Each is a
    # box, by its centre and half its size.
    boxes = np.hstack([places, np.zeros_like(places)])
    boxes[steps, 2:] = COVERED * breadths[steps, None]
    for step in steps:
        text = f"{recording.times[step]:.2f} s"
        half = 0.5 * np.array([font(size).getlength(text) + 0.7 * size, 1.5 * size])
        # The centre is clipped so that the whole plate is inside the picture.
        around = places[step] + AROUND * (boxes[step, 2:] + half)
        around = np.clip(around, half, view.camera.lens[:2] - half)
        overlaps = boxes[:, 2:] + half - abs(boxes[:, :2] - around[:, None])
        covered = overlaps.clip(0.0).prod(axis=2)
        best = covered.sum(axis=1).argmin()
        if covered[best, len(places) :].any():
            continue
        centre = around[best]
        boxes = np.vstack([boxes, [*centre, *half]])
        draw.rounded_rectangle((*(centre - half), *(centre + half)), 0.3 * size, fill=PLATE)
        draw.text((centre[0], centre[1]), text, font=font(size), fill=INK, anchor="mm")
