"""Recorded flights in motion: a film with a panel for each, or PyBullet's window with all vehicles
together, in real time.
"""

import math
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image as Pillow

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import write_bytes
from sb3_quad.base.imports import require
from sb3_quad.base.types import FloatArray, Image, StrDict
from sb3_quad.envs.rendering.bullet_client import p
from sb3_quad.envs.rendering.camera import MARGIN, WIDE, Camera, Lens, framing_camera
from sb3_quad.envs.rendering.scene import Scene
from sb3_quad.envs.rendering.window import open_window, point_window, start_drawing
from sb3_quad.envs.simulation.state import POSITION, TARGET
from sb3_quad.show.episodes import Episode, Recording, outlook
from sb3_quad.show.labels import mark_lost, side_by_side, with_header

FPS = 25
HOLD = 0.4  # the last picture stays for this long, s
AHEAD = 3.0  # how much of the way to its target a camera shows, m, for the default vehicle
PANELS_ABREAST = 3
LAG = 0.044  # time after which a camera has followed a jump, as to a new target, up to 1/e, s
LOOP = {"duration": 1000 / FPS, "loop": 0}
# How imageio writes each format
FORMATS: dict[str, StrDict] = {
    ".mp4": {
        "fps": FPS,
        "codec": "libx264",
        "quality": 7,
        "macro_block_size": 2,
        "ffmpeg_log_level": "error",
    },
    ".webp": LOOP,
    ".gif": LOOP,
}


def check_film(path: Path) -> Any:
    """Return the package that writes a film, before anything is flown.

    :raises ConfigError: the suffix is not one of FORMATS, or the packages that write videos are
        missing.
    """
    if path.suffix.lower() not in FORMATS:
        raise ConfigError(
            f"{path}: must end in {', '.join(FORMATS)} for a film, .png for a picture"
        )
    require("imageio_ffmpeg", "video", "a video")
    return require("imageio.v2", "video", "a video")


def write_film(path: Path, frames: Iterable[Image]) -> None:
    """Write all ``frames``, uint8 (height, width, 3), all of one size; an interruption leaves an
    earlier film as it is.

    :raises ConfigError: a folder that cannot be written, a full disk, missing packages.
    """
    imageio = check_film(path)
    suffix = path.suffix.lower()
    # Write in another folder: after an interruption, the encoder may still write for a moment.
    with tempfile.TemporaryDirectory(prefix="sb3_quad_", ignore_cleanup_errors=True) as folder:
        draft = Path(folder, f"film{suffix}")
        try:
            with imageio.get_writer(draft, **FORMATS[suffix]) as writer:
                for frame in frames:
                    writer.append_data(frame)
            content = draft.read_bytes()
        except OSError as error:
            raise ConfigError(f"{path}: cannot be encoded ({error.strerror or error})") from error
    write_bytes(path, content)


def frame_times(recordings: Episode, speed: float) -> FloatArray:
    """The times of flight, s, that the frames of a film of several flights show."""
    last = max(float(recording.times[-1]) for recording in recordings)
    frames = np.arange(round((last / speed + HOLD) * FPS) + 1)
    return np.minimum(frames * speed / FPS, last)


def film_frames(
    recordings: Episode, width: int, height: int, speed: float = 1.0
) -> Iterator[Image]:
    """The frames of a film, FPS of them a second, uint8 (height, width, 3), all of one size.

    :param recordings: one for each panel; they start together and are seen from the same direction.
    :param width: width of a panel, pixels; ``height`` likewise, not counting its header.
    :param speed: speed of time in the film; 0.5 is slow motion.
    """
    times = frame_times(recordings, speed)
    # One direction for all panels, so that their flights can be compared.
    forward = outlook(recordings)
    lens = Lens(width, height)
    panels = [_panel(recording, times, forward, lens) for recording in recordings]
    # Frame by frame, because a film does not fit into memory.
    for pictures in zip(*panels, strict=True):
        yield side_by_side(pictures, PANELS_ABREAST)


