"""Where tables and progress are shown."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

FILE_WIDTH = 140  # columns where the output is no terminal: a table there need not wrap
Show = Callable[[int, "int | None", str], None]


def console() -> Console:
    """A console as wide as the terminal, or as wide as any table here needs in a file or pipe."""
    from rich.console import Console

    return Console(width=None if sys.stdout.isatty() else FILE_WIDTH)


def make_table(title: str, *columns: str, left: int = 1) -> Table:
    """An empty table.

    :param left: this many columns hold words, and are aligned to the left.
    """
    from rich.table import Table

    table = Table(title=title, title_justify="left")
    for number, name in enumerate(columns):
        table.add_column(name, justify="left" if number < left else "right")
    return table


@contextmanager
def progress_bar(wanted: bool | None) -> Iterator[Show]:
    """A progress bar on stderr, moved by what it yields: how much is done, of how much (None: not known), what is under way.

    :param wanted: None: in a terminal.
    """
    if not (sys.stderr.isatty() if wanted is None else wanted):
        yield lambda done, total, text: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(elapsed_when_finished=True))
    description = TextColumn("{task.description}", markup=False)
    screen = Console(file=sys.stderr)
    # Lines printed meanwhile appear above the bar, or go where stdout leads.
    with Progress(*columns, description, console=screen, transient=True, redirect_stdout=sys.stdout.isatty()) as bar:
        task = bar.add_task("", total=None)
        yield lambda done, total, text: bar.update(task, completed=done, total=total, description=text)
