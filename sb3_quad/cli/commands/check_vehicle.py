"""Check whether a vehicle can hover, and how well the experts fly it.

It also prints the vehicle's thrusts, accelerations and time constants.

examples:
  # your own vehicle
  sb3-quad check-vehicle my.yaml
  # one that comes with the package, such as itm or x500
  sb3-quad check-vehicle crazyflie
  # from the parameters alone, without flying
  sb3-quad check-vehicle my.yaml -n 0
  # how far it departs from logs of real flights
  sb3-quad check-vehicle my.yaml --flights logs

Exit code 1: the rotors cannot produce hover thrust. For the contents of a
vehicle file, see docs/vehicles.md.
"""

import math
import sys
from argparse import Namespace
from typing import TYPE_CHECKING

from sb3_quad.base.errors import CannotHover
from sb3_quad.cli.parser import (
    Flags,
    natural,
)

if TYPE_CHECKING:
    from sb3_quad.vehicles.vehicle import Vehicle

# Below this thrust-to-weight ratio, little is left to turn and brake with.
SLIM_THRUST = 1.2
# Rotor speed, rpm. Above it a unit must be wrong.
FASTEST_HOVER = 95_000.0
# Time constants of motors, s. Beyond these a unit must be wrong, or the gain is the time itself.
QUICKEST_MOTOR = 0.004
SLOWEST_MOTOR = 0.3
# kM / kF by the rotors' distance from the centre. It is about a tenth of a propeller's diameter.
LEAST_RATIO = 0.02
GREATEST_RATIO = 2.0
# rpm per rad/s.
RPM = 60.0 / (2.0 * math.pi)

FLAGS: Flags = {
    "vehicle VEHICLE": "name or YAML file",
    "-n --episodes N": (
        natural,
        480,
        "episodes of each task and expert, with the true state (480)",
    ),
    "--flights FOLDER": (
        str,
        None,
        "fly the motor commands of these logs instead (CSV; columns: docs/vehicles.md)",
    ),
    "--seed N": (natural, 0, "seed of the episodes, which no search or training uses (0)"),
}


def run(options: Namespace) -> int:
    """Check, fly, print. Returns the exit code: 1 if the vehicle cannot hover."""
    from sb3_quad.base.seeds import seed_for
    from sb3_quad.cli.output import console
    from sb3_quad.evaluation.compare import compare
    from sb3_quad.evaluation.tables import text_table
    from sb3_quad.experts.geometric import GeometricExpert
    from sb3_quad.experts.pid import PIDExpert
    from sb3_quad.vehicles.vehicle import load_vehicle

    try:
        vehicle = load_vehicle(options.vehicle)
        # Limits in multiples of the hover thrust do not show that it hovers at all.
        rpm = vehicle.hover_rotor_speed * RPM
        if rpm > FASTEST_HOVER:
            raise CannotHover(
                f"{options.vehicle}: mass {vehicle.mass:g} kg: no rotor reaches the {rpm:,.0f} rpm "
                "that hover needs; is the mass in kg, and thrust_coefficient in N s²?"
            )
    except CannotHover as error:
        print(f"cannot hover: {error}", file=sys.stderr)
        return 1
    console().print(text_table(vehicle.name, ("", ""), _parameters(vehicle), align="left"))
    for warning in warnings(vehicle):
        print(f"unusual: {warning}")
    if options.flights is not None:
        from sb3_quad.evaluation.real_flights import error_table, read_logs

        logs = read_logs(options.flights, vehicle.control_step)
        console().print(error_table(logs, vehicle))
    elif options.episodes:
        derived = vehicle.geometric_gains is None
        gains = "derived from the parameters" if derived else "of its file"
        controllers = {
            "PID": PIDExpert(vehicle),
            f"geometric, gains {gains}": GeometricExpert(vehicle),
        }
        seed = seed_for("expert", options.seed)
        console().print(
            compare(controllers, n_flights=options.episodes, seed=seed, vehicle=vehicle, noise=0.0)
        )
        if derived:
            print(
                "to search for gains, which are mostly better: "
                f"python examples/tune_expert.py {options.vehicle}"
            )
    return 0


def _parameters(vehicle: "Vehicle") -> list[list[str]]:
    """Return the lines of the table: names and values."""
    from sb3_quad.base.templates import render
    from sb3_quad.experts.geometric_gains import command_lag

    lag = 1000.0 * command_lag(vehicle.parameters(), vehicle.control_step)
    text = render("sb3_quad.cli.commands", "check_vehicle.j2", v=vehicle, rpm=RPM, lag=lag)
    return [line.split(" | ") for line in text.splitlines()]


def warnings(vehicle: "Vehicle") -> list[str]:
    """Return a line for each value that is possible but unlikely, mostly due to a wrong unit."""
    lines = []
    ratios = vehicle.gyration_ratios
    if ratios.max() > 1.0 or ratios.min() < 0.05:
        lines.append(
            f"inertia: radii of gyration of {ratios.min():.3g} to {ratios.max():.3g} "
            "of the rotors' distance are unusual (0.2 to 0.6 is common); "
            "is it in kg m², the mass in kg, and are the rotor positions in m?"
        )
    quickest = 1.0 / max(vehicle.motor_gain_up, vehicle.motor_gain_down)
    slowest = 1.0 / min(vehicle.motor_gain_up, vehicle.motor_gain_down)
    if quickest < QUICKEST_MOTOR or slowest > SLOWEST_MOTOR:
        lines.append(
            f"motor_gain: time constants of {1000 * quickest:.3g} to {1000 * slowest:.3g} ms "
            "are unusual (20 to 150 ms is common); is it in 1/s, one by the time constant?"
        )
    by_arm = vehicle.moment_thrust_ratio / vehicle.arm_length
    if not LEAST_RATIO < by_arm < GREATEST_RATIO:
        lines.append(
            f"moment_thrust_ratio: {by_arm:.3g} times the rotors' distance from the centre is "
            "unusual (0.05 to 0.5 is common); is it in m?"
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
