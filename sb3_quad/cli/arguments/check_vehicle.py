"""The flags of ``check-vehicle``."""

from __future__ import annotations

import argparse

from sb3_quad.cli.parser import whole

HELP = "Say whether a vehicle can hover, what authority it has, and how the experts fly it."
EXAMPLES = """examples:
  sb3-quad check-vehicle my.yaml            a vehicle of your own
  sb3-quad check-vehicle crazyflie          one that comes with the package: crazyflie, hummingbird, itm
  sb3-quad check-vehicle my.yaml -n 0       by its parameters alone, nothing is flown

exit code 1: its rotors cannot give hover thrust. What a vehicle's file holds: docs/vehicles.md
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The flags of ``check-vehicle``."""
    parser.add_argument("vehicle", metavar="VEHICLE", help="name or YAML file")
    parser.add_argument(
        "-n", "--episodes", type=whole, default=480, metavar="N", help="flown of each task by each expert, true state (480)"
    )
    parser.add_argument("--seed", type=whole, default=0, help="of the episodes, which no search and no training has seen (0)")
