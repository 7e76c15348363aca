"""The parts of a scenario: start, target, wrenches, changes of the vehicle. Units are SI, angles in
degrees where noted.
"""

import math
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, field_validator, model_validator

from sb3_quad.base.errors import unknown
from sb3_quad.base.validate import Frozen
from sb3_quad.envs.simulation.randomization import flyable
from sb3_quad.envs.vehicles.vehicle import Vehicle

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Frame = Literal["world", "body"]
Factor = Annotated[float, Field(ge=0.1, le=10)]


class OneOf(Frozen):
    """A part that can be given in several ways, of which a file uses exactly one. A list means the
    first.
    """

    ways: ClassVar[tuple[str, ...]]

    @model_validator(mode="before")
    @classmethod
    def _from_list(cls, data: Any) -> Any:
        if isinstance(data, (list, tuple)):
            return {cls.ways[0]: data}
        return data

    @model_validator(mode="after")
    def _exactly_one(self) -> "OneOf":
        given = [name for name in self.ways if getattr(self, name) is not None]
        if len(given) != 1:
            names_given = " and ".join(given) or "none"
            raise ValueError(f"give exactly one of {', '.join(self.ways)}, not {names_given}")
        return self


class VectorDistribution(OneOf):
    """A vector: fixed, written as ``[x, y, z]``, or sampled for each episode.

    ``{std: 2}`` is normal in each component, ``{magnitude: 3}`` has that length and a uniformly
    random direction.
    """

    ways = ("value", "std", "magnitude")

    value: Vector | None = None
    """the vector itself, in the unit of the quantity"""
    std: NonNegativeFloat | None = None
    """standard deviation of each component, in the same unit"""
    magnitude: NonNegativeFloat | None = None
    """length, in the same unit; the direction is random"""


ZERO = VectorDistribution(value=(0.0, 0.0, 0.0))


class Attitude(OneOf):
    """The attitude at the start: ``level``, ``uniform`` on SO(3), ``{quaternion: [w, x, y, z]}`` or
    ``{tilt: 60}``.
    """

    ways = ("quaternion", "tilt", "distribution")

    quaternion: Quaternion | None = None
    """w, x, y, z, body to world; is normalised"""
    tilt: float | None = Field(default=None, ge=0, le=180)
    """angle between body z and world z, deg; about a random horizontal axis"""
    distribution: Literal["uniform"] | None = None
    """uniform on SO(3), as in state recovery"""

    @model_validator(mode="before")
    @classmethod
    def _from_word(cls, data: Any) -> Any:
        words = {"level": {"tilt": 0.0}, "uniform": {"distribution": "uniform"}}
        if not isinstance(data, str):
            return data
        if data not in words:
            raise ValueError(
                f"{unknown('attitude', data, words)}, or {{quaternion: …}}, or {{tilt: …}}"
            )
        return words[data]

    @field_validator("quaternion")
    @classmethod
    def _not_zero(cls, value: Quaternion | None) -> Quaternion | None:
        if value is not None and math.hypot(*value) < 1e-6:
            raise ValueError("must not be zero")
        return value


class Start(Frozen):
    """Where and how an episode starts; rotors turn at hover speed."""

    position: Vector = (0.0, 0.0, 15.0)
    """r0, world frame, m"""
    attitude: Attitude = Attitude(tilt=0.0)
    """level, uniform, {quaternion: …} or {tilt: deg}"""
    velocity: VectorDistribution = ZERO
    """m/s: [x, y, z], {std: …} or {magnitude: …}"""
    velocity_frame: Frame = "world"
    """world or body: the axes of velocity"""
    body_rates: VectorDistribution = ZERO
    """body frame, rad/s: in the same forms as velocity"""

    @model_validator(mode="after")
    def _turnable(self) -> "Start":
        fixed = self.velocity.value is not None and self.attitude.distribution is None
        if self.velocity_frame == "body" and not fixed:
            raise ValueError(
                "velocity_frame: body needs a fixed velocity and an attitude that is not uniform"
            )
        return self


