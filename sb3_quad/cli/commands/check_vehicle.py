"""Check whether a vehicle can hover, how much authority it has, and how well the experts fly it.

examples:
  sb3-quad check-vehicle my.yaml            your own vehicle
  sb3-quad check-vehicle crazyflie          one that comes with the package: crazyflie, hummingbird, itm
  sb3-quad check-vehicle my.yaml -n 0       from its parameters alone, without flying

Exit code 1: the rotors cannot produce hover thrust. The contents of a vehicle file: docs/vehicles.md
"""

import argparse
import sys

from sb3_quad.base.errors import CannotHover
from sb3_quad.cli.parser import Parser, natural


def add_arguments(parser: Parser) -> None:
    add = parser.add_argument
    add("vehicle", metavar="VEHICLE", help="name or YAML file")
    add("-n", "--episodes", type=natural, default=480, metavar="N", help="episodes of each task, per expert, true state (480)")
    add("--seed", type=natural, default=0, help="seed of the episodes, which no search or training has seen (0)")


def run(options: argparse.Namespace) -> int:
    """Check, fly, print. Returns the exit code: 1 if it cannot hover."""
    from sb3_quad.base.seeds import seed_for
    from sb3_quad.cli.closing import print_tables
    from sb3_quad.cli.output import console
    from sb3_quad.experts.geometric import GeometricExpert
    from sb3_quad.experts.pid import PIDExpert
    from sb3_quad.report.vehicle import check_rotor_speed, parameter_table, warnings
    from sb3_quad.vehicles.vehicle import load_vehicle

    try:
        vehicle = load_vehicle(options.vehicle)
        check_rotor_speed(vehicle, options.vehicle)
    except CannotHover as error:
        print(f"cannot hover: {error}", file=sys.stderr)
        return 1
    console().print(parameter_table(vehicle))
    for warning in warnings(vehicle):
        print(f"unusual: {warning}")
    if options.episodes:
        gains = "derived from the parameters" if vehicle.geometric_gains is None else "of its file"
        controllers = {"PID": PIDExpert(vehicle), f"geometric, gains {gains}": GeometricExpert(vehicle)}
        true_state = {"vehicle": vehicle, "noise": 0.0}
        print_tables(controllers, true_state, options.episodes, seed_for("expert", options.seed))
        if vehicle.geometric_gains is None:
            print(f"to search for gains, which are mostly better: python examples/tune_expert.py {options.vehicle}")
    return 0
