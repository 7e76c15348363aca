"""Domain randomization: how the vehicle of an episode differs from its model, and which
disturbances act on it.

A :class:`Randomization` is data, ``randomize`` in ``env_kwargs``; :mod:`.sampling` samples from it.
"""

import math
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, field_validator, model_validator

from sb3_quad.base.arrays import FloatArray
from sb3_quad.base.errors import ConfigError
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

    low: Number = Field(description="the least number")
    high: Number = Field(description="the greatest number, at least low")
    distribution: Literal["uniform", "log_uniform", "uniform_cube_root"] = Field(
        default="uniform",
        description="of the number, of its logarithm (low > 0), or of its cube root",
    )

    @model_validator(mode="before")
    @classmethod
    def _for_short(cls, data: Any) -> Any:
        if isinstance(data, (int, float)) and not isinstance(data, bool):
            return {"low": data, "high": data}
        if isinstance(data, (list, tuple)):
            if len(data) != 2:
                raise ValueError(f"{list(data)!r}: must be [low, high]")
            return dict(zip(("low", "high"), data, strict=True))
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

    def numbers(self) -> list[float]:
        """Return low, high, and the kind of the range."""
        return [self.low, self.high, _KINDS[self.distribution]]


class NonNegativeRange(Range):
    """A :class:`Range` of numbers from 0."""

    low: NonNegativeFloat = Field(description="the least number, at least 0")


class PositiveRange(Range):
    """A :class:`Range` of numbers above 0."""

    low: Annotated[float, Field(ge=1e-9)] = Field(description="the least number, at least 1e-9")


class Offset(Range):
    """A :class:`Range` of distances of at most 1 m either way."""

    low: Annotated[float, Field(ge=-1, le=1)] = Field(description="the least number, at least -1")
    high: Annotated[float, Field(ge=-1, le=1)] = Field(
        description="the greatest number, from low to 1"
    )


class Factor(Range):
    """A factor between 0.1 and 10, log-uniform unless ``distribution`` says otherwise."""

    low: Annotated[float, Field(ge=0.1, le=10)] = Field(description="the least factor")
    high: Annotated[float, Field(ge=0.1, le=10)] = Field(
        description="the greatest factor, at least low"
    )
    distribution: Literal["uniform", "log_uniform"] = Field(
        default="log_uniform", description="of the factor or its logarithm"
    )