class Target(OneOf):
    """Where to fly: ``[x, y, z]``, ``{distance: 10}`` in a random direction, or ``{waypoints: [[x,
    y, z], …]}``.
    """

    ways = ("position", "distance", "waypoints")

    position: Vector | None = None
    """r_T, world frame, m"""
    distance: NonNegativeFloat | None = None
    """from the start in a uniformly random direction above ground, m; 0: the start itself"""
    waypoints: tuple[Vector, ...] | None = Field(default=None, min_length=1)
    """targets one after the other, world frame, m"""
    radius: PositiveFloat = 0.5
    """a waypoint counts as reached within this, m"""

    @model_validator(mode="after")
    def _radius_of_waypoints(self) -> "Target":
        # A scenario that was read before has the default.
        if self.waypoints is None and self.radius != Target.model_fields["radius"].default:
            raise ValueError("radius: is that of waypoints; remove it, or give tolerances")
        return self

    @property
    def points(self) -> tuple[Vector, ...]:
        """The fixed targets, in order; none if the target is random."""
        if self.position is not None:
            return (self.position,)
        return self.waypoints or ()


class Wrench(Frozen):
    """An external force and torque at the centre of mass for some time; several add up."""

    start: NonNegativeFloat = 0.0
    """when it begins, s"""
    duration: PositiveFloat | None = None
    """how long it acts, s; default: to the end"""
    force: VectorDistribution = ZERO
    """N, or as unit says: [x, y, z], {std: …} or {magnitude: …}"""
    torque: VectorDistribution = ZERO
    """N m, or as unit says: in the same forms as force"""
    unit: Literal["SI", "weight"] = "SI"
    """weight: force in multiples of the vehicle's weight m g, torque in those of m g times its arm
    length
    """
    factor: float = 1.0
    """multiplies force and torque, to vary the size of a hit"""
    force_frame: Frame = "world"
    """world or body: the axes of force"""
    torque_frame: Frame = "body"
    """world or body: the axes of torque"""

    def units(self, vehicle: Vehicle) -> tuple[float, float]:
        """The units of force, N, and torque, N m, on a vehicle before its changes."""
        weight = vehicle.mass * vehicle.gravity
        if self.unit == "SI":
            return 1.0, 1.0
        return weight, weight * vehicle.arm_length


class VehicleChanges(Frozen):
    """Differences between the vehicle that flies and the one its controller was made for.

    Motors and limits stay as they are.
    """

    mass: Factor = 1.0
    """factor: 1.3 is 30 % more; thrust limits in N do not change"""
    inertia: PositiveFloat | tuple[PositiveFloat, PositiveFloat, PositiveFloat] = 1.0
    """factor of Ixx, Iyy and Izz, or one for each"""
    motor_gain: Factor = 1.0
    """factor of k_m (Eq. 4.1): 1.3 is 30 % more"""
    delay: int | None = Field(default=None, ge=0, le=100)
    """control steps from a command to its effect; default: the vehicle's own"""

    def apply(self, vehicle: Vehicle) -> Vehicle:
        """The changed vehicle.

        Actions command the same rotor thrusts in N as before: the limits, which are in hover
        thrusts of the vehicle's own mass (Eq. 3.18), are divided by the mass factor, so that action
        0 is hover of the unchanged vehicle.

        :raises ConfigError: it cannot fly, for example because it is too heavy for its rotors.
        """
        if self == VehicleChanges():
            return vehicle
        changes = {
            "mass": vehicle.mass * self.mass,
            "inertia": np.multiply(vehicle.inertia, self.inertia).tolist(),
            "thrust_limits": np.divide(vehicle.thrust_limits, self.mass).tolist(),
            "motor_gain_up": vehicle.motor_gain_up * self.motor_gain,
            "motor_gain_down": vehicle.motor_gain_down * self.motor_gain,
        }
        if self.delay is not None:
            changes["delay"] = self.delay
        return flyable(vehicle, changes, "vehicle_changes")
