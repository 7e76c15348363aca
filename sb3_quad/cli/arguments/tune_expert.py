"""Find the geometric expert's gains for a vehicle; write its YAML with them and the resulting metrics.

examples:
  sb3-quad tune-expert                                   for ITM, into itm_tuned.yaml
  sb3-quad tune-expert --vehicle my.yaml -o tuned.yaml   for your own vehicle
  sb3-quad tune-expert -n 2000                           continues the first search, up to 2000 gains in all
  sb3-quad train --algo dagger --expert geometric --env-kwargs vehicle:tuned.yaml

The first gains stay where those found are no better on fresh episodes.
Ctrl-C writes the best gains so far; the same command continues. Needs pip install '.[tune]' from a clone.
"""

import argparse

from sb3_quad.cli.parser import Parser, natural, positive


def add_arguments(parser: Parser) -> None:
    add = parser.add_argument
    add("--vehicle", default="itm", metavar="V", help="name or YAML file (itm); the search starts from its gains, if any")
    add("-o", "--output", metavar="FILE", help="YAML file to write (VEHICLE_tuned.yaml)")
    add("--overwrite", action="store_true", help="replace the output file if it exists")
    add("-n", "--trials", type=positive, default=800, metavar="N", help="gains to try, including those in the journal (800)")
    add("--journal", metavar="FILE", help="file that keeps the search (OUTPUT, ending in .journal)")
    add("--starts", type=positive, default=40_000, metavar="N", help="recoveries; the hardest sixtieth is flown (40000)")
    add("--targets", type=positive, default=300, metavar="N", help="tracking episodes (300)")
    add("--seed", type=natural, default=0, help="seed of the search and its episodes (0)")
    add("-P", "--progress", action=argparse.BooleanOptionalAction, help="progress bar (in a terminal: yes)")
