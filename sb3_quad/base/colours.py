"""The colours that tell controllers apart, the same in every plot and picture."""

from collections.abc import Sequence

# Okabe and Ito's palette for the colour-blind, without its black and yellow, which are hard to see
# on dark or light paper, and without its green, which marks targets. A few are shifted.
COLOURS = ("#1B7EC2", "#D55E00", "#B8548A", "#C49A00", "#56B4E9", "#7A5BC0", "#8A5A3B", "#7F7F7F")


def colours_of(names: Sequence[str]) -> dict[str, str]:
    """Return a colour, ``#rrggbb``, for each name, by its position. They repeat after eight."""
    return {name: COLOURS[number % len(COLOURS)] for number, name in enumerate(names)}