class RandomVector(Frozen):
    """A force or torque at the centre of mass, or a wind, constant during an episode.

    You may write ``[low, high]`` for its magnitude alone.
    """

    magnitude: NonNegativeRange = Field(
        description="its length, N, N m or m/s; or in the unit that unit names"
    )
    unit: Literal["SI", "weight"] = Field(
        default="SI",
        description="weight: a force in multiples of the weight m g, a torque of m g times the arm"
        " length",
    )
    frame: Literal["world", "body"] | None = Field(
        default=None,
        description="frame in which it is constant; default: world for a force, body for a torque",
    )
    direction: Vector | None = Field(
        default=None, description="its direction; default: uniformly random"
    )
    axes: tuple[AxisFactor, AxisFactor, AxisFactor] = Field(
        default=(1.0, 1.0, 1.0),
        description="factor of each component, such as [1, 1, 0] for a horizontal one",
    )

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
        by_weight = float(self.unit == "weight")
        in_body = float((self.frame or frame) == "body")
        return [*self.magnitude.numbers(), by_weight, in_body, *direction, *self.axes]


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

    std: NonNegativeRange = Field(
        description="standard deviation of each component, N, or m/s of wind; sampled per episode"
    )
    unit: Literal["SI", "weight"] = Field(
        default="SI", description="weight: in multiples of the vehicle's weight m g"
    )
    time_constant: PositiveFloat = Field(
        default=1.0, le=1e6, description="time after which a gust has faded to 1/e, s"
    )

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

    share: Share = Field(
        default=1.0, description="fraction of the episodes whose vehicle is randomized"
    )
    mass: Factor | None = Field(
        default=None, description="factor, such as [0.8, 1.25]; the thrusts in N do not change"
    )
    inertia: Factor | None = Field(
        default=None,
        description="factor of each of Ixx, Iyy and Izz; none exceeds the sum of the other two",
    )
    motor_gain: Factor | None = Field(default=None, description="factor of k_m (Eq. 4.1)")
    motor_gain_up: Factor | None = Field(
        default=None, description="another factor, of rotors that speed up"
    )
    motor_gain_down: Factor | None = Field(
        default=None, description="another factor, of rotors that slow down"
    )
    thrust: Factor | None = Field(
        default=None,
        description="factor of the thrust of a command, such as that of an old battery",
    )
    arm: Factor | None = Field(
        default=None, description="factor of the rotors' distances from the centre of mass"
    )
    center_of_mass: Offset | None = Field(
        default=None, description="its offset in body x and in y, m, such as [-0.01, 0.01]"
    )
    delay: Range | None = Field(
        default=None,
        description="whole control steps from a command to its effect, such as [0, 3]; with"
        " log_uniform short delays are more frequent",
    )
    drag: NonNegativeRange | None = Field(
        default=None,
        description="added drag along each body axis, 1/s times the nominal mass, such as [0, 0.5]",
    )
    wrench_share: Share = Field(
        default=1.0, description="fraction of the episodes with force, torque, gusts and wind"
    )
    force: RandomVector | None = Field(
        default=None, description="a constant force, such as {magnitude: [0, 5]}, N"
    )
    torque: RandomVector | None = Field(
        default=None, description="a constant torque, such as {magnitude: [0, 0.1]}, N m"
    )
    gusts: Gusts | None = Field(
        default=None, description="a random force, such as {std: [0, 1], time_constant: 1}"
    )
    wind: RandomVector | None = Field(
        default=None,
        description="a constant velocity of the air, m/s, horizontal unless it has a direction; it"
        " acts on vehicles with drag",
    )
    wind_gusts: Gusts | None = Field(
        default=None, description="a random velocity added to the wind, such as {std: [0, 1]}, m/s"
    )

    @model_validator(mode="after")
    def _possible(self) -> "Randomization":
        delay = self.delay
        if delay is not None:
            is_whole = delay.low % 1 == 0 and delay.high % 1 == 0
            if not is_whole or delay.low < 0 or delay.high > MAX_DELAY:
                raise ValueError(
                    f"delay [{delay.low:g}, {delay.high:g}]:"
                    f" must be whole control steps of 0 to {MAX_DELAY}"
                )
        constant, gusts = self.wind, self.wind_gusts
        has_frame = constant is not None and constant.frame is not None
        has_unit = any(wind is not None and wind.unit != "SI" for wind in (constant, gusts))
        if has_frame or has_unit:
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
        lightest, heaviest = _bounds(self.mass)
        weakest, strongest = _bounds(self.thrust)
        text = (
            "randomize: with {:g} times its mass and {:g} times its thrust {} cannot hover;"
            " its rotors {} times its weight"
        )
        if weakest * most <= heaviest:
            raise ConfigError(text.format(heaviest, weakest, vehicle.name, f"lift {most:g}"))
        if strongest * least > lightest:
            limit = f"give at least {least:g}"
            raise ConfigError(text.format(lightest, strongest, vehicle.name, limit))
        up = vehicle.motor_gain_up * _bounds(self.motor_gain_up)[1]
        down = vehicle.motor_gain_down * _bounds(self.motor_gain_down)[1]
        gain = max(up, down) * _bounds(self.motor_gain)[1]
        if gain * vehicle.physics_step > 1.0:
            raise ConfigError(
                f"randomize: motor_gain of {vehicle.name} may reach {gain:g};"
                " times physics_step it may not exceed 1"
            )

    def numbers(self, control_step: float) -> FloatArray:
        """Return the numbers that :mod:`.sampling` reads, in the order of ``RANDOMIZATION``.

        :param control_step: s.
        """
        numbers = [self.share if self.sets_vehicle else 0.0, self.wrench_share]
        for name in VEHICLE_RANGES:
            given = getattr(self, name)
            if name == "delay" and given is not None:
                # floor(uniform(low, high + 1)) makes every whole number equally likely.
                given = given.model_copy(update={"high": given.high + 1.0})
            numbers += FIXED_NUMBERS if given is None else given.numbers()
        for vector, frame in ((self.force, "world"), (self.torque, "body"), (self.wind, "world")):
            if vector is None:
                numbers += [*FIXED_NUMBERS, *np.zeros(sum(VECTOR.values()) - _RANGE)]
            else:
                numbers += vector.numbers(frame)
        by_weight = float(self.gusts is not None and self.gusts.unit == "weight")
        numbers += [*_gust_numbers(self.gusts, control_step), by_weight]
        return np.array([*numbers, *_gust_numbers(self.wind_gusts, control_step)])


def _bounds(factor: Factor | None) -> tuple[float, float]:
    """The least and the greatest value of a factor."""
    return (1.0, 1.0) if factor is None else (factor.low, factor.high)


def _gust_numbers(gusts: Gusts | None, control_step: float) -> list[float]:
    """The range of the deviation, and the share of a gust that is left after a control step."""
    if gusts is None:
        return [*FIXED_NUMBERS, 0.0]
    return [*gusts.std.numbers(), math.exp(-control_step / gusts.time_constant)]


def _check_magnitude(numbers: Range, unit: str) -> None:
    if numbers.high > MAX_MAGNITUDE[unit]:
        raise ValueError(f"{numbers.high:g} ({unit}): must be at most {MAX_MAGNITUDE[unit]:g}")


@compiled
def between(table, k, u, nominal):
    """Return the number for u in (0, 1) from the range at ``table[k : k + 3]``; ``nominal`` if it
    is FIXED.
    """
    low, high, kind = table[k], table[k + 1], table[k + 2]
    if kind == FIXED:
        return nominal
    if kind == CUBE_ROOT:
        root = low ** (1.0 / 3.0)
        return (root + (high ** (1.0 / 3.0) - root) * u) ** 3
    if kind == LOG_UNIFORM:
        return low * math.exp(u * math.log(high / low))
    return low + (high - low) * u
