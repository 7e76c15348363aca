"""Recorded flights in motion: a film with a panel for each, or PyBullet's window with all vehicles together, in real time."""

import math
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import to_rgb

from sb3_quad.base.arrays import FloatArray, Image
from sb3_quad.base.bullet import p
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import write_bytes
from sb3_quad.base.imports import require
from sb3_quad.envs.rendering.camera import Camera, Lens, broadside, following_cameras, framing_camera
from sb3_quad.envs.rendering.labels import side_by_side, with_header
from sb3_quad.envs.rendering.picture import Overlay
from sb3_quad.envs.rendering.scene import Scene
from sb3_quad.envs.rendering.window import disconnect, open_window, point_window, start_drawing
from sb3_quad.show.episodes import Recording

FPS = 25
HOLD = 1.0  # the last picture stays for that long, s
MARGIN = 0.9  # around vehicle and target, m, for a vehicle of the default one's size
PANELS_ABREAST = 3
SMALL = 0.2  # a vehicle whose breadth is less of the picture's height is shown from near as well
CLOSE_UP, GAP = 0.34, 8  # side of that picture, of the panel's; its distance from the edges, pixels
WINDOW_SLOPE = math.tan(math.radians(30.0))  # PyBullet's
MP4 = {"codec": "libx264", "quality": 7, "macro_block_size": 2, "ffmpeg_log_level": "error"}
FORMATS = (".mp4", ".gif")


def check_film(path: Path) -> Any:
    """See whether a film can be written, before anything is flown; the package that writes it.

    :raises ConfigError: the suffix is not one of FORMATS, or the packages that write videos are missing.
    """
    if path.suffix.lower() not in FORMATS:
        raise ConfigError(f"{path}: must end in {' or '.join(FORMATS)}")
    require("imageio_ffmpeg", "video", "a video")
    return require("imageio.v2", "video", "a video")


def write_film(path: Path, frames: Iterable[Image]) -> None:
    """Write all ``frames``, uint8 (height, width, 3), all of one size; an interruption leaves what was there before.

    :raises ConfigError: a folder that cannot be written, a full disk, missing packages.
    """
    imageio = check_film(path)
    suffix = path.suffix.lower()
    options = {"fps": FPS, **MP4} if suffix == ".mp4" else {"duration": 1000 / FPS, "loop": 0}
    # Not beside the file: when it is interrupted, the encoder may still be writing for a moment.
    with tempfile.TemporaryDirectory(prefix="sb3_quad_", ignore_cleanup_errors=True) as folder:
        draft = Path(folder, f"film{suffix}")
        try:
            with imageio.get_writer(draft, **options) as writer:
                for frame in frames:
                    writer.append_data(frame)
            content = draft.read_bytes()
        except OSError as error:
            raise ConfigError(f"{path}: cannot be encoded ({error.strerror or error})") from error
    write_bytes(path, content)


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
    panels = [_panel(recording, times, forward, Lens(width, height)) for recording in recordings]
    for pictures in zip(*panels, strict=True):
        yield side_by_side(pictures, PANELS_ABREAST)


def _panel(recording: Recording, times: FloatArray, forward: FloatArray, lens: Lens) -> Iterator[Image]:
    """One flight at the times (s) of a film's frames, seen along ``forward``, (3,)."""
    steps = [recording.at(seconds) for seconds in times]
    seen = [recording.vehicle_and_target(step) for step in steps]
    frame_seconds, font_size = max(float(times[1] - times[0]), 1e-3), max(12, round(lens.height / 26))
    side = round(CLOSE_UP * min(lens.width, lens.height))
    with closing(Scene(recording.vehicle)) as scene:
        cameras = following_cameras(seen, frame_seconds, MARGIN * scene.scale, forward, lens)
        corner = _free_corner(cameras, seen, side)
        shown = None
        for step, camera in zip(steps, cameras, strict=True):
            if shown != (key := (step, camera.eye.round(3).tolist())):
                shown, pixels = key, _draw(recording, step, scene, camera, corner, side)
                picture = with_header(pixels, recording.name, [_caption(recording, step)], recording.colour, font_size)
            yield picture


def _draw(recording: Recording, step: int, scene: Scene, camera: Camera, corner: tuple[int, int], side: int) -> Image:
    """A picture of one step; where the vehicle is small, with a close-up in a corner."""
    path, (left, top) = recording.state.position, corner
    scene.place([recording.pose(step)], recording.state.target[[step]])
    trail = Overlay(path[: step + 1 : 2], recording.colour, 0.75, width=0.03 * scene.scale)
    pixels = scene.picture(camera, [trail])
    if scene.span < SMALL * float((path[step] - camera.eye) @ camera.axes[0]) * camera.lens.slope:
        near = framing_camera(path[[step]], 1.15 * scene.span, camera.axes[0], Lens(side, side))
        pixels[top - 2 : top + side + 2, left - 2 : left + side + 2] = 255
        pixels[top : top + side, left : left + side] = scene.picture(near, [trail])
    return pixels


def _free_corner(cameras: Sequence[Camera], seen: Sequence[FloatArray], side: int) -> tuple[int, int]:
    """Left and top of a close-up, in the corner in which the points that are ``seen`` are least."""
    spots = np.concatenate([camera.project(points)[:, :2] for camera, points in zip(cameras, seen, strict=True)])
    right, bottom, half = cameras[0].lens.width - side - GAP, cameras[0].lens.height - side - GAP, side / 2
    corners = [(GAP, bottom), (right, bottom), (GAP, GAP), (right, GAP)]
    return min(corners, key=lambda corner: int((np.abs(spots - corner - half) < half + GAP).all(axis=1).sum()))


def _caption(recording: Recording, step: int) -> str:
    seconds = f"{recording.times[step]:5.2f} s"
    if step == len(recording.times) - 1 and recording.lost:
        return f"{seconds}   {recording.lost}"
    force = float(np.linalg.norm(recording.wrench_around(step)[:6]))
    push = f"   force {force:.1f} N" if force else ""
    height = recording.state.position[step, 2]
    return f"{seconds}   {recording.state.distance[step]:.2f} m from target   {height:.1f} m high{push}"


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
