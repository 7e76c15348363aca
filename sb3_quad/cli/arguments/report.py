"""Make report.html from a results folder of evaluate: tables, plots, flights in 3-D; one file that needs no network.

examples:
  sb3-quad report evaluations/thesis
  sb3-quad report evaluations/thesis --overwrite      again, after adding controllers
  sb3-quad report evaluations/thesis --no-pictures    only the page, and its tables as report.md

Needs: pip install '.[report]' from a clone.
"""

import argparse

from sb3_quad.cli.parser import Parser


def add_arguments(parser: Parser) -> None:
    add = parser.add_argument
    add("folder", metavar="FOLDER", help="results folder of evaluate")
    add("--pictures", action=argparse.BooleanOptionalAction, default=True, help="also write each plot as PNG and SVG (yes)")
    add("--overwrite", action="store_true", help="replace an existing report")
