"""One colour for each controller, the same in every picture of a command; told apart also by the colour-blind."""

from __future__ import annotations

from collections.abc import Sequence

# Okabe and Ito's palette, less its black and its yellow, which drown on dark and on light paper; a few moved.
COLOURS = ("#1B7EC2", "#D55E00", "#009E73", "#B8548A", "#C88A00", "#3E9BD6", "#7A5BC0", "#7F7F7F")


def colours_of(names: Sequence[str]) -> dict[str, str]:
    """A colour, as ``#rrggbb``, for each name, by its place; after eight they repeat."""
    return {name: COLOURS[number % len(COLOURS)] for number, name in enumerate(names)}


def rgb(colour: str) -> tuple[float, float, float]:
    """``#rrggbb`` as red, green and blue in [0, 1]."""
    red, green, blue = (int(colour[place : place + 2], 16) / 255 for place in (1, 3, 5))
    return red, green, blue
