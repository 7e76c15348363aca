"""The flags of ``report``."""

from __future__ import annotations

import argparse

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
