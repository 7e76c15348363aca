"""``report.md``: the tables of a report for a repository's pages, without its figures."""

from __future__ import annotations

from collections.abc import Sequence

from sb3_quad.evaluation.records import Results
from sb3_quad.report.sections import Section
from sb3_quad.report.tables import Cell, Row, Table


def render_markdown(results: Results, parts: Sequence[Section]) -> str:
    """The page as text: a heading, what it is about, and a table or more for each section.

    An interval (95 %) stands in brackets; the best of a row is bold where its interval is apart from all others.
    """
    lines = [f"# Suite {results.suite}", ""]
    for part in parts:
        lines += [f"## {part.heading}", ""]
        for text in (part.description, part.facts):
            lines += [" ".join(text.split()), ""] if text else []
        for table in part.tables:
            lines += [*_table(table), ""]
    return "\n".join(lines).rstrip() + "\n"


def _table(table: Table) -> list[str]:
    prefix = f"{table.source}: " if table.source else ""
    heads = [table.corner, *(label for label, _ in table.columns), *(prefix + name for name in table.others)]
    return [_line(heads), _line(["---"] * len(heads)), *(_line([_name(row), *map(_cell, row.cells)]) for row in table.rows)]


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |"


def _name(row: Row) -> str:
    return f"{row.name}, {row.unit}" if row.unit else row.name


def _cell(cell: Cell) -> str:
    number = cell.words if cell.value is None else f"{cell.whole}{cell.fraction}"
    number = f"**{number}**" if cell.best and number else number
    interval = f" ({cell.interval})" if cell.interval else ""
    note = f", {cell.note}" if cell.note else ""
    return f"{number}{interval}{note}"
