"""Words in pictures, in the font that comes with matplotlib."""

from collections.abc import Sequence
from functools import cache

import matplotlib
import numpy as np
from PIL import Image as Pillow
from PIL import ImageDraw, ImageFont, ImageOps

from sb3_quad.base.types import Image

INK = (24, 32, 44)
PLATE = (255, 255, 255, 205)
STEP = 1.3  # between lines of text, in font sizes
SMALLER = 0.88  # font size of the lines below a heading
GAP = 4  # between pictures side by side, pixels


@cache
def font(size: int, name: str = "DejaVuSans") -> ImageFont.FreeTypeFont:
    """DejaVu Sans, ``size`` in pixels."""
    return ImageFont.truetype(f"{matplotlib.get_data_path()}/fonts/ttf/{name}.ttf", size)


def tag_size(text: str, size: int) -> tuple[float, float]:
    """Return width and height of a tag, pixels; ``size`` of the font."""
    return font(size).getlength(text) + 0.7 * size, 1.5 * size


def with_tags(pixels: Image, tags: Sequence[tuple[str, tuple[float, float]]], size: int) -> Image:
    """Put small plates on a picture, each with a text around its centre (column, row); ``size`` of
    the font.
    """
    image = Pillow.fromarray(pixels)
    draw = ImageDraw.Draw(image, "RGBA")
    for text, (column, row) in tags:
        width, height = tag_size(text, size)
        box = (column - width / 2, row - height / 2, column + width / 2, row + height / 2)
        draw.rounded_rectangle(box, radius=0.3 * size, fill=PLATE)
        draw.text((column, row), text, font=font(size), fill=INK, anchor="mm")
    return np.asarray(image)


def with_header(pixels: Image, heading: str, lines: Sequence[str], colour: str, size: int) -> Image:
    """Put a white band above a picture: a bar in ``colour``, a bold heading, and lines below.

    :param colour: as ``#rrggbb``.
    :param size: of the font, pixels.
    """
    # The band is as high as its lines, with a margin above and below them.
    band = round((0.7 + STEP * (1 + len(lines))) * size)
    bar = 0.45 * size
    image = ImageOps.expand(Pillow.fromarray(pixels), (0, band, 0, 0), "white")
    draw = ImageDraw.Draw(image)
    draw.rectangle((0, 0, bar, band - 1), fill=colour)
    column = bar + 0.7 * size
    draw.text((column, 0.35 * size), heading, font=font(size, "DejaVuSans-Bold"), fill=INK)
    for number, line in enumerate(lines, 1):
        row = (0.35 + number * STEP) * size
        draw.text((column, row), line, font=font(round(SMALLER * size)), fill=INK)
    return np.asarray(image)


def side_by_side(pictures: Sequence[Image], columns: int) -> Image:
    """Pictures of one size in rows of ``columns``, on white; even in width and height, as video
    codecs ask for.
    """
    # Each picture stands in the top left corner of its field; the gap is on its other sides.
    columns = min(columns, len(pictures))
    padding = ((0, -len(pictures) % columns), (0, GAP), (0, GAP), (0, 0))
    fields = np.pad(np.stack(pictures), padding, constant_values=255)
    # Fields (rows, columns, height, width, colour) become one sheet, row by row.
    _, height, width, _ = fields.shape
    sheet = fields.reshape(-1, columns, height, width, 3).swapaxes(1, 2)
    sheet = sheet.reshape(-1, columns * width, 3)
    return sheet[: len(sheet) // 2 * 2, : columns * width // 2 * 2]
