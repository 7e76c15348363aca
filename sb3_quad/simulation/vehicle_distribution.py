"""Distributions of vehicles: ranges of a quadcopter's parameters, from which each episode has one
of its own.

A :class:`VehicleDistribution` is ``vehicles`` in ``env_kwargs``. The base vehicle says the rest:
the layout of the rotors and their directions, the proportions of the collision sphere, delay, time
steps, gravity.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, ValidationError, model_validator

from sb3_quad.base.arrays import FloatArray
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.validate import Frozen, explain
from sb3_quad.base.yaml_files import YamlFolder
from sb3_quad.simulation.compiled import compiled
from sb3_quad.simulation.random import DISTRIBUTION, uniforms
from sb3_quad.simulation.randomization import (
    FIXED,
    FIXED_NUMBERS,
    NonNegativeRange,
    PositiveRange,
    between,
)
from sb3_quad.simulation.state import P, first_rows
from sb3_quad.vehicles.vehicle import Vehicle

DISTRIBUTIONS = YamlFolder("vehicle distribution", "sb3_quad.vehicles.distributions")
_RANGES = (
    *(
        "mass",
        "thrust_to_weight",
        "torque_to_inertia",
        "motor_time_constant",
        "moment_thrust_ratio",
        "least_thrust",
    ),
    *("motor_time_constant_down", "drag"),
)
DISTRIBUTION_NUMBERS = {
    **dict.fromkeys(_RANGES, len(FIXED_NUMBERS)),
    "inertia_ratios": 3,
    "size_deviation": 1,
}
"""Numbers of :meth:`VehicleDistribution.numbers`; ratios are 0 if left out."""
D = first_rows(DISTRIBUTION_NUMBERS)
NO_DISTRIBUTION = np.array([*FIXED_NUMBERS * len(_RANGES), *np.zeros(4)])
Ratio = Annotated[float, Field(ge=1e-6, le=1e6)]


class VehicleDistribution(Frozen):
    """Ranges of a quadcopter's parameters, ``[low, high]``, a number, or a mapping with a
    ``distribution``.

    The definitions are those of RAPTOR (arXiv 2509.11481). Arms and collision sphere grow with the
    cube root of the mass, by a factor that deviates: 1 + x where x ≥ 0, else 1 / (1 - x), of x
    normal with mean -``size_deviation`` and that deviation.
    """

    mass: PositiveRange = Field(description="m, kg")
    thrust_to_weight: PositiveRange = Field(
        description="greatest thrust of all rotors by the weight"
    )
    torque_to_inertia: PositiveRange = Field(
        description="arm length times a rotor's greatest thrust by Ixx, rad/s²"
    )
    motor_time_constant: PositiveRange = Field(description="1 / k_m, s (Eq. 4.1)")
    motor_time_constant_down: PositiveRange | None = Field(
        default=None, description="of a rotor that slows down, s; left out: the same"
    )
    moment_thrust_ratio: PositiveRange = Field(description="kM / kF, m")
    least_thrust: NonNegativeRange = Field(
        default=NonNegativeRange(low=0, high=0), description="of a rotor, in hover thrusts"
    )
    inertia_ratios: tuple[Ratio, Ratio, Ratio] | None = Field(
        default=None, description="of Ixx, Iyy and Izz; left out: the base vehicle's"
    )
    drag: NonNegativeRange | None = Field(
        default=None,
        description="along each body axis by the mass, 1/s; left out: the base vehicle's",
    )
    size_deviation: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.0, description="of the arms, see above"
    )

    @model_validator(mode="before")
    @classmethod
    def _by_name(cls, data: Any) -> Any:
        """``distribution``: a name, or the path of a YAML file, whose ranges the others replace; or
        that alone.
        """
        data = {"distribution": data} if isinstance(data, (str, Path)) else data
        if isinstance(data, Mapping) and "distribution" in data:
            if not isinstance(data["distribution"], (str, Path)):
                raise ValueError("distribution: must be a name, or the path of a YAML file")
            own = {key: value for key, value in data.items() if key != "distribution"}
            return {**DISTRIBUTIONS.read(data["distribution"])[0], **own}
        return data

    def weakest(self, base: Vehicle) -> Vehicle:
        """The vehicle of least thrust and fastest motors, at the base vehicle's mass; it shows
        whether all can fly.

        :raises ConfigError: it cannot fly.
        """
        changes = {
            "name": "sampled",
            "thrust_limits": (self.least_thrust.high, self.thrust_to_weight.low),
            "motor_gain": 1.0
            / min(
                each.low
                for each in (self.motor_time_constant, self.motor_time_constant_down)
                if each
            ),
            "inertia": self.inertia_ratios or base.inertia,
        }
        try:
            return base.model_copy(update=changes)
        except ValidationError as error:
            raise ConfigError(f"vehicles: some could not fly ({explain(error, Vehicle)})") from None

    def __str__(self) -> str:
        """Such as ``sampled quadcopters (SI units; mass 0.02 to 5, thrust to weight 1.5 to 5)``."""
        ranges = (
            (name.replace("_", " "), each)
            for name in _RANGES
            if (each := getattr(self, name)) is not None
        )
        return f"sampled quadcopters (SI units; {', '.join(f'{name} {each.low:g} to {each.high:g}' for name, each in ranges)})"

    def numbers(self) -> FloatArray:
        """What :func:`sample_from_distribution` reads, in the order of ``DISTRIBUTION_NUMBERS``."""
        given = [getattr(self, name) for name in _RANGES]
        ranges = [
            number
            for each in given
            for number in (FIXED_NUMBERS if each is None else each.numbers())
        ]
        return np.array(
            [*ranges, *(self.inertia_ratios or (0.0, 0.0, 0.0)), self.size_deviation],
            dtype=np.float64,
        )


@compiled
def sample_from_distribution(i, streams, table, vehicles):
    """Turn vehicle i, which is the base vehicle, into one that is sampled for the row's episode; in
    place.

    :param table: :meth:`VehicleDistribution.numbers`, or ``NO_DISTRIBUTION``, by which it stays the
        base vehicle.
    :param vehicles: float64 (len(PARAMETER_NAMES), n).
    """
    if table[D.mass + 2] == FIXED:
        return
    u = uniforms(streams, i, 5, DISTRIBUTION)
    mass, most = between(table, D.mass, u[0], 1.0), between(table, D.thrust_to_weight, u[1], 1.0)
    least = between(table, D.least_thrust, u[5], 0.0)
    x = table[D.size_deviation] * (
        math.sqrt(-2.0 * math.log(u[6])) * math.cos(2.0 * math.pi * u[7]) - 1.0
    )
    share = mass / vehicles[P.mass, i]
    size = share ** (1.0 / 3.0) * (1.0 + x if x >= 0.0 else 1.0 / (1.0 - x))
    hover = mass * vehicles[P.gravity, i] / 4.0
    vehicles[P.mass, i], vehicles[P.hover_thrust, i] = mass, hover
    vehicles[P.thrust_middle, i], vehicles[P.thrust_half_range, i] = (
        hover * (most + least) / 2.0,
        hover * (most - least) / 2.0,
    )
    vehicles[P.thrust_coefficient, i] *= (
        share  # the rotors turn as fast as those of the base vehicle
    )
    slow = between(table, D.motor_time_constant, u[3], 1.0)
    vehicles[P.motor_gain_up, i], vehicles[P.exact_motors, i] = 1.0 / slow, 1.0
    vehicles[P.motor_gain_down, i] = 1.0 / between(table, D.motor_time_constant_down, u[8], slow)
    for axis in range(3):
        vehicles[P.drag_x + axis, i] = mass * between(
            table, D.drag, u[9], vehicles[P.drag_x + axis, i] * share / mass
        )
    vehicles[P.collision_radius, i] *= size
    ratio = between(table, D.moment_thrust_ratio, u[4], 1.0)
    for rotor in range(4):
        vehicles[P.roll_arm_0 + rotor, i] *= size
        vehicles[P.pitch_arm_0 + rotor, i] *= size
        vehicles[P.yaw_arm_0 + rotor, i] = math.copysign(ratio, vehicles[P.yaw_arm_0 + rotor, i])
    for axis in range(3):
        if table[D.inertia_ratios] != 0.0:
            vehicles[P.ixx + axis, i] = table[D.inertia_ratios + axis]
    torque = arm_length(i, vehicles) * hover * most
    factor = torque / between(table, D.torque_to_inertia, u[2], 1.0) / vehicles[P.ixx, i]
    for axis in range(3):
        vehicles[P.ixx + axis, i] *= factor


@compiled
def arm_length(column, vehicles):
    """Distance of the outermost rotor from the centre of mass, m, of a column of parameters."""
    longest = 0.0
    for rotor in range(4):
        x, y = vehicles[P.pitch_arm_0 + rotor, column], vehicles[P.roll_arm_0 + rotor, column]
        longest = max(longest, math.sqrt(x * x + y * y))
    return longest
