"""Domain randomization: how the vehicle of an episode differs from its model, and which
disturbances act on it.

A :class:`Randomization` is data, ``randomize`` in ``env_kwargs``; :mod:`.sampling` samples from it.
"""

import math
from collections.abc import Mapping
from typing import Annotated, Any, Generic, Literal, TypeVar

import numpy as np
from pydantic import (
    Field,
    NonNegativeFloat,
    PositiveFloat,
    ValidationError,
    field_validator,
    model_validator,
)

from sb3_quad.base.compiled import called
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.types import FloatArray, StrDict, StrMapping
from sb3_quad.base.validate import Frozen, explain
from sb3_quad.envs.simulation.state import first_rows, row_slices
from sb3_quad.envs.vehicles.rates import LARGEST_LAG
from sb3_quad.envs.vehicles.vehicle import Vehicle

# The kinds of range; a FIXED one samples nothing. Its numbers, like all that are not given, are 0.
FIXED, UNIFORM, LOG_UNIFORM, CUBE_ROOT = range(4)
_KINDS = {"uniform": UNIFORM, "log_uniform": LOG_UNIFORM, "uniform_cube_root": CUBE_ROOT}
# Numbers of a range: low, high and kind
RANGE = 3
Share = Annotated[float, Field(ge=0, le=1)]
AxisFactor = Annotated[float, Field(ge=0, le=10)]
MAX_DELAY = 100  # control steps
Vector = tuple[float, float, float]
Unit = Literal["SI", "weight"]
VECTOR = {"length": RANGE, "by_weight": 1, "in_body": 1, "direction": 3, "axes": 3}
V = first_rows(VECTOR)
GUST = {"std": RANGE, "keeps": 1, "by_weight": 1}
GUST_NUMBERS = first_rows(GUST)
Bounded = TypeVar("Bounded", bound=float)


class Range(Frozen, Generic[Bounded]):
    """Numbers from ``low`` to ``high``. You may write ``[low, high]``, or one number."""

    low: Bounded
    """the least number"""
    high: Bounded
    """the greatest number, at least low"""
    distribution: Literal["uniform", "log_uniform", "uniform_cube_root"] = "uniform"
    """distribution of the number, of its logarithm (low > 0), or of its cube root"""

    @model_validator(mode="before")
    @classmethod
    def _from_shorthand(cls, data: Any) -> Any:
        if isinstance(data, (int, float)) and not isinstance(data, bool):
            return {"low": data, "high": data}
        if isinstance(data, (list, tuple)):
            if len(data) != 2:
                raise ValueError(f"{list(data)!r}: must be [low, high]")
            low, high = data
            return {"low": low, "high": high}
        return data

    @model_validator(mode="after")
    def _check_order(self) -> "Range[Bounded]":
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


NonNegativeRange = Range[NonNegativeFloat]
PositiveRange = Range[Annotated[float, Field(ge=1e-9)]]
MAX_WEIGHTS = 100.0  # the greatest force or torque in multiples of a weight
# N, N m or m/s, or multiples of a weight
Magnitude = Range[Annotated[float, Field(ge=0, le=1e4)]]
Offset = Range[Annotated[float, Field(ge=-1, le=1)]]  # m
Battery = Range[Annotated[float, Field(ge=0.1, le=1)]]
Delay = Range[Annotated[float, Field(ge=0, le=MAX_DELAY, multiple_of=1)]]
RateLag = Range[Annotated[float, Field(ge=0, le=LARGEST_LAG)]]


Turning = Range[Annotated[float, Field(ge=-1e4, le=1e4)]]
RotorShare = Range[Annotated[float, Field(ge=0, le=1)]]


class Factor(Range[Annotated[float, Field(ge=0.1, le=10)]]):
    """A factor between 0.1 and 10, log-uniform unless ``distribution`` says otherwise."""

    distribution: Literal["uniform", "log_uniform"] = "log_uniform"
    """distribution of the factor or of its logarithm"""


UNCHANGED = Factor(low=1.0, high=1.0)
AIR_TERMS = (
    "rotors",
    "rotor_drag",
    "translational_lift",
    "airspeed_moment",
    "rate_damping",
    "rotor_inertia",
    "ground_effect_radius",
)


