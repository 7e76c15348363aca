"""One table for terminals (``rich``) and Markdown: metrics with their intervals, or words."""

from collections.abc import Iterable, Sequence
from html import escape as escape_html
from itertools import cycle
from typing import Literal, NamedTuple

import rich.console
import rich.table
from rich.markup import escape
from rich.text import Text

Align = Literal["left", "right"]
WIDTH = 200  # maximum characters in a line of a table as plain text
# The colours that tell controllers apart, the same in every table, plot and picture. It is Okabe
# and Ito's palette for the colour-blind, without black and yellow, which are hard to see on dark or
# light paper, and without green, which marks targets. A few are shifted.
COLOURS = ("#1B7EC2", "#D55E00", "#B8548A", "#C49A00", "#56B4E9", "#7A5BC0", "#8A5A3B", "#7F7F7F")


class Cell(NamedTuple):
    """A metric with its 95 % interval, or words instead.

    :param ends: ends of the interval.
    :param note: small print after the value.
    :param best: whether it is better than all others in its row, with intervals that do not
        overlap.
    """

    value: float | None = None
    ends: tuple[float, float] | None = None
    decimals: int = 2
    words: str = ""
    note: str = ""
    best: bool = False

    @property
    def number(self) -> str:
        """The value, with a proper minus sign; empty without a value."""
        if self.value is None:
            return ""
        return self._rounded(self.value)

    @property
    def interval(self) -> str:
        """The interval in words; empty if it is narrower than the last digit."""
        if self.ends is None:
            return ""
        low, high = map(self._rounded, self.ends)
        if low == high:
            return ""
        return f"{low} to {high}"

    @property
    def text(self) -> str:
        """The number or the words, the interval in brackets, the note."""
        text = self.number or self.words
        if self.interval:
            text += f" ({self.interval})"
        if self.note:
            text += f", {self.note}"
        return text

    def _rounded(self, value: float) -> str:
        # Adding 0.0 turns a negative zero into one without a sign.
        rounded = round(value, self.decimals) + 0.0
        return f"{rounded:.{self.decimals}f}".replace("-", "−")


class Column(NamedTuple):
    """The head of a column of cells.

    :param colour: colour of its controller, ``#rrggbb``.
    :param source: where the metrics come from, if they were not measured here.
    """

    name: str
    colour: str = ""
    source: str = ""
    align: Align = "right"

    @property
    def heading(self) -> str:
        """The source and the name."""
        return f"{self.source}: {self.name}" if self.source else self.name


class Row(NamedTuple):
    """A metric with its unit, and a cell for each column.

    :param decimals: number of decimals in its cells.
    :param verb: for a mean time, of which less is better: what the flights do at that time.
    """

    name: str
    unit: str = ""
    cells: Sequence[Cell] = ()
    decimals: int = 2
    verb: str = ""

    @property
    def heading(self) -> str:
        """The name and the unit."""
        return f"{self.name}, {self.unit}" if self.unit else self.name

    @property
    def factor(self) -> float:
        """The factor from values to cells, which show shares in %."""
        return 100.0 if self.unit == "%" else 1.0


class Table(NamedTuple):
    """Rows of cells, which ``rich`` prints as they are.

    :param corner: heading of the row names.
    :param title: above the table and ``caption`` below it, in terminals.
    """

    columns: Sequence[Column]
    rows: Sequence[Row]
    corner: str = ""
    title: str = ""
    caption: str = ""

    def markdown(self) -> str:
        """Return the lines of the table in Markdown; the best of a row is bold.

        Names are escaped, so that none of them becomes HTML.
        """
        rows = [[self.corner, *self._headings], ["---"] * (1 + len(self.columns))]
        for row in self.rows:
            texts = [f"**{cell.text}**" if cell.best else cell.text for cell in row.cells]
            rows.append([row.heading, *texts])
        lines = []
        for texts in rows:
            # Cells must not contain the bar that divides them.
            line = "\t".join(texts).replace("|", "/").replace("\t", " | ")
            lines.append(f"| {line} |")
        return escape_html("\n".join(lines), quote=False)

    @property
    def _headings(self) -> list[str]:
        return [column.heading for column in self.columns]

    def __str__(self) -> str:
        """The table as plain text."""
        console = rich.console.Console(width=WIDTH, color_system=None)
        with console.capture() as capture:
            console.print(self)
        return capture.get()

    def __rich__(self) -> rich.table.Table:
        """The table as ``rich`` prints it; the best of a row is bold."""
        table = rich.table.Table(
            title=escape(self.title) or None,
            caption=escape(self.caption) or None,
            title_justify="left",
            caption_justify="left",
            show_header=any([self.corner, *self._headings]),
        )
        table.add_column(Text(self.corner), no_wrap=True)
        for column in self.columns:
            table.add_column(Text(column.heading), justify=column.align)
        for row in self.rows:
            texts = [Text(cell.text, "bold" if cell.best else "") for cell in row.cells]
            table.add_row(Text(row.heading), *texts)
        return table


def text_table(
    title: str, heads: Sequence[str], rows: Iterable[Sequence[str]], align: Align = "right"
) -> Table:
    """Return a table of words.

    :param heads: headings of all columns, that of the row names first.
    :param rows: each begins with its name.
    """
    corner, *names = heads
    filled = []
    for name, *texts in rows:
        filled.append(Row(name, "", [Cell(words=text) for text in texts]))
    return Table([Column(name, align=align) for name in names], filled, corner, title)


def colours_of(names: Iterable[str]) -> dict[str, str]:
    """Return a colour, ``#rrggbb``, for each label of a controller, in their order; more than eight
    share colours.
    """
    return dict(zip(names, cycle(COLOURS), strict=False))
