"""A vehicle on one page: what its parameters say it can do, and what is odd about them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from sb3_quad.evaluation.expert_figures import start_states
from sb3_quad.experts.reach import least_height_lost
from sb3_quad.vehicles.authority import Authority, gyration_ratio
from sb3_quad.vehicles.vehicle import Vehicle

if TYPE_CHECKING:
    from rich.table import Table

SLIM_THRUST = 1.2  # thrust-to-weight ratio below which little is left to turn and brake with
RPM = 60.0 / (2.0 * math.pi)  # rpm per rad/s


def parameter_table(vehicle: Vehicle, able: Authority) -> Table:
    """What it weighs, lifts and how soon it answers."""
    from rich.table import Table

    low, high = vehicle.thrust_range
    slow, fast = vehicle.rotor_speed_range
    ixx, iyy, izz = vehicle.inertia
    largest = max(vehicle.inertia)
    table = Table(title=vehicle.name, title_justify="left", show_header=False)
    table.add_column(no_wrap=True)
    table.add_column()
    table.add_row("can hover", f"yes: thrust-to-weight ratio {able.thrust_to_weight:.2f}, least {able.least_thrust:.2f}")
    table.add_row("mass, weight", f"{vehicle.mass:g} kg, {vehicle.mass * vehicle.gravity:.4g} N")
    table.add_row("rotor thrust", f"{low:.4g} to {high:.4g} N, hover {vehicle.hover_thrust:.4g} N (action {_signed(vehicle)})")
    table.add_row(
        "rotor speed",
        f"{slow:.0f} to {fast:.0f} rad/s, hover {vehicle.hover_rotor_speed:.0f} rad/s "
        f"({slow * RPM:.0f} to {fast * RPM:.0f} rpm, hover {vehicle.hover_rotor_speed * RPM:.0f} rpm)",
    )
    table.add_row("acceleration", f"up {able.climb:.1f}, down {able.fall:.1f}, sideways {able.sideways:.1f} m/s²")
    table.add_row("", f"sideways at constant height, tilted by {math.degrees(able.tilt):.0f}°; down while level")
    table.add_row("inertia", f"{ixx:.4g}, {iyy:.4g}, {izz:.4g} kg m²")
    share = largest / (sum(vehicle.inertia) - largest)
    table.add_row(
        "", f"physical: the largest moment is {share:.2f} of the other two together, at most 1 (triangle inequality)"
    )
    ratios = ", ".join(f"{ratio:.2f}" for ratio in gyration_ratio(vehicle))
    table.add_row("", f"radii of gyration {ratios} of the rotors' distance from the centre")
    table.add_row(
        "motors", f"time constant {1000 * able.motor_lag:.1f} ms; from command to thrust {1000 * able.command_lag:.1f} ms"
    )
    table.add_row("half a turn", f"{able.half_turn:.2f} s from rest to rest, roll or pitch, the weaker; lags left out")
    return table


def authority_table(able: Authority) -> Table:
    """Moments and angular accelerations about each axis."""
    from rich.table import Table

    table = Table(title="authority", title_justify="left")
    for name in ("axis", "greatest moment", "acceleration", "moment in hover", "acceleration"):
        table.add_column(name, justify="left" if name == "axis" else "right")
    for axis, name in enumerate(("roll", "pitch", "yaw")):
        table.add_row(
            name,
            f"{able.moments[axis]:.4g} N m",
            f"{able.accelerations[axis]:.1f} rad/s²",
            f"{able.hover_moments[axis]:.4g} N m",
            f"{able.hover_accelerations[axis]:.1f} rad/s²",
        )
    table.caption = "in hover: total thrust kept at hover, no moment about the other axes"
    table.caption_justify = "left"
    return table


def doubts(vehicle: Vehicle, able: Authority) -> list[str]:
    """What is possible but unlikely: mostly a wrong unit."""
    found = []
    ratio = gyration_ratio(vehicle)
    if ratio.max() > 1.0 or ratio.min() < 0.05:
        found.append(
            f"inertia: radii of gyration of {ratio.min():.3g} to {ratio.max():.3g} of the rotors' distance are unusual "
            "(0.2 to 0.6 is common); is it in kg m², and are the rotor positions in m?"
        )
    if able.thrust_to_weight < SLIM_THRUST:
        found.append(
            f"thrust: a thrust-to-weight ratio of {able.thrust_to_weight:.2f} leaves little to turn and to brake with"
        )
    if vehicle.collision_radius > 2.0 * max(math.hypot(x, y) for x, y in vehicle.rotor_positions):
        found.append("collision_radius: is more than twice the rotors' distance from the centre; is it in m?")
    return found


def lost_whatever_flies(vehicle: Vehicle, episodes: int, seed: int) -> int:
    """How many starts of the state recovery end at the ground whatever flies there, by a lower bound of the height lost."""
    starts = start_states("state_recovery", episodes, seed, vehicle)
    room = starts.position[:, 2] - vehicle.collision_radius
    return int(np.sum(least_height_lost(starts, vehicle) > room))


def _signed(vehicle: Vehicle) -> str:
    return f"{vehicle.hover_action:+.3f}" if abs(vehicle.hover_action) > 5e-4 else "0"
