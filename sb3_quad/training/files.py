"""Whole files or none, with a clear error where a folder cannot be written."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

from sb3_quad.common.files import atomic_write
from sb3_quad.errors import ConfigError

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write a file whole.

    :raises ConfigError: a folder that cannot be written, a full disk.
    """
    try:
        with atomic_write(Path(path)) as file:
            file.write(content)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror or error})") from error


def write_text(path: str | Path, text: str) -> None:
    """Write a text file whole.

    :raises ConfigError: a folder that cannot be written, a full disk.
    """
    write_bytes(path, text.encode("utf-8"))


def refuse_existing(path: str | Path, overwrite: bool) -> None:
    """See that a file that a command is to write does not cost one that is there.

    :raises ConfigError: it exists, and ``overwrite`` was not asked for; or it is a folder.
    """
    if Path(path).is_dir():
        raise ConfigError(f"{path}: is a folder; name a file")
    if Path(path).exists() and not overwrite:
        raise ConfigError(f"{path}: exists already; name another file, or add --overwrite")


def model_bytes(model: BaseAlgorithm) -> bytes:
    """The zip that ``model.save`` would write."""
    buffer = io.BytesIO()
    model.save(buffer)
    return buffer.getvalue()


def save_model(model: BaseAlgorithm, path: str | Path) -> None:
    """``model.save(path)``, whole or not at all.

    :raises ConfigError: a folder that cannot be written, a full disk.
    """
    write_bytes(path, model_bytes(model))
