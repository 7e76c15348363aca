"""Where tables are printed."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

FILE_WIDTH = 140  # columns where the output is no terminal: a table there need not wrap


def console() -> Console:
    """A console as wide as the terminal, or as wide as any table here needs in a file or pipe."""
    from rich.console import Console

    return Console(width=None if sys.stdout.isatty() else FILE_WIDTH)
