"""Make report.html from a results folder of evaluate, with tables and plots.

The page is one file and needs no network.

examples:
  sb3-quad report evaluations/thesis
  # replace the report
  sb3-quad report evaluations/thesis --overwrite
"""

from argparse import Namespace

from sb3_quad.cli.parser import (
    OVERWRITE,
    Flags,
)

FLAGS: Flags = {"folder FOLDER": "results folder of evaluate", **OVERWRITE}


def run(options: Namespace) -> int:
    """Write the page. Returns the exit code."""
    from sb3_quad.report.results_page import write_report

    print("saved", write_report(options.folder, options.overwrite))
    return 0
