"""Output of commands: tables, warnings and progress."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskProgressColumn,
    TextColumn,
    TimeRemainingColumn,
)

# Columns of a table in a file or a pipe, where lines need not wrap.
FILE_WIDTH = 180
Show = Callable[[int, "int | None", str], None]


def console() -> Console:
    """Return a console as wide as the terminal, or as wide as any table needs in a file."""
    return Console(width=None if sys.stdout.isatty() else FILE_WIDTH)


def warn(line: str) -> None:
    """Print a warning on stderr, unless it is empty."""
    if line:
        print("warning:", line, file=sys.stderr)


def shows_progress(wanted: bool | None) -> bool:
    """Whether to show a progress bar: as ``wanted``, or with None, in a terminal."""
    return sys.stderr.isatty() if wanted is None else wanted


@contextmanager
def progress_bar(wanted: bool | None) -> Iterator[Show]:
    """Show a progress bar on stderr within the block.

    It yields a function that moves the bar: what is done, the total (None if unknown), and a text.

    :param wanted: Whether to show it. None: only in a terminal.
    """
    bar = Progress(
        BarColumn(),
        TaskProgressColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(elapsed_when_finished=True),
        TextColumn("{task.description}", markup=False),
        console=Console(file=sys.stderr, force_terminal=wanted or None),
        disable=not shows_progress(wanted),
        transient=True,
        # Lines that are printed meanwhile appear above the bar.
        redirect_stdout=sys.stdout.isatty(),
    )
    with bar:
        task = bar.add_task("", total=None)

        def show(done: int, total: int | None, text: str) -> None:
            bar.update(task, completed=done, total=total, description=text)

        yield show
