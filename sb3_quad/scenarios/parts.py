"""What a scenario is made of: start, target, wrenches, the vehicle's changes. Units SI, angles in degrees where said."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from sb3_quad.base.errors import unknown
from sb3_quad.base.quantities import Finite
from sb3_quad.vehicles.vehicle import Vehicle

Vector = tuple[Finite, Finite, Finite]
NotNegative = Annotated[Finite, Field(ge=0)]
Positive = Annotated[Finite, Field(gt=0)]
Frame = Literal["world", "body"]


class Part(BaseModel):
    """Base of all parts: frozen, and unknown keys are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid")


def _exactly_one(part: Part, names: tuple[str, ...]) -> None:
    given = [name for name in names if getattr(part, name) is not None]
    if len(given) != 1:
        raise ValueError(f"give exactly one of {', '.join(names)}" + (f", not {' and '.join(given)}" if given else ""))


class Draw(Part):
    """A vector: fixed, written as ``[x, y, z]``, or drawn anew for each episode.

    ``{std: 2}`` is normal in each component, ``{magnitude: 3}`` has that length and a uniformly random direction.
    """

    value: Vector | None = Field(default=None, description="the vector itself, in the unit of what it is for")
    std: NotNegative | None = Field(default=None, description="standard deviation of each component, in the same unit")
    magnitude: NotNegative | None = Field(default=None, description="length, in the same unit; the direction is random")

    @model_validator(mode="before")
    @classmethod
    def _from_list(cls, data: Any) -> Any:
        return {"value": data} if isinstance(data, (list, tuple)) else data

    @model_validator(mode="after")
    def _one(self) -> Draw:
        _exactly_one(self, ("value", "std", "magnitude"))
        return self

    @property
    def largest(self) -> float:
        """The greatest length that is likely: for ``std``, three standard deviations in each component."""
        if self.value is not None:
            return math.hypot(*self.value)
        return self.magnitude if self.magnitude is not None else 3.0 * math.sqrt(3.0) * (self.std or 0.0)


ZERO = Draw(value=(0.0, 0.0, 0.0))


class Attitude(Part):
    """The attitude at the start: ``level``, ``uniform`` on SO(3), ``{quaternion: [w, x, y, z]}`` or ``{tilt: 60}``."""

    quaternion: tuple[Finite, Finite, Finite, Finite] | None = Field(
        default=None, description="w, x, y, z, body to world; is normalised"
    )
    tilt: Annotated[Finite, Field(ge=0, le=180)] | None = Field(
        default=None, description="angle between body z and world z, deg; about a random horizontal axis"
    )
    distribution: Literal["uniform"] | None = Field(default=None, description="uniform on SO(3), as in state recovery")

    @model_validator(mode="before")
    @classmethod
    def _from_word(cls, data: Any) -> Any:
        if data == "level":
            return {"tilt": 0.0}
        if data == "uniform":
            return {"distribution": "uniform"}
        if isinstance(data, str):
            raise ValueError(f"{unknown('attitude', data, ('level', 'uniform'))}, or {{quaternion: …}}, or {{tilt: …}}")
        return {"quaternion": data} if isinstance(data, (list, tuple)) else data

    @model_validator(mode="after")
    def _one(self) -> Attitude:
        _exactly_one(self, ("quaternion", "tilt", "distribution"))
        return self

    @field_validator("quaternion")
    @classmethod
    def _not_zero(cls, value: tuple[float, float, float, float] | None) -> tuple[float, float, float, float] | None:
        if value is not None and math.hypot(*value) < 1e-6:
            raise ValueError("must not be zero")
        return value


class Start(Part):
    """Where and how an episode starts; rotors turn at hover speed."""

    position: Vector = Field(default=(0.0, 0.0, 15.0), description="r0, world frame, m")
    attitude: Attitude = Field(default=Attitude(tilt=0.0), description="level, uniform, {quaternion: …} or {tilt: deg}")
    velocity: Draw = Field(default=ZERO, description="world frame, m/s: [x, y, z], {std: …} or {magnitude: …}")
    body_rates: Draw = Field(default=ZERO, description="body frame, rad/s: [x, y, z], {std: …} or {magnitude: …}")

    @field_validator("body_rates")
    @classmethod
    def _radians(cls, value: Draw) -> Draw:
        if value.largest > 200.0:
            raise ValueError(f"{value.largest:g} is beyond 200 rad/s; the unit is rad/s, not deg/s")
        return value

    @field_validator("velocity")
    @classmethod
    def _metres_per_second(cls, value: Draw) -> Draw:
        if value.largest > 100.0:
            raise ValueError(f"{value.largest:g} is beyond 100 m/s; the unit is m/s")
        return value