class RandomVector(Frozen):
    """A force or torque at the centre of mass, or a wind, constant during an episode.

    You may write ``[low, high]`` for its magnitude alone.
    """

    magnitude: Magnitude
    """its length, N, N m or m/s; or in the unit that unit names"""
    unit: Unit = "SI"
    """weight: a force in multiples of the weight m g, a torque in those of m g times the arm length
    """
    frame: Literal["world", "body"] | None = None
    """frame in which it is constant; default: world for a force, body for a torque"""
    direction: Vector | None = None
    """its direction; default: uniformly random"""
    axes: tuple[AxisFactor, AxisFactor, AxisFactor] = (1.0, 1.0, 1.0)
    """factor of each component, such as [1, 1, 0] for a horizontal one"""

    @model_validator(mode="before")
    @classmethod
    def _from_shorthand(cls, data: Any) -> Any:
        return {"magnitude": data} if isinstance(data, (list, tuple, int, float)) else data

    @model_validator(mode="after")
    def _check_magnitude(self) -> "RandomVector":
        _check_weights(self.magnitude, self.unit)
        return self

    @field_validator("direction")
    @classmethod
    def _check_direction(cls, value: Vector | None) -> Vector | None:
        if value is not None and not any(value):
            raise ValueError("direction must not be zero")
        return value

    def numbers(self) -> list[float]:
        """Return numbers in the order of ``VECTOR``."""
        direction = np.zeros(3)
        if self.direction is not None:
            direction = np.array(self.direction) / np.linalg.norm(self.direction)
        units = [self.unit == "weight", self.frame == "body"]
        return [*self.magnitude.numbers(), *units, *direction, *self.axes]


class Gusts(Frozen):
    """A force, or velocity of the air, that changes at random: each component in the world frame is
    an Ornstein-Uhlenbeck process.

    Uhlenbeck and Ornstein, "On the theory of the Brownian motion" (Phys. Rev. 36, 1930). The update
    is that of D. T. Gillespie, "Exact numerical simulation of the Ornstein-Uhlenbeck process"
    (Phys. Rev. E 54, 1996), with one difference: the increment of a control step has the variance
    of a normal number but is not one. A sum of many increments is normal, and a time constant is
    many steps. The first gust of an episode is normal. Deviation and time constant are exact for
    any control step. MIL-F-8785C's Dryden model is this process along the flight path, with the
    time constant L / V.
    """

    std: Magnitude
    """standard deviation of each component, N, or m/s of wind; sampled per episode"""
    unit: Unit = "SI"
    """weight: in multiples of the vehicle's weight m g"""
    time_constant: PositiveFloat = Field(default=1.0, le=1e6)
    """time after which a gust has faded to 1/e, s"""

    @model_validator(mode="after")
    def _check_std(self) -> "Gusts":
        _check_weights(self.std, self.unit)
        return self

    def numbers(self, control_step: float) -> list[float]:
        """Return numbers in the order of ``GUST``.

        :param control_step: s, for the share of a gust that is left after it.
        """
        keeps = math.exp(-control_step / self.time_constant)
        return [*self.std.numbers(), keeps, self.unit == "weight"]


def _check_weights(magnitude: Magnitude, unit: Unit) -> None:
    if unit == "weight" and magnitude.high > MAX_WEIGHTS:
        raise ValueError(f"{magnitude.high:g} (weight): must be at most {MAX_WEIGHTS:g}")


