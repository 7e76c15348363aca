"""Vehicles that nobody built: parameters of quadcopters, sampled for each episode from ranges of what they can do.

A :class:`VehicleDistribution` is data, ``vehicles`` in ``env_kwargs``. What it does not say is as the given vehicle has it:
the layout of the rotors and their directions, the proportions of the collision sphere, delay, time steps, gravity.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, PositiveFloat, ValidationError, model_validator

from sb3_quad.base.arrays import FloatArray
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.seeds import row_seeds
from sb3_quad.base.validate import Frozen, explain, validate
from sb3_quad.base.yaml_files import YamlFolder
from sb3_quad.simulation.compiled import compiled
from sb3_quad.simulation.episodes import count_episode
from sb3_quad.simulation.layout import first_rows
from sb3_quad.simulation.random import DESIGN, new_streams, uniforms
from sb3_quad.simulation.ranges import Range, between
from sb3_quad.simulation.state import P
from sb3_quad.vehicles.vehicle import PARAMETER_NAMES, Vehicle, load_vehicle

DISTRIBUTIONS = YamlFolder("vehicle distribution", "sb3_quad.vehicles.distributions")
_RANGES = ("mass", "thrust_to_weight", "torque_to_inertia", "motor_time_constant", "moment_thrust_ratio", "least_thrust")
DESIGN_NUMBERS = {**dict.fromkeys(_RANGES, 3), "inertia_ratios": 3, "size_deviation": 1}
"""Numbers of :meth:`VehicleDistribution.numbers`; a range is low, high and how to sample; ratios are 0 if left out."""
DESIGN_SIZE = sum(DESIGN_NUMBERS.values())
D = first_rows(DESIGN_NUMBERS)
_N_PARAMETERS = len(PARAMETER_NAMES)


class VehicleDistribution(Frozen):
    """Ranges of a quadcopter's parameters, ``[low, high]``, a number, or a mapping with a ``distribution``.

    The definitions are those of RAPTOR (arXiv 2509.11481). Arms and collision sphere grow with the cube root of the mass, by a
    factor that deviates: 1 + x where x ≥ 0, else 1 / (1 - x), of x normal with mean -``size_deviation`` and that deviation.
    """

    mass: Range = Field(description="m, kg")
    thrust_to_weight: Range = Field(description="greatest thrust of all rotors by the weight")
    torque_to_inertia: Range = Field(description="arm length times a rotor's greatest thrust by Ixx, rad/s²")
    motor_time_constant: Range = Field(description="1 / k_m, s (Eq. 4.1)")
    moment_thrust_ratio: Range = Field(description="kM / kF, m")
    least_thrust: Range = Field(default=Range(low=0.0, high=0.0), description="of a rotor, in hover thrusts")
    inertia_ratios: tuple[PositiveFloat, PositiveFloat, PositiveFloat] | None = Field(
        default=None, description="of Ixx, Iyy and Izz; left out: the given vehicle's"
    )
    size_deviation: Annotated[float, Field(ge=0, le=1)] = Field(default=0.0, description="of the arms, see above")

    @model_validator(mode="before")
    @classmethod
    def _by_name(cls, data: Any) -> Any:
        """``distribution``: a name, or the path of a YAML file, whose ranges the others are put over; or that alone."""
        data = {"distribution": data} if isinstance(data, (str, Path)) else data
        if isinstance(data, Mapping) and "distribution" in data:
            own = {key: value for key, value in data.items() if key != "distribution"}
            return {**DISTRIBUTIONS.read(data["distribution"])[0], **own}
        return data

    @model_validator(mode="after")
    def _possible(self) -> "VehicleDistribution":
        for name in ("mass", "thrust_to_weight", "torque_to_inertia", "motor_time_constant", "moment_thrust_ratio"):
            if getattr(self, name).low <= 0.0:
                raise ValueError(f"{name} {getattr(self, name).low:g}: must be greater than 0")
        if self.least_thrust.low < 0.0:
            raise ValueError(f"least_thrust {self.least_thrust.low:g}: must not be negative")
        return self

    def weakest(self, vehicle: Vehicle) -> Vehicle:
        """The vehicle of the least thrust and the fastest motors there can be, at the given one's mass: what checks need.

        :raises ConfigError: it cannot fly.
        """
        changes = {
            "name": "sampled",
            "thrust_limits": (self.least_thrust.high, self.thrust_to_weight.low),
            "motor_gain": 1.0 / self.motor_time_constant.low,
            "inertia": self.inertia_ratios or vehicle.inertia,
        }
        try:
            return vehicle.model_copy(update=changes)
        except ValidationError as error:
            raise ConfigError(f"vehicles: some could not fly ({explain(error, Vehicle)})") from None

    def __str__(self) -> str:
        """Such as ``sampled quadcopters (SI units; mass 0.02 to 5, thrust to weight 1.5 to 5)``."""
        ranges = ((name.replace("_", " "), getattr(self, name)) for name in _RANGES)
        return f"sampled quadcopters (SI units; {', '.join(f'{name} {each.low:g} to {each.high:g}' for name, each in ranges)})"

    def numbers(self) -> FloatArray:
        """What :func:`design` reads, in the order of ``DESIGN_NUMBERS``."""
        ranges = [number for name in _RANGES for number in getattr(self, name).numbers()]
        return np.array([*ranges, *(self.inertia_ratios or (0.0, 0.0, 0.0)), self.size_deviation], dtype=np.float64)


def resolve_vehicles(given: Any) -> VehicleDistribution | None:
    """A :class:`VehicleDistribution`, or a mapping of its fields, which may name one: ``{distribution: raptor}``; None: none.

    :raises ConfigError: an unknown name or field, or a value that does not fit.
    """
    if given is None or isinstance(given, VehicleDistribution):
        return given
    return validate(VehicleDistribution, given, "vehicles")


@compiled
def design(i, streams, given, table, nominal):  # type: ignore[no-untyped-def]
    """The vehicle of row i's episode, in place.

    :param given: float64 (len(PARAMETER_NAMES), n or 1), the vehicles that say the rest.
    :param table: float64 (DESIGN_SIZE, 1); ``nominal`` float64 (len(PARAMETER_NAMES), n).
    """
    column, u = min(i, given.shape[1] - 1), uniforms(streams, i, 4, DESIGN)
    for k in range(_N_PARAMETERS):
        nominal[k, i] = given[k, column]
    mass, most = between(table, D.mass, 0, u[0], 1.0), between(table, D.thrust_to_weight, 0, u[1], 1.0)
    least = between(table, D.least_thrust, 0, u[5], 0.0)
    x = table[D.size_deviation, 0] * (math.sqrt(-2.0 * math.log(u[6])) * math.cos(2.0 * math.pi * u[7]) - 1.0)
    share = mass / given[P.mass, column]
    size = share ** (1.0 / 3.0) * (1.0 + x if x >= 0.0 else 1.0 / (1.0 - x))
    hover = mass * given[P.gravity, column] / 4.0
    nominal[P.mass, i], nominal[P.hover_thrust, i] = mass, hover
    nominal[P.thrust_middle, i], nominal[P.thrust_half_range, i] = hover * (most + least) / 2.0, hover * (most - least) / 2.0
    nominal[P.thrust_coefficient, i] *= share  # the rotors turn as fast as those of the given vehicle
    nominal[P.motor_gain, i] = 1.0 / between(table, D.motor_time_constant, 0, u[3], 1.0)
    nominal[P.collision_radius, i] *= size
    ratio = between(table, D.moment_thrust_ratio, 0, u[4], 1.0)
    for rotor in range(4):
        nominal[P.roll_arm_0 + rotor, i] *= size
        nominal[P.pitch_arm_0 + rotor, i] *= size
        nominal[P.yaw_arm_0 + rotor, i] = math.copysign(ratio, nominal[P.yaw_arm_0 + rotor, i])
    for axis in range(3):
        if table[D.inertia_ratios, 0] != 0.0:
            nominal[P.ixx + axis, i] = table[D.inertia_ratios + axis, 0]
    torque = arm_length(i, nominal) * hover * most
    factor = torque / between(table, D.torque_to_inertia, 0, u[2], 1.0) / nominal[P.ixx, i]
    for axis in range(3):
        nominal[P.ixx + axis, i] *= factor


@compiled
def arm_length(column, vehicles):  # type: ignore[no-untyped-def]
    """Distance of the outermost rotor from the centre of mass, m, of a column of parameters."""
    longest = 0.0
    for rotor in range(4):
        x, y = vehicles[P.pitch_arm_0 + rotor, column], vehicles[P.roll_arm_0 + rotor, column]
        longest = max(longest, math.sqrt(x * x + y * y))
    return longest


@compiled
def _design_all(streams, given, table, nominal):  # type: ignore[no-untyped-def]
    for i in range(nominal.shape[1]):
        count_episode(i, streams)
        design(i, streams, given, table, nominal)


def sample_vehicles(vehicles: Any, n: int, seed: int = 0, vehicle: str | Vehicle = "itm") -> list[Vehicle]:
    """n vehicles of a distribution, such as ``sample_vehicles("raptor", 1000)``; each can be given to any environment.

    :param vehicles: as :func:`resolve_vehicles` takes it; ``vehicle`` says what it does not.
    :param seed: vehicle i is that of the first episode of row i in environments of this seed.
    :raises ConfigError: see :func:`resolve_vehicles`; or some of them could not fly.
    """
    distribution, rest = resolve_vehicles(vehicles), load_vehicle(vehicle)
    if distribution is None:
        return [rest] * n
    distribution.weakest(rest)
    columns = np.empty((_N_PARAMETERS, n))
    given, table = rest.parameters()[:, None], distribution.numbers()[:, None]
    _design_all(new_streams(row_seeds(seed, n)), given, table, columns)
    found = []
    for number, column in enumerate(columns.T):
        hover, half = column[P.hover_thrust], column[P.thrust_half_range]
        roll, pitch = column[P.roll_arm_0 : P.yaw_arm_0].reshape(2, 4)
        changes = {
            "name": f"sampled_{seed}_{number}",
            "mass": column[P.mass],
            "inertia": tuple(column[P.ixx : P.izz + 1]),
            "rotor_positions": tuple(zip(-pitch, roll, strict=True)),
            "moment_thrust_ratio": abs(column[P.yaw_arm_0]),
            "thrust_coefficient": column[P.thrust_coefficient],
            "motor_gain": column[P.motor_gain],
            "thrust_limits": ((column[P.thrust_middle] - half) / hover, (column[P.thrust_middle] + half) / hover),
            "collision_radius": column[P.collision_radius],
        }
        found.append(rest.model_copy(update=changes))
    return found
