"""Check whether a vehicle can hover, and how well the experts fly it.

It also prints the vehicle's thrusts, accelerations and time constants.

examples:
  # your own vehicle
  sb3-quad check-vehicle my.yaml
  # one that comes with the package, such as itm or x500
  sb3-quad check-vehicle crazyflie
  # from the parameters alone, without flying
  sb3-quad check-vehicle my.yaml -n 0

Exit code 1: the rotors cannot produce hover thrust. For the contents of a
vehicle file, see docs/vehicles.md.
"""

import math
import sys
from argparse import Namespace
from typing import TYPE_CHECKING, Any

from sb3_quad.base.errors import CannotHover
from sb3_quad.cli.parser import Flags, Parser, add_flags, natural

if TYPE_CHECKING:
    from sb3_quad.vehicles.vehicle import Vehicle

# Below this thrust-to-weight ratio, little is left to turn and brake with.
SLIM_THRUST = 1.2
# Rotor speed, rad/s, some 95,000 rpm. Above it a unit must be wrong.
FASTEST_HOVER = 10_000.0
# rpm per rad/s.
RPM = 60.0 / (2.0 * math.pi)


FLAGS: Flags = {
    "-n --episodes N": (
        natural,
        480,
        "episodes of each task and expert, with the true state (480)",
    ),
    "--seed N": (natural, 0, "seed of the episodes, which no search or training uses (0)"),
}


def add_arguments(parser: Parser) -> None:
    parser.add_argument("vehicle", metavar="VEHICLE", help="name or YAML file")
    add_flags(parser, FLAGS)


def run(options: Namespace) -> int:
    """Check, fly, print. Returns the exit code: 1 if the vehicle cannot hover."""
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
        derived = vehicle.geometric_gains is None
        gains = "derived from the parameters" if derived else "of its file"
        controllers = {
            "PID": PIDExpert(vehicle),
            f"geometric, gains {gains}": GeometricExpert(vehicle),
        }
        true_state = {"vehicle": vehicle, "noise": 0.0}
        print_tables(controllers, true_state, options.episodes, seed_for("expert", options.seed))
        if derived:
            print(
                "to search for gains, which are mostly better: "
                f"python examples/tune_expert.py {options.vehicle}"
            )
    return 0


def _parameters(vehicle: "Vehicle") -> list[tuple[str, str]]:
    """Return the lines of the table: names and values."""
    return [
        *_thrust(vehicle),
        *_acceleration(vehicle),
        *_inertia(vehicle),
        ("motors", _motors(vehicle)),
    ]


def _thrust(vehicle: "Vehicle") -> list[tuple[str, str]]:
    low, high = vehicle.thrust_range
    slow, fast = vehicle.rotor_speed_range
    hover = vehicle.hover_rotor_speed
    least, most = vehicle.thrust_limits
    # Rounding would print -0.000.
    action = f"{vehicle.hover_action:+.3f}" if abs(vehicle.hover_action) > 5e-4 else "0"
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
    ]


def _acceleration(vehicle: "Vehicle") -> list[tuple[str, str]]:
    least, most = vehicle.thrust_limits
    up = vehicle.gravity * (most - 1.0)
    down = vehicle.gravity * (1.0 - least)
    # The vertical part of full thrust holds the weight.
    horizontal = vehicle.gravity * math.sqrt(most**2 - 1.0)
    moments = vehicle.greatest_moments
    return [
        (
            "acceleration",
            f"up {up:.1f}, down while level {down:.1f}, "
            f"horizontal at constant height {horizontal:.1f} m/s²",
        ),
        ("greatest moments", f"{_list(moments, '.4g')} N m about roll, pitch and yaw"),
        ("", f"which accelerate it by {_list(moments / vehicle.inertia, '.1f')} rad/s²"),
    ]


def _inertia(vehicle: "Vehicle") -> list[tuple[str, str]]:
    physical = "unphysical" if vehicle.inertia_fault else "physical"
    ratios = _list(vehicle.gyration_ratios, ".2f")
    return [
        ("inertia", f"{_list(vehicle.inertia, '.4g')} kg m²"),
        (
            "",
            f"{physical}: the largest moment is {vehicle.largest_moment:.2f} of the other two "
            "together, at most 1 (triangle inequality)",
        ),
        ("", f"radii of gyration {ratios} of the rotors' distance from the centre"),
    ]


def _motors(vehicle: "Vehicle") -> str:
    up = 1000.0 / vehicle.motor_gain_up
    down = 1000.0 / vehicle.motor_gain_down
    times = f"{up:.1f} ms"
    if up != down:
        times = f"{up:.1f} ms up, {down:.1f} ms down"
    lag = 1000 * vehicle.command_lag
    return f"time constant {times}; from command to thrust {lag:.1f} ms"


def _list(values: Any, form: str) -> str:
    return ", ".join(format(value, form) for value in values)


def _check_rotor_speed(vehicle: "Vehicle", where: str) -> None:
    """Check the rotor speed in hover, which limits in multiples of the hover thrust do not show.

    :raises CannotHover: No rotor is that fast.
    """
    speed = vehicle.hover_rotor_speed
    if speed > FASTEST_HOVER:
        raise CannotHover(
            f"{where}: mass {vehicle.mass:g} kg: no rotor reaches the {speed * RPM:,.0f} rpm that "
            "hover needs; is the mass in kg, and thrust_coefficient in N s²?"
        )


def warnings(vehicle: "Vehicle") -> list[str]:
    """Return a line for each value that is possible but unlikely, mostly due to a wrong unit."""
    lines = []
    ratios = vehicle.gyration_ratios
    if ratios.max() > 1.0 or ratios.min() < 0.05:
        lines.append(
            f"inertia: radii of gyration of {ratios.min():.3g} to {ratios.max():.3g} "
            "of the rotors' distance are unusual (0.2 to 0.6 is common); "
            "is it in kg m², and are the rotor positions in m?"
        )
    most = vehicle.thrust_limits[1]
    if most < SLIM_THRUST:
        lines.append(
            f"thrust: a thrust-to-weight ratio of {most:.2f} leaves little to turn and brake with"
        )
    if vehicle.collision_radius > 2.0 * vehicle.arm_length:
        lines.append(
            "collision_radius: is more than twice the rotors' distance from the centre; is it in m?"
        )
    return lines
