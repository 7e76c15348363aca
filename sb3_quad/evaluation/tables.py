"""One table for terminals (``rich``), Markdown and the page of a report: metrics with their intervals, or words."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
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
        return "" if self.value is None else self._text(self.value).replace("-", "−")

    @property
    def interval(self) -> str:
        """The interval in words; empty where it is narrower than the last digit."""
        low, high = ("", "") if self.ends is None else map(self._text, self.ends)
        if low == high:
            return ""
        return (f"above {low}" if high == "inf" else f"{low} to {high}").replace("-", "−")

    def in_markdown(self) -> str:
        """The number, the interval in brackets, the note; the number is bold if it is the best."""
        number = self.words if self.value is None else self.number
        number = f"**{number}**" if self.best and number else number
        return number + (f" ({self.interval})" if self.interval else "") + (f", {self.note}" if self.note else "")

    def in_terminal(self, unit: str) -> str:
        """The number with its unit; means with ± half of their interval, shares and factors with its ends; the note."""
        note = f" ({self.note})" if self.note else ""
        if self.value is None:
            return self.words + note
        if unit == "%":
            ends = "" if self.ends is None else f" ({self.ends[0]:.3g}-{self.ends[1]:.3g})"
            return f"{self.value:.4g} %{ends}{note}"
        if unit == "×":
            return f"{self.number} x" + (f" ({self.interval.replace(' to ', '-')})" if self.interval else "") + note
        half = self._text(0.0 if self.ends is None else 0.5 * (self.ends[1] - self.ends[0]))
        spread = f" ± {half}" if float(half) > 0.0 else ""
        return f"{self._text(self.value)}{spread} {unit}".rstrip() + note

    def _text(self, value: float) -> str:
        text = f"{value:.{self.decimals}f}"
        return text.removeprefix("-") if math.isclose(float(text), 0.0) else text


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
        """The lines of the table; the units stand with the names of the rows."""
        lines = [[self.corner, *(column.heading for column in self.columns)], ["---"] * (1 + len(self.columns))]
        for row in self.rows:
            name = f"{row.name}, {row.unit}" if row.unit else row.name
            lines.append([name, *(cell.in_markdown() for cell in row.cells)])
        return "\n".join(f"| {' | '.join(cell.replace('|', '/') for cell in line)} |" for line in lines)

    def __rich__(self) -> rich.table.Table:
        """The table as ``rich`` prints it; the units stand with the numbers."""
        table = rich.table.Table(title=escape(self.title) or None, caption=escape(self.caption) or None)
        table.title_justify = table.caption_justify = "left"
        table.show_header = any([self.corner, *(column.heading for column in self.columns)])
        table.add_column(Text(self.corner), no_wrap=True)
        for column in self.columns:
            table.add_column(Text(column.heading), justify=column.align)
        for row in self.rows:
            if not row.cells:
                table.add_section()
            texts = (Text(cell.in_terminal(row.unit), "bold" if cell.best else "") for cell in row.cells)
            table.add_row(Text(row.name, "" if row.cells else "bold"), *texts)
        return table


def text_table(
    title: str,
    heads: Sequence[str],
    rows: Iterable[Sequence[str]],
    align: Literal["left", "right"] = "right",
    caption: str = "",
) -> Table:
    """A table of words.

    :param heads: of all columns, that of the rows' names first.
    :param rows: each begins with its name.
    """
    columns = [Column(head, align=align) for head in heads[1:]]
    filled = [Row(name, "", [Cell(words=text) for text in texts]) for name, *texts in rows]
    return Table(columns, filled, heads[0], title, caption)