class Target(Part):
    """Where to fly: ``[x, y, z]``, ``{distance: 10}`` in a random direction, or ``{waypoints: [[x, y, z], …]}``."""

    position: Vector | None = Field(default=None, description="r_T, world frame, m")
    distance: NotNegative | None = Field(
        default=None, description="from the start in a uniformly random direction above ground, m; 0: the start itself"
    )
    waypoints: tuple[Vector, ...] | None = Field(
        default=None, min_length=1, description="targets one after the other, world frame, m"
    )
    radius: Positive | None = Field(
        default=None, description="the next waypoint is the target once |r - r_T| is within this, m (0.5)"
    )

    @model_validator(mode="before")
    @classmethod
    def _from_list(cls, data: Any) -> Any:
        return {"position": data} if isinstance(data, (list, tuple)) else data

    @model_validator(mode="after")
    def _one(self) -> Target:
        _exactly_one(self, ("position", "distance", "waypoints"))
        if self.radius is not None and self.waypoints is None:
            raise ValueError("radius goes with waypoints; the tolerances of a single target are the scenario's tolerances")
        return self

    @property
    def points(self) -> tuple[Vector, ...]:
        """The fixed targets, in order; none if the target is drawn."""
        return self.waypoints if self.waypoints is not None else () if self.position is None else (self.position,)

    @property
    def switching_radius(self) -> float:
        """The radius within which a waypoint counts as reached, m."""
        return 0.5 if self.radius is None else self.radius


class Wrench(Part):
    """An external force and torque at the centre of mass for some time; those that overlap add up."""

    start: NotNegative = Field(default=0.0, description="when it begins, s")
    duration: Positive | None = Field(default=None, description="how long it acts, s; left out: to the end")
    force: Draw = Field(default=ZERO, description="N: [x, y, z], {std: …} or {magnitude: …}")
    torque: Draw = Field(default=ZERO, description="N m: [x, y, z], {std: …} or {magnitude: …}")
    force_frame: Frame = Field(default="world", description="world or body: the axes of force")
    torque_frame: Frame = Field(default="body", description="world or body: the axes of torque")


class VehicleChanges(Part):
    """How the vehicle that flies differs from the one its controller was made for; motors and limits stay what they are."""

    mass: Positive = Field(default=1.0, description="factor of the mass; thrust limits in N stay")
    inertia: Positive | tuple[Positive, Positive, Positive] = Field(
        default=1.0, description="factor of Ixx, Iyy and Izz, or one for each"
    )
    motor_gain: Positive = Field(default=1.0, description="factor of k_m (Eq. 4.1)")
    delay: Annotated[int, Field(ge=0, le=100)] | None = Field(
        default=None, description="control steps from a command to its effect; left out: the vehicle's own"
    )

    @field_validator("mass", "motor_gain")
    @classmethod
    def _factor(cls, value: float) -> float:
        if not 0.1 <= value <= 10.0:
            raise ValueError(f"{value:g} is a factor, from 0.1 to 10: 1.3 is 30 % more than the vehicle's own")
        return value

    def apply(self, vehicle: Vehicle) -> Vehicle:
        """The changed vehicle.

        Rotor thrusts in N answer actions as before: the limits, which a vehicle gives in hover thrusts of its own mass
        (Eq. 3.18), are divided by the mass factor, so that action 0 is the hover of the unchanged vehicle.

        :raises ValueError: no such vehicle can fly, for example one too heavy for its rotors.
        """
        if self == VehicleChanges():
            return vehicle
        factors = (self.inertia,) * 3 if isinstance(self.inertia, float) else self.inertia
        low, high = vehicle.thrust_limits
        return vehicle.model_copy(
            update={
                "mass": vehicle.mass * self.mass,
                "inertia": tuple(own * factor for own, factor in zip(vehicle.inertia, factors, strict=True)),
                "thrust_limits": (low / self.mass, high / self.mass),
                "motor_gain": vehicle.motor_gain * self.motor_gain,
                "delay": vehicle.delay if self.delay is None else self.delay,
            }
        )