def following_cameras(
    recordings: Episode,
    times: FloatArray,
    scale: float,
    forward: FloatArray,
    lens: Lens,
) -> Iterator[Camera]:
    """Yield a camera for each time (s) that has all vehicles in its picture, and their targets when
    these are near.

    :param scale: the vehicles' size, relative to the default one.
    :param forward: the direction in which the cameras look, a unit vector, (3,), not vertical.
    """
    reach = AHEAD * scale
    points = []
    # The vehicles, and their targets, or at most AHEAD of the way there along each axis.
    for recording in recordings:
        steps = recording.at(times)
        vehicle = recording.state.position[steps]
        way = recording.state.target[steps] - vehicle
        points += [vehicle, vehicle + way.clip(-reach, reach)]
    # The share of a jump that the camera follows from one frame to the next.
    share = 1.0 - math.exp(-(times[1] - times[0]) / LAG)
    eye = None
    for shown in np.stack(points, axis=1):
        camera = framing_camera(shown, MARGIN * scale, forward, lens)
        if eye is not None:
            # The camera follows with a lag, so that a jump of the target does not make the picture
            # jump.
            camera = camera._replace(eye=eye + share * (camera.eye - eye))
        eye = camera.eye
        yield camera


def _panel(
    recording: Recording, times: FloatArray, forward: FloatArray, lens: Lens
) -> Iterator[Pillow.Image]:
    """One flight at the times (s) of a film's frames, seen along ``forward``, (3,)."""
    font_size = max(12, round(lens.height / 26))
    with closing(Scene(recording.vehicle)) as scene:
        cameras = following_cameras([recording], times, scene.scale, forward, lens)
        for step, camera in zip(recording.at(times), cameras, strict=True):
            pose = recording.pose(step)
            scene.place([pose], pose.state[None, TARGET])
            picture = scene.picture(camera, recording.trails(step))
            # A lost vehicle stands still from then on, in a picture without colours.
            if recording.lost and step == recording.state.n - 1:
                picture = mark_lost(picture, recording.lost, 2 * font_size)
            yield with_header(picture, recording, [_caption(recording, step)], font_size)


def _caption(recording: Recording, step: int) -> str:
    seconds = f"{recording.times[step]:5.2f} s"
    distance = recording.state.distance[step]
    height = recording.state.position[step, 2]
    caption = f"{seconds}   {distance:.2f} m from target   {height:.1f} m high"
    # Only disturbed flights have a force to show.
    force = np.linalg.norm(recording.wrench_around(step)[:6])
    if force:
        caption += f"   force {force:.1f} N"
    return caption


def show_in_window(episodes: Sequence[Episode], width: int, height: int, speed: float) -> None:
    """Show episodes one after the other, until the window is shut; flights of an episode start
    together.

    :raises ConfigError: the window cannot be opened.
    """
    client = open_window(width, height)
    try:
        # Add all bodies before the window draws, since it would show each one as it is added.
        n = len(episodes[0])
        scene = Scene(episodes[0][0].vehicle, client, n_vehicles=n, n_targets=n)
        start_drawing(client)
        for recordings in episodes:
            _play(scene, recordings, Lens(width, height, WIDE), speed)
    except p.error:
        # PyBullet also raises when somebody shuts the window; that is how this ends.
        if client.isConnected():
            raise
    finally:
        client.close()


def _play(scene: Scene, recordings: Episode, lens: Lens, speed: float) -> None:
    times = frame_times(recordings, speed)
    cameras = following_cameras(recordings, times, scene.scale, outlook(recordings), lens)
    begun = time.perf_counter()
    for number, (seconds, camera) in enumerate(zip(times, cameras, strict=True)):
        # The frames follow the clock, so that flights are shown in real time: each waits for its
        # time, and those that would come too late are skipped.
        early = begun + number / FPS - time.perf_counter()
        if early < -1.0 / FPS:
            continue
        time.sleep(max(0.0, early))
        poses = [recording.pose(recording.at(seconds)) for recording in recordings]
        states = np.stack([pose.state for pose in poses])
        scene.place(poses, states[:, TARGET])
        point_window(scene.client, camera, states[:, POSITION].mean(axis=0))
