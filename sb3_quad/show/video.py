"""Frames written as a video file, whole or not at all."""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sb3_quad.errors import ConfigError

FORMATS = (".mp4", ".gif")


def check_video(path: Path) -> None:
    """See whether a video can be written, before anything is flown.

    :raises ConfigError: a suffix that is no video format of ours, or the packages that write videos are missing.
    """
    if path.suffix.lower() not in FORMATS:
        raise ConfigError(f"{path}: must end in {' or '.join(FORMATS)}")
    _imageio()


def write_video(path: Path, frames: Iterable[npt.NDArray[np.uint8]], fps: int) -> None:
    """Write all ``frames``, uint8 (height, width, 3), all of one size; an interruption leaves no file.

    :raises ConfigError: a folder that cannot be written, a full disk, missing packages.
    """
    imageio = _imageio()
    beside = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    if path.suffix.lower() == ".mp4":
        options: dict[str, Any] = {
            "fps": fps,
            "codec": "libx264",
            "quality": 7,
            "macro_block_size": 2,
            "ffmpeg_log_level": "error",
        }
    else:
        options = {"duration": 1000 / fps, "loop": 0}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with imageio.get_writer(beside, **options) as writer:
            for frame in frames:
                writer.append_data(frame)
        os.replace(beside, path)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror or error})") from error
    finally:
        beside.unlink(missing_ok=True)


def _imageio() -> Any:
    try:
        importlib.import_module("imageio_ffmpeg")
        return importlib.import_module("imageio.v2")
    except ImportError as error:
        raise ConfigError(f"videos need further packages ({error}): pip install sb3_quad[video]") from None
