"""``report``: a folder of results as one page, and its plots as pictures."""

import argparse
from pathlib import Path

from sb3_quad.cli.output import console
from sb3_quad.report.page import PICTURES
from sb3_quad.report.results_page import write_report


def run(options: argparse.Namespace) -> int:
    """Write the page, tell where it is. Returns the exit code."""
    report(options.folder, options.overwrite, options.pictures)
    return 0


def report(folder: str | Path, overwrite: bool, pictures: bool) -> None:
    """Write the page of a folder of results, with a spinner in a terminal; tell where it is.

    :raises ConfigError: see :func:`sb3_quad.report.results_page.write_report`.
    """
    with console().status("report"):
        page = write_report(folder, overwrite, pictures)
    print(f"saved {page}" + (f", its plots as PNG and SVG in {page.parent / PICTURES}" if pictures else ""))
