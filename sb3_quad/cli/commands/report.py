"""Make report.html from a results folder of evaluate: tables and plots; one file that needs no
network.

examples:
  sb3-quad report evaluations/thesis
  sb3-quad report evaluations/thesis --overwrite      again
"""

import argparse
from pathlib import Path

from sb3_quad.cli.parser import Parser, add_common


def add_arguments(parser: Parser) -> None:
    parser.add_argument("folder", metavar="FOLDER", help="results folder of evaluate")
    add_common(parser, "overwrite")


def run(options: argparse.Namespace) -> int:
    """Write the page, print where it is. Returns the exit code."""
    report(options.folder, options.overwrite)
    return 0


def report(folder: str | Path, overwrite: bool) -> None:
    """Write the page of a folder of results, with a spinner in a terminal; print where it is.

    :raises ConfigError: see :func:`sb3_quad.report.results_page.write_report`.
    """
    from sb3_quad.cli.output import console
    from sb3_quad.report.page import PICTURES
    from sb3_quad.report.results_page import write_report

    with console().status("report"):
        page = write_report(folder, overwrite)
    print(f"saved {page}, its plots in {page.parent / PICTURES}")
