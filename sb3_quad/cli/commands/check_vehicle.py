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
# rpm per rad/s.
RPM = 60.0 / (2.0 * math.pi)
PARAMETERS = """\
can hover | yes: thrust-to-weight ratio {v.thrust_limits[1]:.2f}, least {v.thrust_limits[0]:.2f}
mass, weight | {v.mass:g} kg, {weight:.4g} N
rotor thrust | {v.thrust_range[0]:.4g} to {v.thrust_range[1]:.4g} N, \
hover {v.hover_thrust:.4g} N (action {action:+g})
in hover | {shares} of that by the rotors
rotor speed | {speeds[0]:.0f} to {speeds[1]:.0f} rad/s, hover {speeds[2]:.0f} rad/s \
({rpm[0]:.0f} to {rpm[1]:.0f} rpm, hover {rpm[2]:.0f} rpm){unknown}
acceleration | up {up:.1f}, down while level {down:.1f}, \
horizontal at constant height {horizontal:.1f} m/s²
greatest moments | {v.greatest_moments[0]:.4g}, {v.greatest_moments[1]:.4g}, \
{v.greatest_moments[2]:.4g} N m about roll, pitch and yaw
 | which accelerate it by {turning[0]:.1f}, {turning[1]:.1f}, {turning[2]:.1f} rad/s²
inertia | {v.inertia[0]:.4g}, {v.inertia[1]:.4g}, {v.inertia[2]:.4g} kg m²
 | {physical}: the largest moment is {v.largest_moment:.2f} of the other two together, \
at most 1 (triangle inequality)
 | radii of gyration {v.gyration_ratios[0]:.2f}, {v.gyration_ratios[1]:.2f}, \
{v.gyration_ratios[2]:.2f} of the rotors' distance from the centre
motors | time constant {motor_up:.1f} ms up, {motor_down:.1f} ms down; \
from command to thrust {lag:.1f} ms
"""
"""The lines of the table, of a vehicle ``v``."""


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
    import numpy as np

    from sb3_quad.experts.geometric_gains import command_lag

    least, most = vehicle.thrust_limits
    shares = vehicle.hover_shares
    # Without a moment, the rotor that gives most or least in hover is the first at its limit.
    most /= shares.max()
    least /= shares.min()
    speeds = np.array([*vehicle.rotor_speed_range, vehicle.hover_rotor_speed])
    text = PARAMETERS.format(
        v=vehicle,
        weight=vehicle.mass * vehicle.gravity,
        # Adding 0.0 turns a negative zero into one without a sign.
        action=round(vehicle.hover_action.mean(), 3) + 0.0,
        shares=shares.round(3).tolist(),
        unknown="" if vehicle.thrust_coefficient else "; kF unknown: 1,000 rad/s stands for hover",
        speeds=speeds,
        rpm=speeds * RPM,
        up=vehicle.gravity * (most - 1.0),
        down=vehicle.gravity * (1.0 - least),
        # The vertical part of full thrust holds the weight.
        horizontal=vehicle.gravity * math.sqrt(most**2 - 1.0),
        turning=vehicle.greatest_moments / vehicle.inertia,
        physical="unphysical" if vehicle.inertia_fault else "physical",
        motor_up=1000.0 / vehicle.motor_gain_up,
        motor_down=1000.0 / vehicle.motor_gain_down,
        lag=1000.0 * command_lag(vehicle.parameters(), vehicle.control_step),
    )
    return [line.split(" | ") for line in text.splitlines()]


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
