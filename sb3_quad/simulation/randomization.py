"""Domain randomization: how the vehicle of an episode differs from its model, and which
disturbances act on it.

A :class:`Randomization` is data, ``randomize`` in ``env_kwargs``; :mod:`.sampling` samples from it.
"""

import math
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, field_validator, model_validator

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.types import FloatArray
from sb3_quad.base.validate import Frozen
from sb3_quad.simulation.compiled import compiled
from sb3_quad.simulation.state import first_rows
from sb3_quad.vehicles.vehicle import Vehicle

# The kinds of range; a FIXED one samples nothing.
FIXED, UNIFORM, LOG_UNIFORM, CUBE_ROOT = range(4)
_KINDS = {"uniform": UNIFORM, "log_uniform": LOG_UNIFORM, "uniform_cube_root": CUBE_ROOT}
# The numbers of a range that is not given
FIXED_NUMBERS = (0.0, 0.0, float(FIXED))
_RANGE = len(FIXED_NUMBERS)
Share = Annotated[float, Field(ge=0, le=1)]
AxisFactor = Annotated[float, Field(ge=0, le=10)]
MAX_DELAY = 100  # control steps
# The greatest force or torque, by unit
MAX_MAGNITUDE = {"SI": 1e4, "weight": 100.0}
Number = Annotated[float, Field(ge=-1e6, le=1e6)]  # of a quadcopter, SI
Vector = tuple[Number, Number, Number]
Metre = Annotated[float, Field(ge=-1, le=1)]  # m
FactorLimit = Annotated[float, Field(ge=0.1, le=10)]
WholeSteps = Annotated[float, Field(ge=0, le=MAX_DELAY, multiple_of=1)]
Unit = Literal["SI", "weight"]
VECTOR = {"length": _RANGE, "by_weight": 1, "in_body": 1, "direction": 3, "axes": 3}
V = first_rows(VECTOR)
VEHICLE_RANGES = (
    "mass",
    "inertia",
    "motor_gain",
    "motor_gain_up",
    "motor_gain_down",
    "thrust",
    "arm",
    "center_of_mass",
    "delay",
    "drag",
)
"""The ranges of a :class:`Randomization` that change the vehicle."""
RANDOMIZATION = {
    "share": 1,
    "wrench_share": 1,
    **dict.fromkeys(VEHICLE_RANGES, _RANGE),
    **dict.fromkeys(("force", "torque", "wind"), sum(VECTOR.values())),
    "gust_std": _RANGE,
    "gust_keeps": 1,
    "gust_by_weight": 1,
    "wind_std": _RANGE,
    "wind_keeps": 1,
}
"""Numbers of :meth:`Randomization.numbers`."""
R = first_rows(RANDOMIZATION)


class Range(Frozen):
    """Numbers from ``low`` to ``high``. You may write ``[low, high]``, or one number."""

    low: Number
    """the least number"""
    high: Number
    """the greatest number, at least low"""
    distribution: Literal["uniform", "log_uniform", "uniform_cube_root"] = "uniform"
    """of the number, of its logarithm (low > 0), or of its cube root"""

    @model_validator(mode="before")
    @classmethod
    def _for_short(cls, data: Any) -> Any:
        if isinstance(data, (int, float)) and not isinstance(data, bool):
            return {"low": data, "high": data}
        if isinstance(data, (list, tuple)):
            if len(data) != 2:
                raise ValueError(f"{list(data)!r}: must be [low, high]")
            low, high = data
            return {"low": low, "high": high}
        return data

    @model_validator(mode="after")
    def _rises(self) -> "Range":
        given = f"[{self.low:g}, {self.high:g}]"
        if self.low > self.high:
            raise ValueError(f"{given}: the first number exceeds the second")
        if self.distribution == "log_uniform" and self.low <= 0.0:
            raise ValueError(f"{given}: log_uniform numbers must be greater than 0")
        if self.distribution == "uniform_cube_root" and self.low < 0.0:
            raise ValueError(f"{given}: uniform_cube_root numbers must not be negative")
        return self


def range_numbers(given: Range | None) -> tuple[float, float, float]:
    """Return low, high, and the kind of a range; those of a FIXED one if it is not given."""
    if given is None:
        return FIXED_NUMBERS
    return given.low, given.high, _KINDS[given.distribution]


class NonNegativeRange(Range):
    """A :class:`Range` of numbers from 0."""

    low: NonNegativeFloat
    """the least number, at least 0"""


class PositiveRange(Range):
    """A :class:`Range` of numbers above 0."""

    low: Annotated[float, Field(ge=1e-9)]
    """the least number, at least 1e-9"""


class Offset(Range):
    """A :class:`Range` of distances of at most 1 m either way."""

    low: Metre
    """the least number, at least -1"""
    high: Metre
    """the greatest number, from low to 1"""


