"""Where lines, tables and progress are shown."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskProgressColumn,
    TextColumn,
    TimeRemainingColumn,
)

FILE_WIDTH = 180  # columns where the output is no terminal: a table there need not wrap
Show = Callable[[int, "int | None", str], None]


def console() -> Console:
    """A console as wide as the terminal, or as wide as any table here needs in a file or pipe."""
    return Console(width=None if sys.stdout.isatty() else FILE_WIDTH)


def warn(line: str) -> None:
    """Print a warning on stderr, if there is one."""
    if line:
        print(f"warning: {line}", file=sys.stderr)


def shows_progress(wanted: bool | None) -> bool:
    """Whether a progress bar is shown: in a terminal, unless asked otherwise."""
    return sys.stderr.isatty() if wanted is None else wanted


def output_file(given: str | Path | None, name: str) -> Path:
    """Where a command writes its one file: where ``-o`` says, if that is a file, else as ``name``
    in that folder, or here.
    """
    path = Path(given or "")
    return path if path.suffix and not path.is_dir() else path / name


@contextmanager
def progress_bar(wanted: bool | None) -> Iterator[Show]:
    """A progress bar on stderr, moved by what it yields: how much is done, of how much (None: not
    known), what is under way.

    :param wanted: None: in a terminal; True: also where stderr is none.
    """
    columns = (
        BarColumn(),
        TaskProgressColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(elapsed_when_finished=True),
    )
    description = TextColumn("{task.description}", markup=False)
    where = Console(file=sys.stderr, force_terminal=wanted or None)
    options: dict[str, Any] = {"console": where, "disable": not shows_progress(wanted)}
    # Lines printed meanwhile appear above the bar, or go where stdout leads.
    with Progress(
        *columns, description, transient=True, redirect_stdout=sys.stdout.isatty(), **options
    ) as bar:
        task = bar.add_task("", total=None)
        yield lambda done, total, text: bar.update(
            task, completed=done, total=total, description=text
        )
