"""A window of matplotlib that shows pictures in real time."""

import os
import sys
import time

import numpy as np

from sb3_quad.base.errors import ConfigError, raised_as
from sb3_quad.base.types import Image

DPI = 100
FPS = 25  # pictures a second, of windows and films


def has_display() -> bool:
    """Whether a window can be opened."""
    return not sys.platform.startswith("linux") or bool(os.environ.get("DISPLAY"))


class Window:
    """A window, open until it is closed or somebody shuts it.

    :param width: width of its pictures, pixels; ``height`` likewise.
    :raises ConfigError: matplotlib cannot open one.
    """

    def __init__(self, width: int, height: int) -> None:
        with raised_as(ConfigError, "matplotlib cannot open a window"):
            # It takes half a second to import.
            from matplotlib import pyplot

            size = (width / DPI, height / DPI)
            with pyplot.rc_context({"toolbar": "None"}):
                self.figure = pyplot.figure(figsize=size, dpi=DPI, facecolor="black")
            if self.figure.canvas.required_interactive_framework is None:
                pyplot.close(self.figure)
                raise ConfigError(
                    "matplotlib has no toolkit for windows here: pip install PyQt6, or make a film "
                    "or pictures"
                )
            self.figure.show()
        axes = self.figure.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.set_axis_off()
        self._image = axes.imshow(np.zeros((height, width, 3), np.uint8))
        self._due = time.perf_counter()

    @property
    def is_open(self) -> bool:
        """Whether the window has not been shut."""
        from matplotlib import pyplot

        return bool(pyplot.fignum_exists(self.figure.number))

    def show(self, picture: Image, seconds: float) -> None:
        """Show a picture, uint8 (height, width, 3), for some seconds since the one before."""
        self._image.set_data(picture)
        self.figure.canvas.draw_idle()
        # Real time, without hurry after a picture that took longer.
        now = time.perf_counter()
        self._due = max(self._due + seconds, now + 0.001)
        self.figure.canvas.start_event_loop(self._due - now)

    def close(self) -> None:
        """Close the window; calling it twice is fine."""
        from matplotlib import pyplot

        pyplot.close(self.figure)
