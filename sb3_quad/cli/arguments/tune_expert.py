"""The flags of ``tune-expert``."""

from __future__ import annotations

import argparse

from sb3_quad.cli.parser import whole

HELP = "Find the geometric expert's gains for a vehicle; write its YAML with them and the metrics they reach."
EXAMPLES = """examples:
  sb3-quad tune-expert                                   for ITM, into itm_tuned.yaml
  sb3-quad tune-expert --vehicle my.yaml -o tuned.yaml   for a vehicle of your own
  sb3-quad tune-expert -n 2000                           goes on with the first search, up to 2000 gains in all
  sb3-quad train --algo dagger --expert geometric --env-kwargs vehicle:tuned.yaml

Ctrl-C writes the best gains so far; the same command goes on. Needs pip install 'sb3_quad[tune]'.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The flags of ``tune-expert``."""
    add = parser.add_argument
    add(
        "--vehicle", default="itm", metavar="V", help="name or YAML file (itm); its gains, if any, are where the search starts"
    )
    add("-o", "--output", metavar="FILE", help="YAML file to write (VEHICLE_tuned.yaml)")
    add("--overwrite", action="store_true", help="write the output even where another file lies")
    add("-n", "--trials", type=whole, default=800, metavar="N", help="gains to try, those of the journal included (800)")
    add("--journal", metavar="FILE", help="file that remembers the search (OUTPUT with the ending .journal)")
    add("--starts", type=whole, default=40_000, metavar="N", help="recoveries, of which the hardest sixtieth is flown (40000)")
    add("--targets", type=whole, default=300, metavar="N", help="tracking episodes (300)")
    add("--seed", type=int, default=0, help="of the search and its episodes (0)")
    add("-P", "--progress", action=argparse.BooleanOptionalAction, help="progress bar (in a terminal: yes)")