class Randomization(Frozen):
    """The dynamics and disturbances that are random, sampled for each episode from the row's own
    stream. Fields that you do not give are not random.

    Factors multiply the vehicle's own parameters and are log-uniform unless they say otherwise. The
    thrust limits in N do not follow the mass, so action 0 commands the thrust with which the
    vehicle hovers before randomization.
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
    battery: Battery | None = None
    """factor of the greatest rotor thrust only, such as [0.85, 1]: a falling battery voltage that
    the firmware compensates as long as it can; see saturation of Vehicle
    """
    arm: Factor | None = None
    """factor of the rotors' distances from the centre of mass"""
    center_of_mass: Offset | None = None
    """its offset in body x and in y, m, such as [-0.01, 0.01]"""
    delay: Delay | None = None
    """whole control steps from a command to its effect, such as [0, 3]"""
    drag: NonNegativeRange | None = None
    """added drag along each body axis, 1/s times the nominal mass, such as [0, 0.5]"""
    rotors: Factor | None = None
    """factor of the thrust and drag moment of each rotor by itself, such as [0.7, 1.15]"""
    rotor_drag: NonNegativeRange | None = None
    """rotor drag along each body axis in hover, 1/s times the nominal mass, in place of the
    vehicle's own, as the next five are
    """
    translational_lift: NonNegativeRange | None = None
    """force along body z, 1/m times the nominal mass, such as [0, 0.02]"""
    airspeed_moment: Turning | None = None
    """angular acceleration by airspeed in hover, of roll and of pitch, rad/s² for each m/s, such as
    [-2, 10]; positive numbers raise the nose in forward flight
    """
    rate_damping: NonNegativeRange | None = None
    """damping of each body rate, 1/s times the nominal inertia, such as [0, 8]"""
    rotor_inertia: RotorShare | None = None
    """of a rotor about its axis, times Izz, such as [0, 0.01]"""
    ground_effect_radius: NonNegativeRange | None = None
    """R of the ground effect in arm lengths, such as [0, 1]"""
    wrench_share: Share = 1.0
    """fraction of the episodes with force, torque, gusts and wind"""
    force: RandomVector | None = None
    """a constant force, such as {magnitude: [0, 5]}, N"""
    torque: RandomVector | None = None
    """a constant torque, such as {magnitude: [0, 0.1]}, N m"""
    gusts: Gusts | None = None
    """a random force, such as {std: [0, 1], time_constant: 1}"""
    wind: RandomVector | None = None
    """velocity of the air, m/s, horizontal unless it has a direction; acts on vehicles with drag"""
    wind_gusts: Gusts | None = None
    """a random velocity added to the wind, such as {std: [0, 1]}, m/s"""
    rate_gains: Factor | None = None
    """factors of the rate loop's gains, one of roll and pitch and one of yaw, such as [0.5, 2]"""
    rate_lag: RateLag | None = None
    """added lag of the rate loop, s, such as [0, 0.02]"""

    @model_validator(mode="after")
    def _check_wind(self) -> "Randomization":
        for wind in (self.wind, self.wind_gusts):
            if wind is not None and (wind.unit != "SI" or getattr(wind, "frame", None)):
                raise ValueError(
                    "wind and wind_gusts: remove unit and frame;"
                    " they are velocities, m/s, in the world frame"
                )
        return self

    @property
    def sets_vehicle(self) -> bool:
        """Whether each episode may begin with another vehicle."""
        return any(isinstance(given, Range) for _, given in self)

    @property
    def sets_air(self) -> bool:
        """Whether it samples a term of :mod:`.aerodynamics`."""
        return any(getattr(self, name) is not None for name in AIR_TERMS)

    @property
    def sets_wrench(self) -> bool:
        """Whether each episode begins with a new wrench, which may be zero."""
        return self.force is not None or self.torque is not None

    def hardest(self, vehicle: Vehicle) -> Vehicle:
        """Return the vehicle with the narrowest thrust limits and the fastest motors that may be
        sampled. If it can fly, all can.

        :raises ConfigError: it cannot fly.
        """
        least, most = vehicle.thrust_limits
        mass = self.mass or UNCHANGED
        thrust = self.thrust or UNCHANGED
        rotors = self.rotors or UNCHANGED
        greatest = thrust.low * (self.battery or UNCHANGED).low * rotors.low
        gain = (self.motor_gain or UNCHANGED).high
        up = gain * (self.motor_gain_up or UNCHANGED).high
        down = gain * (self.motor_gain_down or UNCHANGED).high
        changes: StrDict = {
            "thrust_limits": (
                least * thrust.high * rotors.high / mass.low,
                most * greatest / mass.high,
            ),
            "motor_gain_up": vehicle.motor_gain_up * up,
            "motor_gain_down": vehicle.motor_gain_down * down,
        }
        if self.rate_damping is not None:
            most = self.rate_damping.high / (self.inertia or UNCHANGED).low
            changes["rate_damping"] = tuple(most * each for each in vehicle.inertia)
        return flyable(vehicle, changes, "randomize")

    def numbers(self, control_step: float) -> FloatArray:
        """Return the numbers that :mod:`.sampling` reads, in the order of ``RANDOMIZATION``.

        :param control_step: s.
        """
        table = numbers_of(self, RANDOMIZATION, control_step)
        table[R.share] *= self.sets_vehicle
        if self.torque is not None and self.torque.frame is None:
            table[R.torque + V.in_body] = 1.0
        # floor(uniform(low, high + 1)) makes every whole number equally likely.
        table[R.delay + 1] += 1.0
        return table


RANDOMIZATION = dict.fromkeys(Randomization.model_fields, RANGE) | {
    "share": 1,
    "wrench_share": 1,
    **dict.fromkeys(("force", "torque", "wind"), sum(VECTOR.values())),
    **dict.fromkeys(("gusts", "wind_gusts"), sum(GUST.values())),
}
"""Numbers of :meth:`Randomization.numbers`."""
R = first_rows(RANDOMIZATION)


def numbers_of(record: Frozen, sizes: Mapping[str, int], control_step: float = 0.0) -> FloatArray:
    """Return the numbers of a record one after the other, (sum of sizes,); 0 if none are given.

    :param sizes: how many numbers each field is, in their order.
    :param control_step: s, of gusts.
    """
    row = np.zeros(sum(sizes.values()))
    for name, place in row_slices(sizes).items():
        given = getattr(record, name)
        if isinstance(given, Gusts):
            given = given.numbers(control_step)
        elif isinstance(given, (Range, RandomVector)):
            given = given.numbers()
        if given is not None:
            row[place] = given
    return row


def flyable(base: Vehicle, changes: StrMapping, where: str) -> Vehicle:
    """Return a changed vehicle.

    :param where: what changes it, for the error message.
    :raises ConfigError: it cannot fly.
    """
    try:
        return base.model_copy(update=changes)
    except ValidationError as error:
        reason = explain(error)
        raise ConfigError(f"{where}: some vehicles could not fly ({reason})") from None


@called
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
