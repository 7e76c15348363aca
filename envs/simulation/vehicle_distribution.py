"""Distributions of vehicles: ranges of a quadcopter's parameters, from which each episode samples
its vehicle.

A :class:`VehicleDistribution` is ``vehicles`` in ``env_kwargs``. The rest comes from the base
vehicle: the layout of the rotors and their directions, the proportions of the collision sphere,
delay, time steps, gravity.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, model_validator

from sb3_quad.base.compiled import called
from sb3_quad.base.types import FloatArray
from sb3_quad.base.validate import Frozen
from sb3_quad.base.yaml_files import YamlFolder
from sb3_quad.envs.simulation.random import DISTRIBUTION, uniforms
from sb3_quad.envs.simulation.randomization import (
    FIXED,
    RANGE,
    NonNegativeRange,
    PositiveRange,
    Range,
    between,
    flyable,
    numbers_of,
)
from sb3_quad.envs.simulation.state import P, first_rows
from sb3_quad.envs.vehicles.rates import LEAST_DERIVED_LIMITS, derived_gain, derived_limit
from sb3_quad.envs.vehicles.vehicle import Vehicle

DISTRIBUTIONS = YamlFolder("vehicle distribution", "sb3_quad.envs.vehicles.distributions")
EDGE = 1e-3
_derived_gain = called(derived_gain)
_derived_limit = called(derived_limit)
Ratio = Annotated[float, Field(ge=1e-6, le=1e6)]


class VehicleDistribution(Frozen):
    """Ranges of a quadcopter's parameters. Each is ``[low, high]``, a number, or a mapping with a
    ``distribution``.

    The definitions are those of RAPTOR (arXiv 2509.11481). Arms and collision sphere grow with the
    cube root of the mass, times a random factor: 1 + x for x ≥ 0, else 1 / (1 - x), where x is
    normal with mean -``size_deviation`` and standard deviation ``size_deviation``.
    """

    mass: PositiveRange
    """m, kg"""
    thrust_to_weight: PositiveRange
    """greatest thrust of all rotors, divided by the weight"""
    torque_to_inertia: PositiveRange
    """arm length times a rotor's greatest thrust, divided by Ixx, rad/s²"""
    motor_time_constant: PositiveRange
    """1 / k_m, s (Eq. 4.1)"""
    motor_time_constant_down: PositiveRange | None = None
    """1 / k_m of a rotor that slows down, s; default: the same"""
    moment_thrust_ratio: PositiveRange
    """kM / kF, m"""
    least_thrust: NonNegativeRange = NonNegativeRange(low=0, high=0)
    """least thrust of a rotor, in hover thrusts"""
    inertia_ratios: tuple[Ratio, Ratio, Ratio] | None = None
    """ratios of Ixx, Iyy and Izz; default: the base vehicle's"""
    drag: NonNegativeRange | None = None
    """drag along each body axis, divided by the mass, 1/s; default: the base vehicle's"""
    size_deviation: Annotated[float, Field(ge=0, le=1)] = 0.0
    """deviation of the arms' length, see above"""

    @model_validator(mode="before")
    @classmethod
    def _by_name(cls, data: Any) -> Any:
        """Read ``distribution``, a name or the path of a YAML file, whose ranges the other keys
        replace. A name or path alone means the same.
        """
        if isinstance(data, (str, Path)):
            data = {"distribution": data}
        if not isinstance(data, Mapping) or "distribution" not in data:
            return data
        changes = dict(data)
        return {**DISTRIBUTIONS.read(changes.pop("distribution"))[0], **changes}

    def hardest(self, base: Vehicle) -> Vehicle:
        """Return the vehicle with the least thrust and the fastest motors, at the base vehicle's
        mass. If it can fly, all can.

        :raises ConfigError: it cannot fly.
        """
        fastest = self.motor_time_constant.low
        if self.motor_time_constant_down is not None:
            fastest = min(fastest, self.motor_time_constant_down.low)
        changes = {
            "name": "sampled",
            "thrust_limits": (self.least_thrust.high, self.thrust_to_weight.low),
            "motor_gain": 1.0 / fastest,
            "motor_integration": "exact",  # as sampled vehicles have it
            "inertia": self.inertia_ratios or base.inertia,
        }
        return flyable(base, changes, "vehicles")

    def outside(self, vehicle: Vehicle) -> list[str]:
        """Return which quantities of a vehicle are outside of these ranges, such as ``thrust to
        weight 14 (1.5 to 12)``.
        """
        values = {
            "mass": vehicle.mass,
            "thrust_to_weight": vehicle.thrust_limits[1],
            "torque_to_inertia": vehicle.arm_length * vehicle.thrust_range[1] / vehicle.inertia[0],
            "motor_time_constant": 1.0 / vehicle.motor_gain_up,
            "moment_thrust_ratio": vehicle.moment_thrust_ratio,
        }
        texts = []
        for name, value in values.items():
            texts += beyond(name, value, getattr(self, name))
        return texts

    def __str__(self) -> str:
        """Such as ``sampled quadcopters (SI units; mass 0.02 to 5, thrust to weight 1.5 to 5)``."""
        texts = []
        for name, given in self:
            if isinstance(given, Range):
                texts.append(f"{name.replace('_', ' ')} {given.low:g} to {given.high:g}")
        return f"sampled quadcopters (SI units; {', '.join(texts)})"

    def numbers(self) -> FloatArray:
        """Return the numbers that :func:`sample_from_distribution` reads, in the order of
        ``DISTRIBUTION_NUMBERS``.
        """
        return numbers_of(self, DISTRIBUTION_NUMBERS)


