"""Check whether a vehicle can hover, how much authority it has, and how well the experts fly it.

examples:
  sb3-quad check-vehicle my.yaml            your own vehicle
  sb3-quad check-vehicle crazyflie          one that comes with the package: crazyflie, hummingbird, itm
  sb3-quad check-vehicle my.yaml -n 0       from its parameters alone, without flying

Exit code 1: the rotors cannot produce hover thrust. The contents of a vehicle file: docs/vehicles.md
"""

from sb3_quad.cli.parser import Parser, natural


def add_arguments(parser: Parser) -> None:
    add = parser.add_argument
    add("vehicle", metavar="VEHICLE", help="name or YAML file")
    add("-n", "--episodes", type=natural, default=480, metavar="N", help="episodes of each task, per expert, true state (480)")
    add("--seed", type=natural, default=0, help="seed of the episodes, which no search or training has seen (0)")
