"""PyBullet clients: bodies from text, and the window."""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path
from typing import Any

import pybullet as p

from sb3_quad.base.errors import ConfigError


def load_urdf_text(urdf: str, client: int, **options: Any) -> int:
    """Load a URDF given as text; the body's number. PyBullet reads files only, so one is written and removed."""
    with tempfile.TemporaryDirectory(prefix="sb3_quad_") as folder:
        path = Path(folder, "body.urdf")
        path.write_text(urdf, encoding="utf-8")
        return int(p.loadURDF(str(path), physicsClientId=client, **options))


def has_display() -> bool:
    """Whether a window can be opened; without a display PyBullet would end the whole process."""
    return not sys.platform.startswith("linux") or bool(os.environ.get("DISPLAY"))


def open_window(width: int, height: int) -> int:
    """Open PyBullet's window, of ``width`` and ``height`` pixels; its client.

    :raises ConfigError: there is one already in this process, or it cannot be opened.
    """
    sky = "--background_color_red=0.70 --background_color_green=0.82 --background_color_blue=0.93"
    try:
        client = int(p.connect(p.GUI, options=f"--width={width} --height={height} {sky}"))
    except p.error:
        raise ConfigError("render_mode 'human': PyBullet opens one window per process, and one is open already") from None
    if client < 0:
        raise ConfigError("render_mode 'human': PyBullet could not open its window; use render_mode='rgb_array'")
    return client
