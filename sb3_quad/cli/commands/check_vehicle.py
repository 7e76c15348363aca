"""Check whether a vehicle can hover, how much authority it has, and how well the experts fly it.

examples:
  sb3-quad check-vehicle my.yaml            your own vehicle
  sb3-quad check-vehicle crazyflie          one that comes with the package, such as itm or x500
  sb3-quad check-vehicle my.yaml -n 0       from its parameters alone, without flying

Exit code 1: the rotors cannot produce hover thrust. The contents of a vehicle file:
docs/vehicles.md
"""

import argparse
import math
import sys
from typing import TYPE_CHECKING

from sb3_quad.base.errors import CannotHover
from sb3_quad.cli.parser import Parser, natural

if TYPE_CHECKING:
    from sb3_quad.vehicles.vehicle import Vehicle

SLIM_THRUST = 1.2  # thrust-to-weight ratio below which little is left to turn and brake with
FASTEST_HOVER = 10_000.0  # rad/s, some 95,000 rpm; above it a unit must be wrong
RPM = 60.0 / (2.0 * math.pi)  # rpm per rad/s


def add_arguments(parser: Parser) -> None:
    add = parser.add_argument
    add("vehicle", metavar="VEHICLE", help="name or YAML file")
    add(
        "-n",
        "--episodes",
        type=natural,
        default=480,
        metavar="N",
        help="episodes of each task, per expert, true state (480)",
    )
    add(
        "--seed",
        type=natural,
        default=0,
        help="seed of the episodes, which no search or training has seen (0)",
    )


def run(options: argparse.Namespace) -> int:
    """Check, fly, print. Returns the exit code: 1 if it cannot hover."""
    from sb3_quad.base.seeds import seed_for
    from sb3_quad.cli.closing import print_tables
    from sb3_quad.cli.output import console
    from sb3_quad.evaluation.tables import text_table
    from sb3_quad.experts.geometric import GeometricExpert
    from sb3_quad.experts.pid import PIDExpert
    from sb3_quad.vehicles.vehicle import load_vehicle

    try:
        vehicle = load_vehicle(options.vehicle)
        _check_rotor_speed(vehicle, options.vehicle)
    except CannotHover as error:
        print(f"cannot hover: {error}", file=sys.stderr)
        return 1
    console().print(text_table(vehicle.name, ("", ""), _parameters(vehicle), align="left"))
    for warning in warnings(vehicle):
        print(f"unusual: {warning}")
    if options.episodes:
        gains = "derived from the parameters" if vehicle.geometric_gains is None else "of its file"
        controllers = {
            "PID": PIDExpert(vehicle),
            f"geometric, gains {gains}": GeometricExpert(vehicle),
        }
        true_state = {"vehicle": vehicle, "noise": 0.0}
        print_tables(controllers, true_state, options.episodes, seed_for("expert", options.seed))
        if vehicle.geometric_gains is None:
            print(
                f"to search for gains, which are mostly better: python examples/tune_expert.py {options.vehicle}"
            )
    return 0


def _parameters(vehicle: "Vehicle") -> list[tuple[str, str]]:
    """What it weighs, lifts and how soon it answers."""
    low, high = vehicle.thrust_range
    slow, fast = vehicle.rotor_speed_range
    hover = vehicle.hover_rotor_speed
    action = f"{vehicle.hover_action:+.3f}" if abs(vehicle.hover_action) > 5e-4 else "0"
    ixx, iyy, izz = vehicle.inertia
    physical = "unphysical" if vehicle.inertia_fault else "physical"
    share = (
        f"{physical}: the largest moment is {vehicle.largest_moment:.2f} of the other two together"
    )
    ratios = ", ".join(f"{ratio:.2f}" for ratio in vehicle.gyration_ratios)
    least, most = vehicle.thrust_limits
    up, down, sideways = (
        vehicle.gravity * share for share in (most - 1.0, 1.0 - least, math.sqrt(most**2 - 1.0))
    )
    moments = vehicle.greatest_moments
    turns = ", ".join(f"{each:.1f}" for each in moments / vehicle.inertia)
    faster, slower = 1000.0 / vehicle.motor_gain_up, 1000.0 / vehicle.motor_gain_down
    times = f"{faster:.1f} ms up, {slower:.1f} ms down" if faster != slower else f"{faster:.1f} ms"
    return [
        ("can hover", f"yes: thrust-to-weight ratio {most:.2f}, least {least:.2f}"),
        ("mass, weight", f"{vehicle.mass:g} kg, {vehicle.mass * vehicle.gravity:.4g} N"),
        (
            "rotor thrust",
            f"{low:.4g} to {high:.4g} N, hover {vehicle.hover_thrust:.4g} N (action {action})",
        ),
        (
            "rotor speed",
            f"{slow:.0f} to {fast:.0f} rad/s, hover {hover:.0f} rad/s "
            f"({slow * RPM:.0f} to {fast * RPM:.0f} rpm, hover {hover * RPM:.0f} rpm)",
        ),
        (
            "acceleration",
            f"up {up:.1f}, down while level {down:.1f}, sideways at constant height {sideways:.1f} m/s²",
        ),
        (
            "greatest moments",
            f"{', '.join(f'{each:.4g}' for each in moments)} N m about roll, pitch and yaw",
        ),
        ("", f"which accelerate it by {turns} rad/s²"),
        ("inertia", f"{ixx:.4g}, {iyy:.4g}, {izz:.4g} kg m²"),
        ("", f"{share}, at most 1 (triangle inequality)"),
        ("", f"radii of gyration {ratios} of the rotors' distance from the centre"),
        (
            "motors",
            f"time constant {times}; from command to thrust {1000 * vehicle.command_lag:.1f} ms",
        ),
    ]


def _check_rotor_speed(vehicle: "Vehicle", where: str) -> None:
    """:raises CannotHover: no rotor turns as fast as hover asks for, which limits in hover thrusts
    do not show.
    """
    if (speed := vehicle.hover_rotor_speed) > FASTEST_HOVER:
        units = "is the mass in kg, and thrust_coefficient in N s²?"
        raise CannotHover(
            f"{where}: mass {vehicle.mass:g} kg: no rotor turns at the {speed * RPM:,.0f} rpm that hover takes; {units}"
        )


def warnings(vehicle: "Vehicle") -> list[str]:
    """What is possible but unlikely: mostly a wrong unit."""
    found = []
    ratio = vehicle.gyration_ratios
    if ratio.max() > 1.0 or ratio.min() < 0.05:
        found.append(
            f"inertia: radii of gyration of {ratio.min():.3g} to {ratio.max():.3g} of the rotors' distance are unusual "
            "(0.2 to 0.6 is common); is it in kg m², and are the rotor positions in m?"
        )
    if (most := vehicle.thrust_limits[1]) < SLIM_THRUST:
        found.append(
            f"thrust: a thrust-to-weight ratio of {most:.2f} leaves little to turn and to brake with"
        )
    if vehicle.collision_radius > 2.0 * vehicle.arm_length:
        found.append(
            "collision_radius: is more than twice the rotors' distance from the centre; is it in m?"
        )
    return found
