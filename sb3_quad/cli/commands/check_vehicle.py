"""``check-vehicle``: whether a vehicle's file describes something that flies, and how the experts fly it."""

import argparse
import sys

from sb3_quad.base.errors import CannotHover
from sb3_quad.base.seeds import seed_for
from sb3_quad.cli.compare import print_tables
from sb3_quad.cli.output import console
from sb3_quad.experts.geometric import GeometricExpert
from sb3_quad.experts.pid import PIDExpert
from sb3_quad.report.vehicle import authority_table, check_rotor_speed, parameter_table, warnings
from sb3_quad.vehicles.authority import Authority
from sb3_quad.vehicles.vehicle import load_vehicle


def run(options: argparse.Namespace) -> int:
    """Check, fly, print. Returns the exit code: 1 if it cannot hover."""
    try:
        vehicle = load_vehicle(options.vehicle)
        check_rotor_speed(vehicle, options.vehicle)
    except CannotHover as error:
        print(f"cannot hover: {error}", file=sys.stderr)
        return 1
    able = Authority(vehicle)
    console().print(parameter_table(vehicle, able))
    console().print(authority_table(able))
    for warning in warnings(vehicle, able):
        print(f"unusual: {warning}")
    if options.episodes:
        gains = "derived from the parameters" if vehicle.geometric_gains is None else "of its file"
        controllers = {"PID": PIDExpert(vehicle), f"geometric, gains {gains}": GeometricExpert(vehicle)}
        true_state = {"vehicle": vehicle, "noise": 0.0}
        print_tables(controllers, true_state, options.episodes, seed_for("expert", options.seed))
        if vehicle.geometric_gains is None:
            print(f"to search for gains, which are mostly better: sb3-quad tune-expert --vehicle {options.vehicle}")
    return 0