class Delay(Range):
    """A :class:`Range` of whole numbers of control steps."""

    low: WholeSteps
    """the least number, in whole control steps"""
    high: WholeSteps
    """the greatest number, in whole control steps"""


class Factor(Range):
    """A factor between 0.1 and 10, log-uniform unless ``distribution`` says otherwise."""

    low: FactorLimit
    """the least factor"""
    high: FactorLimit
    """the greatest factor, at least low"""
    distribution: Literal["uniform", "log_uniform"] = "log_uniform"
    """of the factor or its logarithm"""


UNCHANGED = Factor(low=1.0, high=1.0)


class RandomVector(Frozen):
    """A force or torque at the centre of mass, or a wind, constant during an episode.

    You may write ``[low, high]`` for its magnitude alone.
    """

    magnitude: NonNegativeRange
    """its length, N, N m or m/s; or in the unit that unit names"""
    unit: Unit = "SI"
    """weight: a force in multiples of the weight m g, a torque of m g times the arm length"""
    frame: Literal["world", "body"] | None = None
    """frame in which it is constant; default: world for a force, body for a torque"""
    direction: Vector | None = None
    """its direction; default: uniformly random"""
    axes: tuple[AxisFactor, AxisFactor, AxisFactor] = (1.0, 1.0, 1.0)
    """factor of each component, such as [1, 1, 0] for a horizontal one"""

    @model_validator(mode="before")
    @classmethod
    def _for_short(cls, data: Any) -> Any:
        return {"magnitude": data} if isinstance(data, (list, tuple, int, float)) else data

    @field_validator("direction")
    @classmethod
    def _points_somewhere(cls, value: Vector | None) -> Vector | None:
        if value is not None and not any(value):
            raise ValueError("direction must not be zero")
        return value

    @model_validator(mode="after")
    def _of_a_quadcopter(self) -> "RandomVector":
        _check_magnitude(self.magnitude, self.unit)
        return self

    def numbers(self, frame: str) -> list[float]:
        """Return numbers in the order of ``VECTOR``.

        :param frame: ``world`` or ``body``, where the vector names none.
        """
        direction = np.zeros(3)
        if self.direction is not None:
            direction = np.array(self.direction) / np.linalg.norm(self.direction)
        units = [self.unit == "weight", (self.frame or frame) == "body"]
        return [*range_numbers(self.magnitude), *units, *direction, *self.axes]


class Gusts(Frozen):
    """A force, or velocity of the air, that changes at random: each component in the world frame is
    an Ornstein-Uhlenbeck process.

    Uhlenbeck and Ornstein, "On the theory of the Brownian motion" (Phys. Rev. 36, 1930). The update
    is that of D. T. Gillespie, "Exact numerical simulation of the Ornstein-Uhlenbeck process"
    (Phys. Rev. E 54, 1996), with one difference: the increment of a control step has the variance
    of a normal number but is not one. A sum of many is normal, and a time constant is many steps.
    The first gust of an episode is normal. Deviation and time constant are exact for any control
    step. MIL-F-8785C's Dryden model is this process along the flight path, with the time constant
    L / V.
    """

    std: NonNegativeRange
    """standard deviation of each component, N, or m/s of wind; sampled per episode"""
    unit: Unit = "SI"
    """weight: in multiples of the vehicle's weight m g"""
    time_constant: PositiveFloat = Field(default=1.0, le=1e6)
    """time after which a gust has faded to 1/e, s"""

    @model_validator(mode="after")
    def _of_a_quadcopter(self) -> "Gusts":
        _check_magnitude(self.std, self.unit)
        return self


