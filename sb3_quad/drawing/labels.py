"""Text in pictures, in the font that comes with matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

Colour = tuple[int, int, int]
Box = tuple[float, float, float, float]  # left, top, right, bottom, pixels

INK: Colour = (24, 32, 44)
PAPER: Colour = (255, 255, 255)
STEP = 1.3  # between lines of text, in font sizes
SMALLER = 0.88  # font size of what stands below a heading


@cache
def font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    """DejaVu Sans, ``size`` in pixels."""
    import matplotlib

    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(matplotlib.get_data_path(), "fonts", "ttf", name)), size)


class Canvas:
    """A picture to write on.

    :param pixels: uint8 (height, width, 3); is not changed.
    """

    def __init__(self, pixels: npt.NDArray[np.uint8]) -> None:
        self.image = Image.fromarray(pixels)
        self.draw = ImageDraw.Draw(self.image, "RGBA")

    @property
    def pixels(self) -> npt.NDArray[np.uint8]:
        """The picture, uint8 (height, width, 3)."""
        return np.asarray(self.image, dtype=np.uint8)

    def tag(self, text: str, centre: tuple[float, float], size: int) -> Box:
        """A small plate with ``text`` around ``centre``; the room it takes."""
        box = tag_box(text, centre, size)
        self.draw.rounded_rectangle(box, radius=0.3 * size, fill=(*PAPER, 205))
        self.draw.text(centre, text, font=font(size), fill=INK, anchor="mm")
        return box

    def line(self, start: tuple[float, float], end: tuple[float, float], colour: Colour, width: int = 1) -> None:
        """A straight line."""
        self.draw.line((*start, *end), fill=(*colour, 190), width=width)


def tag_box(text: str, centre: tuple[float, float], size: int) -> Box:
    """The room that :meth:`Canvas.tag` takes."""
    half = 0.5 * font(size).getlength(text) + 0.35 * size
    return centre[0] - half, centre[1] - 0.75 * size, centre[0] + half, centre[1] + 0.75 * size


def overlap(one: Box, other: Box) -> float:
    """The area that two boxes share, pixels."""
    wide = min(one[2], other[2]) - max(one[0], other[0])
    high = min(one[3], other[3]) - max(one[1], other[1])
    return max(wide, 0.0) * max(high, 0.0)


def with_header(
    pixels: npt.NDArray[np.uint8], heading: str, lines: Sequence[str], colour: Colour, size: int
) -> npt.NDArray[np.uint8]:
    """A picture with a white band above it: a bar in ``colour``, a bold heading, and lines below; ``size``: of the font.

    :return: uint8; as wide, and higher by :func:`header_height`.
    """
    height, width = pixels.shape[:2]
    band = header_height(len(lines), size)
    image = np.full((band + height, width, 3), 255, dtype=np.uint8)
    image[band:] = pixels
    canvas = Canvas(image)
    bar = 0.45 * size
    canvas.draw.rectangle((0, 0, bar, band - 1), fill=(*colour, 255))
    fonts = [font(size, bold=True), *(font(round(SMALLER * size)) for _ in lines)]
    for number, (face, line) in enumerate(zip(fonts, [heading, *lines], strict=True)):
        canvas.draw.text((bar + 0.7 * size, 0.35 * size + number * STEP * size), line, font=face, fill=INK)
    return canvas.pixels


def header_height(n_lines: int, size: int) -> int:
    """The height of the band of :func:`with_header`, pixels."""
    return round((0.7 + STEP * (1 + n_lines)) * size)


def side_by_side(pictures: Sequence[npt.NDArray[np.uint8]], columns: int, gap: int = 4) -> npt.NDArray[np.uint8]:
    """Pictures of one size in rows of ``columns``, on white; even in width and height, as video codecs ask for."""
    height, width = pictures[0].shape[:2]
    rows = -(-len(pictures) // columns)
    columns = min(columns, len(pictures))
    high, wide = rows * (height + gap) - gap, columns * (width + gap) - gap
    sheet = np.full((high + high % 2, wide + wide % 2, 3), 255, dtype=np.uint8)
    for number, picture in enumerate(pictures):
        top, left = (number // columns) * (height + gap), (number % columns) * (width + gap)
        sheet[top : top + height, left : left + width] = picture
    return sheet
