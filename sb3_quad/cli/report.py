"""``report``: a folder of results as one page, and its plots as pictures."""

from __future__ import annotations

import argparse
from pathlib import Path

from sb3_quad.cli.output import console

HELP = "Make report.html from a folder that evaluate has filled: tables, plots, flights to turn; one file, needs no network."
EXAMPLES = """examples:
  sb3-quad report evaluations/thesis
  sb3-quad report evaluations/thesis --overwrite      again, after more controllers have joined
  sb3-quad report evaluations/thesis --no-pictures    the page and its tables as report.md alone

Needs pip install 'sb3_quad[report]'.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The flags of ``report``."""
    add = parser.add_argument
    add("folder", metavar="FOLDER", help="what evaluate wrote")
    add("--pictures", action=argparse.BooleanOptionalAction, default=True, help="also write each plot as PNG and SVG (yes)")
    add("--overwrite", action="store_true", help="replace the report that is there")


def run(options: argparse.Namespace) -> int:
    """Write the page, tell where it is. Returns the exit code."""
    report(options.folder, options.overwrite, options.pictures)
    return 0


def report(folder: str | Path, overwrite: bool, pictures: bool) -> None:
    """Write the page of a folder of results, with a spinner in a terminal; tell where it is.

    :raises ConfigError: see :func:`sb3_quad.report.page.write_report`.
    """
    from sb3_quad.report.page import PICTURES, write_report

    with console().status("report"):
        page = write_report(folder, overwrite, pictures)
    print(f"saved {page}" + (f", its plots as PNG and SVG in {page.parent / PICTURES}" if pictures else ""))
