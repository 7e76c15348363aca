"""Frames written as a video file, whole or not at all."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from sb3_quad.base.arrays import Image
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.extras import require
from sb3_quad.base.files import write_bytes

MP4 = {"codec": "libx264", "quality": 7, "macro_block_size": 2, "ffmpeg_log_level": "error"}
FORMATS = (".mp4", ".gif")


def check_video(path: Path) -> Any:
    """See whether a video can be written, before anything is flown; the package that writes it.

    :raises ConfigError: the suffix is not one of FORMATS, or the packages that write videos are missing.
    """
    if path.suffix.lower() not in FORMATS:
        raise ConfigError(f"{path}: must end in {' or '.join(FORMATS)}")
    require("imageio_ffmpeg", "video", "a video")
    return require("imageio.v2", "video", "a video")


def write_video(path: Path, frames: Iterable[Image], fps: int) -> None:
    """Write all ``frames``, uint8 (height, width, 3), all of one size; an interruption leaves what was there before.

    :raises ConfigError: a folder that cannot be written, a full disk, missing packages.
    """
    imageio = check_video(path)
    suffix = path.suffix.lower()
    options = {"fps": fps, **MP4} if suffix == ".mp4" else {"duration": 1000 / fps, "loop": 0}
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
