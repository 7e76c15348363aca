"""Randomization: by what the vehicle of an episode differs from its model, and what pushes it.

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

FIXED, UNIFORM, LOG_UNIFORM, CUBE_ROOT = range(4)
_KINDS = {"uniform": UNIFORM, "log_uniform": LOG_UNIFORM, "uniform_cube_root": CUBE_ROOT}
FIXED_NUMBERS = (0.0, 0.0, float(FIXED))  # of a range that is left out
Share = Annotated[float, Field(ge=0, le=1)]
AxisFactor = Annotated[float, Field(ge=0, le=10)]
MAX_DELAY = 100  # control steps
MAX_PUSH = {"SI": 1e4, "weight": 100.0}  # of a force or torque, by unit
Number = Annotated[float, Field(ge=-1e6, le=1e6)]  # of a quadcopter, SI
Vector = tuple[Number, Number, Number]
_RANGE = len(FIXED_NUMBERS)
VECTOR = {"length": _RANGE, "by_weight": 1, "in_body": 1, "direction": 3, "axes": 3}
V = first_rows(VECTOR)
RANDOMIZATION = {
    "share": 1,
    "wrench_share": 1,
    **dict.fromkeys(
        ("mass", "inertia", "motor_gain", "motor_gain_up", "motor_gain_down", "thrust", "arm"),
        _RANGE,
    ),
    **dict.fromkeys(("center_of_mass", "delay", "drag"), _RANGE),
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
    """Numbers from ``low`` to ``high``; ``[low, high]`` for short, or one number."""

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
        if self.low > self.high:
            raise ValueError(f"[{self.low:g}, {self.high:g}]: the first number exceeds the second")
        if self.distribution == "log_uniform" and self.low <= 0.0:
            raise ValueError(
                f"[{self.low:g}, {self.high:g}]: log_uniform numbers are greater than 0"
            )
        if self.distribution == "uniform_cube_root" and self.low < 0.0:
            raise ValueError(
                f"[{self.low:g}, {self.high:g}]: uniform_cube_root numbers are not negative"
            )
        return self

    def numbers(self) -> list[float]:
        """Low, high, and how to sample between them."""
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
    """A factor between 0.1 and 10; its logarithm is uniform unless ``distribution`` says otherwise."""

    low: Annotated[float, Field(ge=0.1, le=10)] = Field(description="the least factor")
    high: Annotated[float, Field(ge=0.1, le=10)] = Field(
        description="the greatest factor, at least low"
    )
    distribution: Literal["uniform", "log_uniform"] = Field(
        default="log_uniform", description="of the factor or its logarithm"
    )


class RandomVector(Frozen):
    """A force or torque at the centre of mass, the same throughout an episode; ``[low, high]`` for
    short.
    """

    magnitude: NonNegativeRange = Field(description="its length, N or N m, or as unit says")
    unit: Literal["SI", "weight"] = Field(
        default="SI",
        description="weight: force in weights m g of the vehicle, torque in weights times its arm length",
    )
    frame: Literal["world", "body"] | None = Field(
        default=None,
        description="the axes it keeps to; left out: a force to the world's, a torque to the body's",
    )
    direction: Vector | None = Field(
        default=None, description="where to; left out: uniformly random"
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
        _check_push(self.magnitude, self.unit)
        return self

    def numbers(self, frame: str) -> list[float]:
        """Numbers in the order of ``VECTOR``; ``frame`` holds if none is given."""
        direction = (
            np.zeros(3)
            if self.direction is None
            else np.array(self.direction) / np.linalg.norm(self.direction)
        )
        marks = float(self.unit == "weight"), float((self.frame or frame) == "body")
        return [*self.magnitude.numbers(), *marks, *direction, *self.axes]


class Gusts(Frozen):
    """A force, or velocity of the air, that wanders: an Ornstein-Uhlenbeck process of each
    component in the world frame.

    Uhlenbeck and Ornstein, "On the theory of the Brownian motion" (Phys. Rev. 36, 1930); the update
    of D. T. Gillespie, "Exact numerical simulation of the Ornstein-Uhlenbeck process" (Phys. Rev. E
    54, 1996), but that what comes to a gust in a control step is no normal number, only as wide as
    one: their sums are normal, over a time constant of many steps. The first gust of an episode is
    normal, too; deviation and time constant are exact, whatever the control step. It is what
    MIL-F-8785C's Dryden model has along the flight path, with the time constant L / V.
    """

    std: NonNegativeRange = Field(
        description="standard deviation of each component, N or as unit says, of wind m/s; sampled per episode"
    )
    unit: Literal["SI", "weight"] = Field(
        default="SI", description="weight: in weights m g of the vehicle"
    )
    time_constant: PositiveFloat = Field(
        default=1.0, le=1e6, description="after which a gust has faded to 1/e, s"
    )

    @model_validator(mode="after")
    def _of_a_quadcopter(self) -> "Gusts":
        _check_push(self.std, self.unit)
        return self


class Randomization(Frozen):
    """What is random in each episode, sampled from the row's own stream when it begins; what is
    left out is not random.

    Factors multiply the vehicle's own parameters and are log-uniform unless they say otherwise.
    Motors and their limits in N stay what they are, so action 0 gives the thrust that the vehicle
    hovers with before it is randomised.
    """

    share: Share = Field(
        default=1.0, description="share of the episodes whose vehicle is randomised"
    )
    mass: Factor | None = Field(
        default=None, description="factor, such as [0.8, 1.25]; the thrusts in N stay"
    )
    inertia: Factor | None = Field(
        default=None,
        description="factor, of Ixx, Iyy and Izz each; none exceeds the sum of the other two",
    )
    motor_gain: Factor | None = Field(default=None, description="factor of k_m (Eq. 4.1)")
    motor_gain_up: Factor | None = Field(
        default=None, description="another, of rotors that speed up"
    )
    motor_gain_down: Factor | None = Field(
        default=None, description="another, of rotors that slow down"
    )
    thrust: Factor | None = Field(
        default=None, description="factor of the thrust of a command, as a tired battery has it"
    )
    arm: Factor | None = Field(
        default=None, description="factor of the rotors' distances from the centre of mass"
    )
    center_of_mass: Offset | None = Field(
        default=None, description="its offset in body x and in y, m, such as [-0.01, 0.01]"
    )
    delay: Range | None = Field(
        default=None,
        description="whole control steps from a command to its effect, such as [0, 3]; log_uniform: short ones more often",
    )
    drag: NonNegativeRange | None = Field(
        default=None,
        description="added to the drag along each body axis, in 1/s times the nominal mass, such as [0, 0.5]",
    )
    wrench_share: Share = Field(
        default=1.0, description="share of the episodes with force, torque, gusts and wind"
    )
    force: RandomVector | None = Field(
        default=None, description="a constant force, such as {magnitude: [0, 5]}, N"
    )
    torque: RandomVector | None = Field(
        default=None, description="a constant torque, such as {magnitude: [0, 0.1]}, N m"
    )
    gusts: Gusts | None = Field(
        default=None, description="a force that wanders, such as {std: [0, 1], time_constant: 1}"
    )
    wind: RandomVector | None = Field(
        default=None,
        description="a constant velocity of the air, m/s, level unless direction says otherwise; needs drag",
    )
    wind_gusts: Gusts | None = Field(
        default=None, description="what comes to it and wanders, such as {std: [0, 1]}, m/s"
    )

    @model_validator(mode="after")
    def _possible(self) -> "Randomization":
        limits = self.delay
        if limits and (
            limits.low < 0 or limits.high > MAX_DELAY or limits.low % 1 or limits.high % 1
        ):
            raise ValueError(
                f"delay [{limits.low:g}, {limits.high:g}]: must be whole control steps of 0 to {MAX_DELAY}"
            )
        marks = [each.unit for each in (self.wind, self.wind_gusts) if each] + [
            self.wind and self.wind.frame
        ]
        if any(mark not in ("SI", None) for mark in marks):
            raise ValueError(
                "wind and wind_gusts: leave out unit and frame; they are velocities, m/s, in the world frame"
            )
        return self

    @property
    def _motor_gains(self) -> tuple[Factor | None, Factor | None, Factor | None]:
        return self.motor_gain, self.motor_gain_up, self.motor_gain_down

    @property
    def sets_vehicle(self) -> bool:
        """Whether an episode begins with a vehicle of its own."""
        changes = (self.mass, self.inertia, *self._motor_gains, self.thrust, self.delay, self.drag)
        return self.sets_arms or any(each is not None for each in changes)

    @property
    def sets_arms(self) -> bool:
        """Whether the rotors of that vehicle are elsewhere."""
        return self.arm is not None or self.center_of_mass is not None

    @property
    def sets_wrench(self) -> bool:
        """Whether an episode begins with a wrench of its own, none included."""
        return self.force is not None or self.torque is not None

    def check(self, vehicle: Vehicle) -> None:
        """Refuse what this vehicle cannot be flown with.

        :raises ConfigError: it could not hover, or its motors would overshoot.
        """
        mass, thrust = (each or Factor(low=1.0, high=1.0) for each in (self.mass, self.thrust))
        least, most = vehicle.thrust_limits
        text = "randomize: with {:g} times its mass and {:g} times its thrust {} cannot hover; its rotors {} times its weight"
        if thrust.low * most <= mass.high:
            raise ConfigError(text.format(mass.high, thrust.low, vehicle.name, f"lift {most:g}"))
        if thrust.high * least > mass.low:
            raise ConfigError(
                text.format(mass.low, thrust.high, vehicle.name, f"give at least {least:g}")
            )
        both, up, down = ((each and each.high) or 1.0 for each in self._motor_gains)
        gain = both * max(vehicle.motor_gain_up * up, vehicle.motor_gain_down * down)
        if gain * vehicle.physics_step > 1.0:
            raise ConfigError(
                f"randomize: motor_gain of {vehicle.name} may reach {gain:g}; times physics_step it may not exceed 1"
            )

    def numbers(self, control_step: float) -> FloatArray:
        """What :mod:`.sampling` reads, in the order of ``RANDOMIZATION``; a share of 0 where no
        vehicle is randomised.
        """
        delay = self.delay and self.delay.model_copy(
            update={"high": self.delay.high + 1.0}
        )  # its whole part is the delay
        ranges = (
            self.mass,
            self.inertia,
            *self._motor_gains,
            self.thrust,
            self.arm,
            self.center_of_mass,
            delay,
            self.drag,
        )
        numbers = [self.share if self.sets_vehicle else 0.0, self.wrench_share]
        for each in ranges:
            numbers += FIXED_NUMBERS if each is None else each.numbers()
        for vector, frame in ((self.force, "world"), (self.torque, "body"), (self.wind, "world")):
            numbers += [*FIXED_NUMBERS, *[0.0] * 8] if vector is None else vector.numbers(frame)
        by_weight = float(self.gusts is not None and self.gusts.unit == "weight")
        gusts, wind_gusts = (
            [*each.std.numbers(), math.exp(-control_step / each.time_constant)]
            if each
            else [*FIXED_NUMBERS, 0.0]
            for each in (self.gusts, self.wind_gusts)
        )
        return np.array([*numbers, *gusts, by_weight, *wind_gusts])


def _check_push(numbers: Range, unit: str) -> None:
    if numbers.high > MAX_PUSH[unit]:
        raise ValueError(f"{numbers.high:g} ({unit}): must be at most {MAX_PUSH[unit]:g}")


@compiled
def between(table, k, u, nominal):
    """The number that u in (0, 1) stands for in the range at ``table[k : k + 3]``; ``nominal`` if
    the range is FIXED.
    """
    low, high, kind = table[k], table[k + 1], table[k + 2]
    if kind == FIXED:
        return nominal
    if kind == CUBE_ROOT:
        return (low ** (1.0 / 3.0) + (high ** (1.0 / 3.0) - low ** (1.0 / 3.0)) * u) ** 3
    return (
        low * math.exp(u * math.log(high / low)) if kind == LOG_UNIFORM else low + (high - low) * u
    )
