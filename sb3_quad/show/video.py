"""Frames written as a video file, whole or not at all."""

from __future__ import annotations

import importlib
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import write_bytes

FORMATS = (".mp4", ".gif")


def check_video(path: Path) -> None:
    """See whether a video can be written, before anything is flown.

    :raises ConfigError: a suffix that is no video format of ours, or the packages that write videos are missing.
    """
    if path.suffix.lower() not in FORMATS:
        raise ConfigError(f"{path}: must end in {' or '.join(FORMATS)}")
    _imageio()


def write_video(path: Path, frames: Iterable[npt.NDArray[np.uint8]], fps: int) -> None:
    """Write all ``frames``, uint8 (height, width, 3), all of one size; an interruption leaves what was there before.

    :raises ConfigError: a folder that cannot be written, a full disk, missing packages.
    """
    imageio = _imageio()
    suffix = path.suffix.lower()
    options: dict[str, Any] = {"duration": 1000 / fps, "loop": 0}
    if suffix == ".mp4":
        options = {"fps": fps, "codec": "libx264", "quality": 7, "macro_block_size": 2, "ffmpeg_log_level": "error"}
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


def _imageio() -> Any:
    try:
        importlib.import_module("imageio_ffmpeg")
        return importlib.import_module("imageio.v2")
    except ImportError as error:
        raise ConfigError(f"videos need further packages ({error}): pip install sb3_quad[video]") from None
