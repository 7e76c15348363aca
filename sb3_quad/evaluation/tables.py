"""A table of words for terminals (``rich``) and Markdown, and the colours of controllers."""

from collections.abc import Iterable, Sequence
from html import escape as escape_html
from itertools import cycle
from typing import Literal, NamedTuple

import rich.console
import rich.table
from rich.markup import escape
from rich.text import Text

WIDTH = 200  # maximum characters in a line of a table as plain text
# The colours that tell controllers apart, the same in every plot and picture. It is Okabe and Ito's
# palette for the colour-blind, without black and yellow, which are hard to see on dark or light
# paper, and without green, which marks targets. A few are shifted.
COLOURS = ("#1B7EC2", "#D55E00", "#B8548A", "#C49A00", "#56B4E9", "#7A5BC0", "#8A5A3B", "#7F7F7F")


class Table(NamedTuple):
    """Rows of words, which ``rich`` prints as they are.

    :param heads: headings of all columns, that of the row names first.
    :param rows: each begins with its name.
    :param title: above the table and ``caption`` below it, in terminals.
    :param align: of all columns but the first.
    """

    heads: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str = ""
    caption: str = ""
    align: Literal["left", "right"] = "right"

    def markdown(self) -> str:
        """Return the lines of the table in Markdown.

        Names are escaped, so that none of them becomes HTML.
        """
        lines = []
        for texts in (self.heads, ["---"] * len(self.heads), *self.rows):
            # Cells must not contain the bar that divides them.
            cells = [text.replace("|", "/") for text in texts]
            lines.append(f"| {' | '.join(cells)} |")
        return escape_html("\n".join(lines), quote=False)

    def __str__(self) -> str:
        """The table as plain text."""
        console = rich.console.Console(width=WIDTH, color_system=None)
        with console.capture() as capture:
            console.print(self)
        return capture.get()

    def __rich__(self) -> rich.table.Table:
        """The table as ``rich`` prints it."""
        table = rich.table.Table(
            title=escape(self.title) or None,
            caption=escape(self.caption) or None,
            title_justify="left",
            caption_justify="left",
            show_header=any(self.heads),
        )
        corner, *names = self.heads
        table.add_column(Text(corner), no_wrap=True)
        for name in names:
            table.add_column(Text(name), justify=self.align)
        for texts in self.rows:
            table.add_row(*map(Text, texts))
        return table


def colours_of(names: Iterable[str]) -> dict[str, str]:
    """Return a colour, ``#rrggbb``, for each label of a controller, in their order; more than eight
    share colours.
    """
    return dict(zip(names, cycle(COLOURS), strict=False))
