"""Words in pictures, in the font that comes with matplotlib."""

from collections.abc import Sequence
from functools import cache

import matplotlib
import numpy as np
from PIL import Image as Pillow
from PIL import ImageDraw, ImageFont, ImageOps

from sb3_quad.base.types import Image
from sb3_quad.show.episodes import Recording

INK = (24, 32, 44)
PLATE = (255, 255, 255, 205)
LOST = (190, 20, 20)
STEP = 1.3  # between lines of text, in font sizes
SMALLER = 0.88  # font size of the lines below a heading
GAP = 4  # between pictures side by side, pixels


@cache
def font(size: int, name: str = "DejaVuSans") -> ImageFont.FreeTypeFont:
    """DejaVu Sans, ``size`` in pixels."""
    return ImageFont.truetype(f"{matplotlib.get_data_path()}/fonts/ttf/{name}.ttf", size)


def with_header(
    picture: Pillow.Image, recording: Recording, lines: Sequence[str], size: int
) -> Pillow.Image:
    """Put a white band above a picture of a flight: a bar in its colour, its name, and lines below.

    :param size: font size, pixels.
    """
    # The band is as high as its lines, with a margin above and below them.
    band = round((0.7 + STEP * (1 + len(lines))) * size)
    image = ImageOps.expand(picture, (0, band, 0, 0), "white")
    draw = ImageDraw.Draw(image)
    bar = 0.45 * size
    draw.rectangle((0, 0, bar, band - 1), recording.colour)
    column = bar + 0.7 * size
    draw.text((column, 0.35 * size), recording.name, INK, font(size, "DejaVuSans-Bold"))
    small = font(round(SMALLER * size))
    for number, line in enumerate(lines, 1):
        draw.text((column, (0.35 + number * STEP) * size), line, INK, small)
    return image


def mark_lost(picture: Pillow.Image, text: str, size: int) -> Pillow.Image:
    """Return a picture in grey, with a red text of ``size`` pixels in its upper left corner."""
    grey = picture.convert("L").convert("RGB")
    ImageDraw.Draw(grey).text((size, size), text, LOST, font(size, "DejaVuSans-Bold"))
    return grey


def side_by_side(pictures: Sequence[Pillow.Image], columns: int) -> Image:
    """Pictures of one size in rows of ``columns``, on white; even in width and height, as video
    codecs require.
    """
    columns = min(columns, len(pictures))
    rows = -(-len(pictures) // columns)
    # Each picture is in the top left corner of its field; the gap is on its other sides.
    width = pictures[0].width + GAP
    height = pictures[0].height + GAP
    sheet = Pillow.new("RGB", (columns * width // 2 * 2, rows * height // 2 * 2), "white")
    for number, picture in enumerate(pictures):
        row, column = divmod(number, columns)
        sheet.paste(picture, (column * width, row * height))
    return np.asarray(sheet)
