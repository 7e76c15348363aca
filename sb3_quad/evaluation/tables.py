"""One table for terminals (``rich``), Markdown and the page of a report: metrics with their
intervals, or words.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape as escape_html
from typing import Literal

import rich.table
from rich.markup import escape
from rich.text import Text


@dataclass(frozen=True)
class Cell:
    """A metric with the ends of its 95 % interval, or words in its place.

    :param ends: of the interval; an infinite upper end is an unknown one.
    :param note: small print beside it.
    :param best: better than all others of its row, and the intervals are apart.
    """

    value: float | None = None
    ends: tuple[float, float] | None = None
    decimals: int = 2
    words: str = ""
    note: str = ""
    best: bool = False

    @property
    def number(self) -> str:
        """The value, with a proper minus sign; empty if there is none."""
        return "" if self.value is None else self._rounded(self.value)

    @property
    def interval(self) -> str:
        """The interval in words; empty where it is narrower than the last digit."""
        low, high = ("", "") if self.ends is None else map(self._rounded, self.ends)
        if low == high:
            return ""
        return f"above {low}" if high == "inf" else f"{low} to {high}"

    @property
    def text(self) -> str:
        """The number or the words, the interval in brackets, the note."""
        interval, note = (
            (f" ({self.interval})" if self.interval else ""),
            (f", {self.note}" if self.note else ""),
        )
        return (self.number or self.words) + interval + note

    def _rounded(self, value: float) -> str:
        return f"{round(value, self.decimals) + 0.0:.{self.decimals}f}".replace(
            "-", "−"
        )  # + 0.0: zero without a sign


@dataclass(frozen=True)
class Column:
    """What heads a column of cells.

    :param colour: of the controller it stands for, ``#rrggbb``.
    :param source: where the metrics come from, if they were not measured here.
    """

    name: str
    colour: str = ""
    source: str = ""
    align: Literal["left", "right"] = "right"

    @property
    def heading(self) -> str:
        """The name, the source before it."""
        return f"{self.source}: {self.name}" if self.source else self.name


@dataclass(frozen=True)
class Row:
    """A metric with its unit, and a cell for each column. Without cells it heads the rows below it."""

    name: str
    unit: str = ""
    cells: Sequence[Cell] = ()

    @property
    def heading(self) -> str:
        """The name, the unit after it."""
        return f"{self.name}, {self.unit}" if self.unit else self.name


@dataclass(frozen=True)
class Table:
    """Rows of cells. ``rich`` prints it as it is; ``page.html.j2`` makes HTML of it.

    :param corner: heads the rows' names.
    :param title: above the table and ``caption`` below it, in terminals.
    """

    columns: Sequence[Column]
    rows: Sequence[Row]
    corner: str = ""
    title: str = ""
    caption: str = ""

    def markdown(self) -> str:
        """The lines of the table; the best of a row is bold. Names of any characters make no HTML."""
        lines = [
            [self.corner, *(column.heading for column in self.columns)],
            ["---"] * (1 + len(self.columns)),
        ]
        for row in self.rows:
            lines.append(
                [
                    row.heading,
                    *(f"**{cell.text}**" if cell.best else cell.text for cell in row.cells),
                ]
            )
        return "\n".join(
            f"| {' | '.join(escape_html(cell.replace('|', '/'), False) for cell in line)} |"
            for line in lines
        )

    def __rich__(self) -> rich.table.Table:
        """The table as ``rich`` prints it; the best of a row is bold."""
        table = rich.table.Table(
            title=escape(self.title) or None, caption=escape(self.caption) or None
        )
        table.title_justify = table.caption_justify = "left"
        table.show_header = any([self.corner, *(column.heading for column in self.columns)])
        table.add_column(Text(self.corner), no_wrap=True)
        for column in self.columns:
            table.add_column(Text(column.heading), justify=column.align)
        for row in self.rows:
            if not row.cells:
                table.add_section()
            texts = (Text(cell.text, "bold" if cell.best else "") for cell in row.cells)
            table.add_row(Text(row.heading, "" if row.cells else "bold"), *texts)
        return table


def text_table(
    title: str,
    heads: Sequence[str],
    rows: Iterable[Sequence[str]],
    align: Literal["left", "right"] = "right",
) -> Table:
    """A table of words.

    :param heads: of all columns, that of the rows' names first.
    :param rows: each begins with its name.
    """
    columns = [Column(head, align=align) for head in heads[1:]]
    filled = [Row(name, "", [Cell(words=text) for text in texts]) for name, *texts in rows]
    return Table(columns, filled, heads[0], title)
