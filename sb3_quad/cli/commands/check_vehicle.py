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

from pydantic import NonNegativeInt

from sb3_quad.base.errors import CannotHover
from sb3_quad.cli.parser import (
    Flags,
)

if TYPE_CHECKING:
    from sb3_quad.envs.vehicles.vehicle import Vehicle

# Rotor speed, rpm. Above it a unit must be wrong.
FASTEST_HOVER = 95_000.0
# Divergence of the hover, times the time from a command to its thrust. Here the geometric expert
# begins to lose its targets.
MOST_DIVERGENCE = 0.2
# rpm per rad/s.
RPM = 60.0 / (2.0 * math.pi)

FLAGS: Flags = {
    "vehicle VEHICLE": "name or YAML file",
    "-n --n-episodes N": (
        NonNegativeInt,
        480,
        "episodes of each task and expert, with the true state (480)",
    ),
    "--flights LOGS": (
        "fly the motor commands of this log or folder instead (formats: docs/your_vehicle.md)"
    ),
    "--seed N": (NonNegativeInt, 0, "seed of the episodes, which no search or training uses (0)"),
}


def run(options: Namespace) -> int:
    """Check, fly, print. Returns the exit code: 1 if the vehicle cannot hover."""
    from sb3_quad.agents.agent_settings import agent_settings, unlike_trained
    from sb3_quad.agents.pretrained import pretrained_names, pretrained_path
    from sb3_quad.base.seeds import seed_for
    from sb3_quad.cli.output import console
    from sb3_quad.envs.vehicles.vehicle import load_vehicle
    from sb3_quad.evaluation.compare import compare
    from sb3_quad.evaluation.tables import Table
    from sb3_quad.experts.geometric import GeometricExpert
    from sb3_quad.experts.pid import PIDExpert

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
        print("cannot hover:", error, file=sys.stderr)
        return 1
    console().print(Table(("", ""), _parameters(vehicle), vehicle.name, align="left"))
    for warning in warnings(vehicle):
        print("unusual:", warning)
    for name in pretrained_names():
        own, _ = agent_settings(pretrained_path(name))
        # Other agents know one vehicle.
        if own.vehicles is not None and (notice := unlike_trained(name, own, vehicle)):
            print("unusual:", notice)
    if options.flights is not None:
        from sb3_quad.identification.logs import read_logs
        from sb3_quad.identification.open_loop import error_table

        logs = read_logs(options.flights, vehicle.control_step)
        console().print(error_table(logs, {vehicle.name: (vehicle, None)}))
    elif options.n_episodes:
        controllers = {"PID": PIDExpert(vehicle), "geometric": GeometricExpert(vehicle)}
        console().print(
            compare(
                controllers,
                n_episodes=options.n_episodes,
                seed=seed_for("expert", options.seed),
                vehicle=vehicle,
                noise=0.0,
            )
        )
    return 0


def _parameters(vehicle: "Vehicle") -> list[list[str]]:
    """Return the lines of the table: names and values."""
    from sb3_quad.base.templates import render
    from sb3_quad.experts.geometric_gains import command_lag

    lines = render(
        "sb3_quad.cli.commands",
        "check_vehicle.j2",
        v=vehicle,
        rpm=RPM,
        lag=1000.0 * command_lag(vehicle.parameters(), vehicle.control_step),
    )
    return [line.split(" | ") for line in lines.splitlines()]


def _divergence(vehicle: "Vehicle") -> float:
    """Return the rate at which a hover diverges that no one controls, 1/s.

    A tilt accelerates the vehicle by g, and its speed v turns it by f v, so the rates s solve
    s (s + drag) (s + damping) + g f = 0, once for roll and once for pitch.
    """
    import numpy as np

    drag = np.divide(vehicle.drag, vehicle.mass) + vehicle.rotor_drag_rates
    fastest = 0.0
    for k, d, f in zip(drag[[1, 0]], vehicle.damping_rates, vehicle.airspeed_turns, strict=False):
        rates = np.roots([1.0, k + d, k * d, vehicle.gravity * f])
        fastest = max(fastest, rates.real.max())
    return fastest


def warnings(vehicle: "Vehicle") -> list[str]:
    """Return a line for each value that is possible but unlikely, mostly due to a wrong unit."""
    from sb3_quad.experts.geometric_gains import command_lag

    gains = (vehicle.motor_gain_up, vehicle.motor_gain_down)
    arm = vehicle.arm_length
    lag = float(command_lag(vehicle.parameters(), vehicle.control_step))
    # The key, its values, the least and the greatest that are likely, what it is and advice.
    measured = (
        (
            "inertia",
            vehicle.gyration_ratios,
            (0.05, 1.0),
            "radii of gyration by the rotors' distance from the centre; is it in kg m², the mass "
            "in kg, and are the rotor positions in m?",
        ),
        (
            "motor_gain",
            [1.0 / max(gains), 1.0 / min(gains)],
            (0.004, 0.3),
            "time constants in s; is it in 1/s, one by the time constant?",
        ),
        # It is about a tenth of a propeller's diameter.
        (
            "moment_thrust_ratio",
            [vehicle.moment_thrust_ratio / arm],
            (0.02, 2.0),
            "kM / kF by the rotors' distance from the centre; is it in m?",
        ),
        (
            "thrust",
            [vehicle.thrust_limits[1]],
            (1.2, math.inf),
            "thrust-to-weight ratio; less leaves little to turn and brake with",
        ),
        (
            "collision_radius",
            [vehicle.collision_radius / arm],
            (0.0, 2.0),
            "by the rotors' distance from the centre; is it in m?",
        ),
        (
            "airspeed_moment",
            [lag * _divergence(vehicle)],
            (0.0, MOST_DIVERGENCE),
            "divergence of the hover by the time from a command to its thrust; beyond, airspeed "
            "turns the vehicle over before the experts act; is it in kg m/rad?",
        ),
    )
    lines = []
    for key, values, (least, greatest), advice in measured:
        low = min(values)
        high = max(values)
        if low < least or high > greatest:
            lines.append(
                f"{key}: {low:.3g} to {high:.3g}, where {least:g} to {greatest:g} is likely: "
                f"{advice}"
            )
    return lines
