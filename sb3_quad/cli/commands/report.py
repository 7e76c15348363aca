"""Make report.html from a results folder of evaluate, with tables and plots.

The page is one file and needs no network.

examples:
  sb3-quad report evaluations/thesis
  # replace the report
  sb3-quad report evaluations/thesis --overwrite
"""

from argparse import Namespace

from sb3_quad.base.types import StrPath
from sb3_quad.cli.parser import (
    OVERWRITE,
    Flags,
)

FLAGS: Flags = {"folder FOLDER": "results folder of evaluate", **OVERWRITE}


def run(options: Namespace) -> int:
    """Write the page. Returns the exit code."""
    report(options.folder, options.overwrite)
    return 0


def report(folder: StrPath, overwrite: bool) -> None:
    """Write the page of a results folder, with a spinner in a terminal, and print its path.

    :raises ConfigError: See :func:`sb3_quad.report.results_page.write_report`.
    """
    from sb3_quad.cli.output import console
    from sb3_quad.report.results_page import write_report

    with console().status("report"):
        page = write_report(folder, overwrite)
    print("saved", page)