class Randomization(Frozen):
    """The dynamics and disturbances that are random, sampled for each episode from the row's own
    stream. Fields that you do not give are not random.

    Factors multiply the vehicle's own parameters and are log-uniform unless they say otherwise. The
    limits of the thrusts in N do not follow the mass, so action 0 gives the thrust with which the
    vehicle hovers before it is randomized.
    """

    share: Share = 1.0
    """fraction of the episodes whose vehicle is randomized"""
    mass: Factor | None = None
    """factor, such as [0.8, 1.25]; the thrusts in N do not change"""
    inertia: Factor | None = None
    """factor of each of Ixx, Iyy and Izz; none exceeds the sum of the other two"""
    motor_gain: Factor | None = None
    """factor of k_m (Eq. 4.1)"""
    motor_gain_up: Factor | None = None
    """another factor, of rotors that speed up"""
    motor_gain_down: Factor | None = None
    """another factor, of rotors that slow down"""
    thrust: Factor | None = None
    """factor of the thrust of a command, such as that of an old battery"""
    arm: Factor | None = None
    """factor of the rotors' distances from the centre of mass"""
    center_of_mass: Offset | None = None
    """its offset in body x and in y, m, such as [-0.01, 0.01]"""
    delay: Delay | None = None
    """whole control steps from a command to its effect, such as [0, 3]"""
    drag: NonNegativeRange | None = None
    """added drag along each body axis, 1/s times the nominal mass, such as [0, 0.5]"""
    wrench_share: Share = 1.0
    """fraction of the episodes with force, torque, gusts and wind"""
    force: RandomVector | None = None
    """a constant force, such as {magnitude: [0, 5]}, N"""
    torque: RandomVector | None = None
    """a constant torque, such as {magnitude: [0, 0.1]}, N m"""
    gusts: Gusts | None = None
    """a random force, such as {std: [0, 1], time_constant: 1}"""
    wind: RandomVector | None = None
    """m/s, horizontal unless it has a direction; the air's velocity, acts on vehicles with drag"""
    wind_gusts: Gusts | None = None
    """a random velocity added to the wind, such as {std: [0, 1]}, m/s"""

    @model_validator(mode="after")
    def _possible(self) -> "Randomization":
        for wind in (self.wind, self.wind_gusts):
            if wind is not None and (wind.unit != "SI" or getattr(wind, "frame", None)):
                raise ValueError(
                    "wind and wind_gusts: remove unit and frame;"
                    " they are velocities, m/s, in the world frame"
                )
        return self

    @property
    def sets_vehicle(self) -> bool:
        """Whether an episode begins with a vehicle of its own."""
        return any(getattr(self, name) is not None for name in VEHICLE_RANGES)

    @property
    def sets_wrench(self) -> bool:
        """Whether an episode begins with a wrench of its own, which may be zero."""
        return self.force is not None or self.torque is not None

    def check(self, vehicle: Vehicle) -> None:
        """Refuse a vehicle that could not fly with these numbers.

        :raises ConfigError: it could not hover, or its motors would overshoot.
        """
        least, most = vehicle.thrust_limits
        mass = self.mass or UNCHANGED
        thrust = self.thrust or UNCHANGED
        for is_wrong, heavy, weak, limit in (
            (thrust.low * most <= mass.high, mass.high, thrust.low, f"lift {most:g}"),
            (thrust.high * least > mass.low, mass.low, thrust.high, f"give at least {least:g}"),
        ):
            if is_wrong:
                raise ConfigError(
                    f"randomize: with {heavy:g} times its mass and {weak:g} times its thrust"
                    f" {vehicle.name} cannot hover; its rotors {limit} times its weight"
                )
        # A rotor must not lose more than its whole error in a physics step.
        up = vehicle.motor_gain_up * (self.motor_gain_up or UNCHANGED).high
        down = vehicle.motor_gain_down * (self.motor_gain_down or UNCHANGED).high
        gain = max(up, down) * (self.motor_gain or UNCHANGED).high
        if gain * vehicle.physics_step > 1.0:
            raise ConfigError(
                f"randomize: motor_gain of {vehicle.name} may reach {gain:g};"
                " times physics_step it may not exceed 1"
            )

    def numbers(self, control_step: float) -> FloatArray:
        """Return the numbers that :mod:`.sampling` reads, in the order of ``RANDOMIZATION``.

        :param control_step: s.
        """
        numbers = [self.share * self.sets_vehicle, self.wrench_share]
        for name in VEHICLE_RANGES:
            numbers += range_numbers(getattr(self, name))
        for vector, frame in ((self.force, "world"), (self.torque, "body"), (self.wind, "world")):
            if vector is None:
                # Zeros: its range is FIXED.
                numbers += [0.0] * sum(VECTOR.values())
            else:
                numbers += vector.numbers(frame)
        numbers += _gust_numbers(self.gusts, control_step)
        by_weight = self.gusts is not None and self.gusts.unit == "weight"
        numbers += [by_weight, *_gust_numbers(self.wind_gusts, control_step)]
        table = np.array(numbers)
        # floor(uniform(low, high + 1)) makes every whole number equally likely.
        table[R.delay + 1] += 1.0
        return table


def _gust_numbers(gusts: Gusts | None, control_step: float) -> list[float]:
    """The range of the deviation, and the share of a gust that is left after a control step."""
    if gusts is None:
        return [*FIXED_NUMBERS, 0.0]
    return [*range_numbers(gusts.std), math.exp(-control_step / gusts.time_constant)]


def _check_magnitude(numbers: Range, unit: str) -> None:
    if numbers.high > MAX_MAGNITUDE[unit]:
        raise ValueError(f"{numbers.high:g} ({unit}): must be at most {MAX_MAGNITUDE[unit]:g}")


@compiled
def between(table, k, u, nominal):
    """Return the number for u in (0, 1) from the range at ``table[k : k + 3]``; ``nominal`` if it
    is FIXED.
    """
    low = table[k]
    high = table[k + 1]
    kind = table[k + 2]
    if kind == FIXED:
        return nominal
    if kind == CUBE_ROOT:
        root = low ** (1.0 / 3.0)
        return (root + (high ** (1.0 / 3.0) - root) * u) ** 3
    if kind == LOG_UNIFORM:
        return low * math.exp(u * math.log(high / low))
    return low + (high - low) * u
