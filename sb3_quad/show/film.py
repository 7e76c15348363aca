"""Recorded flights in motion: a film with a panel for each, or a window that shows it."""

import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ImageDraw, ImageFont

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import write_bytes
from sb3_quad.base.imports import require
from sb3_quad.base.types import FloatArray, Image, StrDict
from sb3_quad.envs.rendering.camera import MARGIN, Camera, Lens, framing_camera
from sb3_quad.envs.rendering.picture import draw, relative_size
from sb3_quad.envs.rendering.window import FPS, Window
from sb3_quad.envs.simulation.state import POSITION, TARGET
from sb3_quad.envs.vehicles.vehicle import Vehicle
from sb3_quad.show.episodes import Episode, Recording, outlook

HOLD = 0.4  # the last picture stays for this long, s
AHEAD = 3.0  # how much of the way to its target a camera shows, m, for the default vehicle
TEXT_SHARE = 1 / 24  # size of the text, in heights of the picture
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
    ".webp": {**LOOP, "quality": 60},
    ".gif": LOOP,
}


def check_film(path: Path) -> Any:
    """Return the package that writes a film, before anything is flown.

    :raises ConfigError: the suffix is not one of FORMATS, or the packages that write videos are
        missing.
    """
    if path.suffix.lower() not in FORMATS:
        raise ConfigError(f"{path}: a film must end in {', '.join(FORMATS)}")
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
    :param width: width of a panel, pixels; ``height`` likewise.
    :param speed: speed of time in the film; 0.5 is slow motion.
    """
    times = frame_times(recordings, speed)
    # One direction for all panels, so that their flights can be compared.
    forward = outlook(recordings)
    lens = Lens(width, height)
    panels = [_panel(recording, times, forward, lens) for recording in recordings]
    # Frame by frame, because a film does not fit into memory.
    for pictures in zip(*panels, strict=True):
        yield np.concatenate(pictures, axis=1)


def following_camera(
    states: FloatArray, vehicle: Vehicle, forward: FloatArray, lens: Lens
) -> Camera:
    """Return a camera that has all vehicles in its picture, and their targets when these are near.

    :param states: the vehicles' states, (STATE_SIZE, n).
    :param vehicle: the kind of all of them.
    :param forward: the direction in which it looks, a unit vector, (3,), not vertical.
    """
    scale = relative_size(vehicle)
    vehicles = states[POSITION].T
    # The targets, or at most AHEAD of the way there along each axis.
    way = states[TARGET].T - vehicles
    ahead = vehicles + way.clip(-AHEAD * scale, AHEAD * scale)
    return framing_camera(np.concatenate([vehicles, ahead]), MARGIN * scale, forward, lens)


def _panel(
    recording: Recording, times: FloatArray, forward: FloatArray, lens: Lens
) -> Iterator[Image]:
    """One flight at the times (s) of a film's frames, seen along ``forward``, (3,)."""
    font = ImageFont.load_default(max(10.0, TEXT_SHARE * lens.height))
    for step in recording.at(times):
        state = recording.state.array[:, step]
        camera = following_camera(state[:, None], recording.vehicle, forward, lens)
        picture = draw(recording.vehicle, state, camera, recording.trails(step))
        text = f"{recording.name}  {recording.times[step]:.2f} s"
        # A lost vehicle stands still from then on.
        if step == recording.state.n - 1:
            text += f"  {recording.lost}"
        ImageDraw.Draw(picture).text((8, 6), text, recording.colour, font)
        yield np.asarray(picture)


def show_in_window(frames: Iterable[Image], width: int, height: int) -> None:
    """Show the frames of a film in real time, until the window is shut.

    :param width: width of a frame, pixels; ``height`` likewise.
    :raises ConfigError: the window cannot be opened.
    """
    window = Window(width, height)
    for frame in frames:
        if not window.is_open:
            return
        window.show(frame, 1.0 / FPS)
    window.close()