def beyond(name: str, value: float, limits: Range[float]) -> list[str]:
    """Return a text such as ``delay 6 (0 to 4)`` if a value is outside of its range, else none."""
    # Rounding must not matter to a vehicle at the edge.
    if limits.low * (1.0 - EDGE) <= value <= limits.high * (1.0 + EDGE):
        return []
    return [f"{name.replace('_', ' ')} {value:.3g} ({limits.low:g} to {limits.high:g})"]


DISTRIBUTION_NUMBERS = dict.fromkeys(VehicleDistribution.model_fields, RANGE) | {
    "inertia_ratios": 3,
    "size_deviation": 1,
}
"""Numbers of :meth:`VehicleDistribution.numbers`; ratios that are not given are 0."""
D = first_rows(DISTRIBUTION_NUMBERS)
# A distribution whose ranges are all FIXED
NO_DISTRIBUTION = np.zeros(sum(DISTRIBUTION_NUMBERS.values()))


@called
def sample_from_distribution(i, streams, table, vehicles):
    """Replace vehicle i, which is the base vehicle, by one that is sampled for the row's episode,
    in place.

    :param table: :meth:`VehicleDistribution.numbers`; with ``NO_DISTRIBUTION`` it stays the base
        vehicle.
    :param vehicles: float64 (len(PARAMETER_NAMES), n).
    """
    if table[D.mass + 2] == FIXED:
        return
    u = uniforms(streams, i, DISTRIBUTION)
    mass = between(table, D.mass, u[0], 1.0)
    v = vehicles[:, i]
    mass_ratio = mass / v[P.mass]
    most = between(table, D.thrust_to_weight, u[1], 1.0)
    least = between(table, D.least_thrust, u[5], 0.0)
    hover = mass * v[P.gravity] / 4.0

    # Drag first, since that of the base vehicle grows with the mass.
    for axis in range(3):
        nominal = v[P.drag_x + axis] * mass_ratio / mass
        v[P.drag_x + axis] = mass * between(table, D.drag, u[9], nominal)
        v[P.rotor_drag_x + axis] *= mass_ratio
    v[P.translational_lift] *= mass_ratio
    v[P.mass] = mass
    v[P.hover_thrust] = hover
    v[P.thrust_middle] = hover * (most + least) / 2.0
    v[P.thrust_half_range] = hover * (most - least) / 2.0
    # The rotors turn as fast as those of the base vehicle.
    v[P.thrust_coefficient] *= mass_ratio
    slow = between(table, D.motor_time_constant, u[3], 1.0)
    v[P.exact_motors] = 1.0
    v[P.motor_gain_up] = 1.0 / slow
    v[P.motor_gain_down] = 1.0 / between(table, D.motor_time_constant_down, u[8], slow)

    # Size and arms, by a standard normal from two uniforms (Box-Muller).
    normal = math.sqrt(-2.0 * math.log(u[6])) * math.cos(2.0 * math.pi * u[7])
    x = table[D.size_deviation] * (normal - 1.0)
    size = mass_ratio ** (1.0 / 3.0) * (1.0 + x if x >= 0.0 else 1.0 / (1.0 - x))
    v[P.collision_radius] *= size
    v[P.ground_effect_radius] *= size
    ratio = between(table, D.moment_thrust_ratio, u[4], 1.0)
    for rotor in range(4):
        v[P.roll_arm_0 + rotor] *= size
        v[P.pitch_arm_0 + rotor] *= size
        v[P.roll_mix_0 + rotor] /= size
        v[P.pitch_mix_0 + rotor] /= size
        v[P.yaw_mix_0 + rotor] *= abs(v[P.yaw_arm_0 + rotor]) / ratio
        v[P.yaw_arm_0 + rotor] = math.copysign(ratio, v[P.yaw_arm_0 + rotor])

    # Inertia: the ratios of its axes, then its size by Ixx. Moments of the air grow with it.
    before = v[P.ixx], v[P.iyy], v[P.izz]
    if table[D.inertia_ratios] != 0.0:
        for axis in range(3):
            v[P.ixx + axis] = table[D.inertia_ratios + axis]
    torque = arm_length(v) * hover * most
    factor = torque / between(table, D.torque_to_inertia, u[2], 1.0) / v[P.ixx]
    for axis in range(3):
        v[P.ixx + axis] *= factor
        growth = v[P.ixx + axis] / before[axis]
        v[P.rate_damping_x + axis] *= growth
        if axis < 2:
            v[P.airspeed_moment_roll + axis] *= growth
    v[P.rotor_inertia] *= v[P.izz] / before[2]

    # The rate loop has default limits and gains.
    gain = _derived_gain(v[P.rate_lag], v[P.motor_gain_up], v[P.motor_gain_down])
    for axis in range(3):
        arms = 0.0
        for rotor in range(4):
            arms += abs(v[P.roll_arm_0 + 4 * axis + rotor])
        inertia = v[P.ixx + axis]
        v[P.rate_gain_x + axis] = gain * inertia
        turn = arms * v[P.thrust_half_range] / inertia
        v[P.rate_limit_x + axis] = _derived_limit(turn, gain, LEAST_DERIVED_LIMITS[axis])


@called
def arm_length(vehicle):
    """Return the distance of the outermost rotor from the centre of mass, m.

    :param vehicle: float64 (len(PARAMETER_NAMES),).
    """
    longest = 0.0
    for rotor in range(4):
        x = vehicle[P.pitch_arm_0 + rotor]
        y = vehicle[P.roll_arm_0 + rotor]
        longest = max(longest, math.sqrt(x * x + y * y))
    return longest
