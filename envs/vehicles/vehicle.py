"""Vehicles: validated parameters of one quadcopter, derived values, and their YAML files."""

import math
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from sb3_quad.base.errors import CannotHover, ConfigError
from sb3_quad.base.process import print_once
from sb3_quad.base.types import FloatArray, StrDict, StrMapping, StrPath
from sb3_quad.base.validate import LARGEST, Frozen, Quantity, check, validate
from sb3_quad.base.yaml_files import YamlFolder
from sb3_quad.envs.vehicles.gains import GeometricGains
from sb3_quad.envs.vehicles.layout import NamedLayout, Turn, find_turn
from sb3_quad.envs.vehicles.rates import (
    LEAST_DERIVED_LIMITS,
    RATE_PARAMETERS,
    RateLoop,
    derived_gain,
    derived_limit,
)

VEHICLES = YamlFolder("vehicle", "sb3_quad.envs.vehicles")
# Physics steps in a control step.
MAX_SUBSTEPS = 1000
GRAVITY = 9.81  # m/s²; 1 g
# Published moments of inertia are inaccurate: the largest may be this many times the other two.
INACCURACY = 1.05
# If kF is unknown, this is the speed of a rotor with a thrust of m g / 4, rad/s.
HOVER_SPEED = 1000.0
# Upper bounds of gain times physics step: Eq. 4.1 overshoots beyond 1; the approximation of the
# exponential in turn_rotors is 1 % short at 2, and worse beyond.
LARGEST_STEP = {"euler": 1.0, "exact": 2.0}
# Up to this step, s, the compiled rotation is exact.
MAX_PHYSICS_STEP = 0.0025
_NAMES = """
    mass ixx iyy izz thrust_coefficient motor_gain_up motor_gain_down exact_motors gravity
    drag_x drag_y drag_z hover_thrust thrust_middle thrust_half_range battery
    shared_saturation collision_radius delay
    roll_arm_0 roll_arm_1 roll_arm_2 roll_arm_3
    pitch_arm_0 pitch_arm_1 pitch_arm_2 pitch_arm_3
    yaw_arm_0 yaw_arm_1 yaw_arm_2 yaw_arm_3
    hover_share_0 hover_share_1 hover_share_2 hover_share_3
    rotor_drag_x rotor_drag_y rotor_drag_z translational_lift
    airspeed_moment_roll airspeed_moment_pitch rate_damping_x rate_damping_y rate_damping_z
    rotor_inertia ground_effect_radius
    thrust_factor_0 thrust_factor_1 thrust_factor_2 thrust_factor_3
    """
# The parameters of a vehicle that the compiled kernel needs: the rows of an array (parameters, n),
# in the order of Vehicle.parameters(). Those from rotor_drag_x on, for the most part of
# simulation/aerodynamics.py, are loaded where a vehicle needs them.
PARAMETER_NAMES = (*_NAMES.split(), *RATE_PARAMETERS)
# A name is a part of file names, and of what reports and exported files say.
# Of blanks, it may hold the space alone, since others end a line.
NAME = r"^([^/\\<>\p{C}\p{Z}]| ){1,100}$"
NonNegative = Annotated[float, Field(ge=0.0, le=LARGEST)]
Limits = tuple[NonNegative, Quantity]
ByAxis = tuple[NonNegative, NonNegative, NonNegative]
# Below, nothing spins up or falls within a flight.
Rate = Annotated[float, Field(ge=0.01, le=LARGEST)]
Moment = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
ThrustFactor = Annotated[float, Field(ge=0.1, le=10.0)]
Coordinate = Annotated[float, Field(ge=-1000.0, le=1000.0)]
Place = tuple[Coordinate, Coordinate]
# Radii of gyration by the rotors' distance from the centre; beyond, an inertia has another unit.
GYRATION_RATIOS = (1e-4, 1e3)
MOTOR_GAINS = ("motor_gain_up", "motor_gain_down")
CONTROL_STEP = 0.01  # s
LIMITS = ("thrust_limits", "rotor_thrust_limits", "rotor_speed_limits")
_NO_LIMITS = (0.0, 0.0)
_EQUAL = (1.0, 1.0, 1.0, 1.0)
# Results of a search, which are valid for one vehicle only
_FOUND = ("geometric_gains", "time_optimal")


class Vehicle(Frozen):
    """The parameters of one quadcopter, and the values that follow from them.

    They include those of thesis 4.1.1. The rotors' limits may be given as they are published:
    instead of ``thrust_limits``, in hover thrusts, ``rotor_thrust_limits`` in N or
    ``rotor_speed_limits`` in rad/s. These become ``thrust_limits``, which a copy with another mass
    keeps, and are None. ``motor_gain`` stands for ``motor_gain_up`` and ``motor_gain_down`` if both
    are the same, ``latency``, in seconds, for ``delay``, and ``rotor_order`` with ``arm_length``
    for the rotors' positions and directions.

    It is frozen: ``vehicle.model_copy(update={"mass": 2.0})`` makes another, validated as well.
    :func:`load_vehicle` raises :class:`ConfigError`; the class itself raises pydantic's
    ``ValidationError``.
    """

    short_keys: ClassVar = ("motor_gain", "latency", *NamedLayout.model_fields)

    name: str = Field(pattern=NAME)
    """what the vehicle is called; up to 100 characters, none of / \\ < > or control"""
    mass: Quantity
    """m, kg"""
    inertia: tuple[Quantity, Quantity, Quantity]
    """Ixx, Iyy, Izz of the diagonal inertia, kg m^2"""
    allow_impossible_inertia: bool = False
    """whether to fly an inertia that no rigid body has, by more than 5 %"""
    rotor_positions: tuple[Place, Place, Place, Place]
    """x, y of each rotor from the centre of mass (x forward, y left), m; or give rotor_order"""
    rotor_directions: tuple[int, int, int, int]
    """sign of the yaw moment of each rotor: two of 1, two of -1"""
    moment_thrust_ratio: Quantity
    """kM / kF, m"""
    thrust_coefficient: NonNegative = 0.0
    """kF, N s^2, in F = kF ω^2 (Eq. 2.4); 0 if unknown: the rotors then hover at 1,000 rad/s"""
    motor_gain_up: Rate
    """k_m of a rotor that speeds up, 1/s (Eq. 4.1)"""
    motor_gain_down: Rate
    """k_m of a rotor that slows down, 1/s"""
    motor_integration: Literal["euler", "exact"] = "euler"
    """euler: Eq. 4.1 as printed; exact: the exponential, and the thrust at the middle of a step"""
    drag: ByAxis = (0.0, 0.0, 0.0)
    """d of the drag -d (v - wind) along each body axis, N s/m (Faessler et al. 2018)"""
    rotor_drag: ByAxis = (0.0, 0.0, 0.0)
    """k of the drag -k Σω (v - wind) along each body axis, with the sum of the rotor speeds, kg/rad
    """
    translational_lift: NonNegative = 0.0
    """force along body z by the square of the airspeed across it, kg/m"""
    airspeed_moment: tuple[Moment, Moment] = (0.0, 0.0)
    """moment about x (roll) by Σω and the airspeed along y, and about y (pitch) by that along x,
    kg m/rad; positive: it turns the thrust against the airspeed, so the nose rises in forward
    flight
    """
    rate_damping: ByAxis = (0.0, 0.0, 0.0)
    """d of the moment -d ω about each body axis, N m s"""
    rotor_inertia: NonNegative = 0.0
    """moment of inertia of a rotor about its axis, kg m^2: gyroscopic moment and yaw reaction"""
    ground_effect_radius: NonNegative = 0.0
    """R of the ground effect 1 / (1 - (R / 4z)^2) on the thrust, a rotor's radius or more, m"""
    thrust_factors: tuple[ThrustFactor, ThrustFactor, ThrustFactor, ThrustFactor] = _EQUAL
    """factor of the thrust and drag moment of each rotor at its speed"""
    gravity: Rate = GRAVITY
    """g, m/s^2"""
    thrust_limits: Limits = _NO_LIMITS
    """least and greatest rotor thrust in hover thrusts m g / 4 (Eq. 3.18)"""
    rotor_thrust_limits: Limits | None = Field(default=None, exclude=True)
    """the same in N"""
    rotor_speed_limits: Limits | None = Field(default=None, exclude=True)
    """the same as rotor speeds, rad/s"""
    saturation: Literal["each", "shared"] = "each"
    """if a low battery (randomize) cannot provide a commanded speed, each: this rotor turns as fast
    as it can; shared: the missing speed is subtracted from all four, as in Crazyflie's firmware
    """
    physics_step: Quantity = Field(default=MAX_PHYSICS_STEP, le=MAX_PHYSICS_STEP)
    """s; at most 0.0025"""
    control_step: Quantity = CONTROL_STEP
    """s; a whole number of physics steps"""
    delay: int = Field(default=1, ge=0, le=100)
    """control steps from a command to its effect; or give latency, s, a multiple of control_step"""
    collision_radius: Quantity
    """radius of the collision sphere at the centre of mass, m"""
    rates: RateLoop = RateLoop()
    """the rate loop of action: rates, fields of RateLoop; or betaflight or px4"""
    geometric_gains: GeometricGains | None = Field(default=None, repr=False)
    """gains of the geometric expert, found for this vehicle; without them it derives gains"""
    time_optimal: dict[Quantity, Quantity] | None = Field(default=None, repr=False)
    """from distances, m, to least times to rest there, s, as an optimal control finds them"""

    @model_validator(mode="before")
    @classmethod
    def _in_short(cls, data: Any) -> Any:
        """Replace ``motor_gain`` by the gains up and down, ``latency`` by the delay, and
        ``rotor_order`` with its keys by positions and directions.
        """
        if not isinstance(data, Mapping):
            return data
        data = dict(data)
        meant: StrDict = {}
        if "motor_gain" in data:
            meant = dict.fromkeys(MOTOR_GAINS, data.pop("motor_gain"))
        if "latency" in data:
            step = check(Quantity, data.get("control_step", CONTROL_STEP), "control_step")
            latency = check(NonNegative, data.pop("latency"), "latency")
            meant["delay"] = _delay(latency, step)
        given = {key: data.pop(key) for key in NamedLayout.model_fields if key in data}
        if given:
            meant |= validate(NamedLayout, given, "rotor_order").rotors()
        for key in sorted(data.keys() & meant):
            raise ValueError(
                f"{key}: give it, or motor_gain, latency or rotor_order, which stands for it"
            )
        return data | meant

    @model_validator(mode="after")
    def _limits_as_published(self) -> "Vehicle":
        """Convert ``rotor_thrust_limits`` or ``rotor_speed_limits`` to ``thrust_limits``."""
        given = [name for name in LIMITS if getattr(self, name) not in (None, _NO_LIMITS)]
        if len(given) != 1:
            raise ValueError(f"{' and '.join(given or LIMITS)}: give exactly one of them")
        (name,) = given
        if name == "thrust_limits":
            return self
        low, high = getattr(self, name)
        if low >= high:
            raise ValueError(f"{name} [{low:g}, {high:g}]: must rise")
        thrusts = np.array([low, high])
        # Eq. 2.4.
        if name == "rotor_speed_limits":
            if self.thrust_coefficient == 0.0:
                raise ValueError(
                    "rotor_speed_limits: need thrust_coefficient; or give rotor_thrust_limits"
                )
            thrusts = self.thrust_coefficient * thrusts**2
        limits = (thrusts / self.hover_thrust).tolist()
        # The model is frozen, but nobody else has it yet.
        vars(self).update({"thrust_limits": tuple(limits), name: None})
        return self

    @model_validator(mode="after")
    def _check_flyable(self) -> "Vehicle":
        low, high = self.thrust_limits
        if not low < 1.0 < high:
            raise CannotHover(
                f"thrust_limits [{low:.4g}, {high:.4g}] for a mass of {self.mass:g} kg: hover "
                "(1.0) must lie between them, or it cannot hover; is the mass in kg?"
            )
        if sorted(self.rotor_directions) != [-1, -1, 1, 1]:
            raise ValueError(
                f"rotor_directions {list(self.rotor_directions)}: must be two of 1 and two of -1"
            )
        if self.largest_moment > INACCURACY and not self.allow_impossible_inertia:
            raise ValueError(
                f"inertia {list(self.inertia)}: {self.inertia_fault}; "
                "allow_impossible_inertia: true flies it all the same"
            )
        if abs(np.linalg.det(self.mixer)) < 1e-12:
            raise ValueError(
                "rotor_positions: these rotors cannot give thrust, roll, pitch and yaw "
                "independently"
            )
        ratios = self.gyration_ratios
        if ratios.min() < GYRATION_RATIOS[0] or ratios.max() > GYRATION_RATIOS[1]:
            raise ValueError(
                f"inertia {list(self.inertia)}: has nothing in common with a mass of {self.mass:g} "
                f"kg and rotors {self.arm_length:g} m from the centre; is it in kg m²?"
            )
        if self.rotor_inertia > self.inertia[2]:
            raise ValueError(
                f"rotor_inertia {self.rotor_inertia:g}: exceeds the vehicle's Izz "
                f"{self.inertia[2]:g}; is it in kg m²?"
            )
        if not 1.0 < self.hover_rotor_speed < LARGEST:
            raise ValueError(
                f"thrust_coefficient {self.thrust_coefficient:g}: rotors would hover at "
                f"{self.hover_rotor_speed:.3g} rad/s; is it in N s²?"
            )
        shares = self.hover_shares
        if not low < shares.min() <= shares.max() < high:
            raise CannotHover(
                f"rotor_positions: hover about this centre of mass takes {shares.min():.3g} to "
                f"{shares.max():.3g} of m g / 4 of its rotors, whose thrust_limits are "
                f"[{low:.4g}, {high:.4g}]; move it nearer to the middle of the rotors, or give "
                "thrust_factors nearer to 1"
            )
        return self

    @model_validator(mode="after")
    def _steps_are_short(self) -> "Vehicle":
        error = self.control_step / self.physics_step - self.substeps
        if abs(error) > 1e-9 or not 1 <= self.substeps <= MAX_SUBSTEPS:
            raise ValueError(
                f"control_step {self.control_step}: must be a whole multiple of physics_step "
                f"{self.physics_step}, at most {MAX_SUBSTEPS} times"
            )
        damping = self.damping_rates.max()
        if damping * self.physics_step > 1.0:
            raise ValueError(
                f"rate_damping {list(self.rate_damping)}: divided by the inertia it is "
                f"{damping:.3g} 1/s, which times physics_step may not exceed 1; is it in N m s?"
            )
        gain = max(self.motor_gain_up, self.motor_gain_down)
        most = LARGEST_STEP[self.motor_integration]
        if gain * self.physics_step > most:
            raise ValueError(
                f"motor_gain {gain:g}: times physics_step it may not exceed {most:g} with "
                f"motor_integration {self.motor_integration}; make physics_step {most / gain:.3g} "
                "or less"
            )
        return self

    def model_copy(self, *, update: StrMapping | None = None, deep: bool = False) -> "Vehicle":
        """Return another vehicle that differs in ``update``; unlike pydantic's own, validated.

        ``geometric_gains`` and ``time_optimal`` were found for this vehicle: one that differs in
        more than its name and its gains has none, unless ``update`` contains some.
        """
        changes = dict(update or {})
        if changes.keys() - {"name", "geometric_gains"}:
            changes = {**dict.fromkeys(_FOUND), **changes}
        # Fields that the changes give in another form.
        replaced: set[str] = set()
        if "motor_gain" in changes:
            replaced.update(MOTOR_GAINS)
        if "latency" in changes:
            replaced.add("delay")
        if not changes.keys().isdisjoint(LIMITS):
            replaced.add("thrust_limits")
        return Vehicle.model_validate({**self.model_dump(exclude=replaced), **changes})

    def in_layout_of(self, other: "Vehicle") -> "Vehicle":
        """Return this vehicle with axes turned about z, and rotors in the order of ``other``.

        A policy knows one order of the rotors. This lets it fly vehicles that number their rotors
        in another way, or whose rotors form a plus instead of an X.

        :raises ConfigError: no turn brings its rotors there; or it would turn axes with different
            moments of inertia, which leads to products of inertia.
        """
        turn = find_turn(self, other)
        if turn == Turn():
            return self
        positions = np.array(self.rotor_positions)[[*turn.order]] @ turn.axes[:2, :2].T
        changes: StrDict = {name: getattr(self, name) for name in _FOUND}
        changes["rotor_positions"] = positions.tolist()
        changes["rotor_directions"] = other.rotor_directions
        changes["thrust_factors"] = [self.thrust_factors[k] for k in turn.order]
        rates = self.rates.model_dump(exclude_none=True)
        # The moments by airspeed turn as the diagonal of a matrix does, like the others.
        names = ("inertia", "drag", "rotor_drag", "rate_damping", "airspeed_moment")
        of_axes = {name: getattr(self, name) for name in names} | rates
        del of_axes["lag"]
        for name, given in of_axes.items():
            values = np.array(given)
            turned = turn.axes @ np.diag([*values, 0.0][:3]) @ turn.axes.T
            if abs(turned[0, 1]) > 0.02 * np.abs(values[:2]).min():
                raise ConfigError(
                    f"rotor_layout: {self.name} has to be turned by "
                    f"{math.degrees(turn.angle):.0f}° to the layout of {other.name}, "
                    f"but its {name} differs in x and y"
                )
            where = rates if name in rates else changes
            where[name] = turned.diagonal()[: len(values)].tolist()
        changes["rates"] = rates
        return self.model_copy(update=changes)

    def flies_as(self, other: "Vehicle") -> bool:
        """Whether both have the same parameters; names and an expert's gains do not matter."""
        unlike = {"name", *_FOUND}
        return self.model_dump(exclude=unlike) == other.model_dump(exclude=unlike)

    @property
    def mixer(self) -> FloatArray:
        """[ΣF; Mx; My; Mz] = mixer · F, shape (4, 4), from rotor thrusts in N, before the
        ``thrust_factors``.

        Eq. 2.7 prints this for a plus layout; ITM's rotors form an X, so that each acts on roll and
        pitch.
        """
        return np.stack([np.ones(4), *self.rotor_arms]) * self.thrust_factors

    @property
    def rotor_arms(self) -> FloatArray:
        """Moments about each axis for each rotor's own thrust, (3, 4), m."""
        x, y = np.array(self.rotor_positions).T
        return np.stack([y, -x, self.moment_thrust_ratio * np.array(self.rotor_directions)])

    @property
    def mixer_inverse(self) -> FloatArray:
        """Rotor thrusts from [ΣF; Mx; My; Mz], shape (4, 4)."""
        return np.asarray(np.linalg.inv(self.mixer))

    @property
    def arm_length(self) -> float:
        """Distance of the outermost rotor from the centre of mass, m."""
        return max(math.hypot(x, y) for x, y in self.rotor_positions)

    @property
    def hover_thrust(self) -> float:
        """Mean thrust of the rotors in hover, m g / 4, N."""
        return self.mass * self.gravity / 4.0

    @property
    def hover_shares(self) -> FloatArray:
        """Thrusts of the rotors in hover, in m g / 4, (4,): 1, or whatever balances the moments if
        the centre of mass is not in the middle of the rotors.
        """
        # Rounded, so that rotors in symmetrical places have exactly 1.
        return np.round(4.0 * self.mixer_inverse[:, 0], 12)

    @property
    def hover_thrusts(self) -> FloatArray:
        """Thrusts of the rotors in hover, (4,), N, before the ``thrust_factors``."""
        return self.hover_shares * self.hover_thrust

    @property
    def lift(self) -> float:
        """kF, N s²; if it is unknown, the one with which ``hover_rotor_speed`` is 1,000 rad/s."""
        return self.thrust_coefficient or self.hover_thrust / HOVER_SPEED**2

    @property
    def thrust_range(self) -> tuple[float, float]:
        """Least and greatest thrust of one rotor, N."""
        low, high = self.thrust_limits
        return low * self.hover_thrust, high * self.hover_thrust

    @property
    def _middle_and_half(self) -> tuple[float, float]:
        """Middle and half of the thrust range, N."""
        low, high = self.thrust_range
        return (high + low) / 2, (high - low) / 2

    @property
    def rotor_speed_range(self) -> tuple[float, float]:
        """Least and greatest speed of one rotor, rad/s (Eq. 2.4 at the thrust limits)."""
        low, high = self.thrust_range
        return math.sqrt(low / self.lift), math.sqrt(high / self.lift)

    @property
    def greatest_moments(self) -> FloatArray:
        """Greatest moments about roll, pitch and yaw separately, (3,), N m, whatever the thrust."""
        middle, half = self._middle_and_half
        arms = self.mixer[1:]
        # Each rotor goes from the middle of its limits to one end.
        return np.asarray(np.abs(arms).sum(axis=1) * half + np.abs(arms.sum(axis=1)) * middle)

    @property
    def rate_limits_and_gains(self) -> tuple[list[float], list[float]]:
        """Greatest commanded body rates, rad/s, and gains, 1/s, of the rate loop, by axis."""
        lag, half = self.rates.lag, self._middle_and_half[1]
        gain = derived_gain(lag, self.motor_gain_up, self.motor_gain_down)
        gains = self.rates.gains or (gain, gain, gain)
        turns = np.abs(self.mixer[1:]).sum(axis=1) * half / self.inertia
        axes = zip(turns.tolist(), gains, LEAST_DERIVED_LIMITS, strict=True)
        derived = [derived_limit(*axis) for axis in axes]
        return [*(self.rates.limits or derived)], [*gains]

    @property
    def gyration_ratios(self) -> FloatArray:
        """Radii of gyration √(I/m), divided by the arm length, (3,).

        Above 1 the mass would lie beyond the rotors.
        """
        return np.sqrt(np.divide(self.inertia, self.mass)) / self.arm_length

    @property
    def largest_moment(self) -> float:
        """The largest moment of inertia, divided by the sum of the other two; at most 1 for a rigid
        body.
        """
        largest = max(self.inertia)
        return largest / (sum(self.inertia) - largest)

    @property
    def inertia_fault(self) -> str:
        """Why no rigid body has this inertia; empty if one can."""
        excess = self.largest_moment - 1.0
        if excess <= 1e-9:
            return ""
        return (
            "no rigid body has a moment larger than the sum of the other two, "
            f"here by {100 * excess:.2g} %"
        )

    @property
    def hover_rotor_speed(self) -> float:
        """Speed of a rotor with the thrust ``hover_thrust``, rad/s."""
        return math.sqrt(self.hover_thrust / self.lift)

    @property
    def hover_speed_sum(self) -> float:
        """Sum of the rotor speeds in hover, rad/s."""
        return float(np.sqrt(self.hover_thrusts / self.lift).sum())

    @property
    def airspeed_turns(self) -> FloatArray:
        """Angular acceleration of roll and pitch by 1 m/s of airspeed in hover, (2,), rad/s²."""
        return self.hover_speed_sum * np.divide(self.airspeed_moment, self.inertia[:2])

    @property
    def rotor_drag_rates(self) -> FloatArray:
        """``rotor_drag`` in hover by the mass, (3,), 1/s."""
        return self.hover_speed_sum * np.divide(self.rotor_drag, self.mass)

    @property
    def damping_rates(self) -> FloatArray:
        """``rate_damping`` by the inertia, (3,), 1/s."""
        return np.divide(self.rate_damping, self.inertia)

    @property
    def hover_action(self) -> FloatArray:
        """The action in hover, (4,); 0 if hover is in the middle of the thrust limits."""
        return self.thrust_to_action(self.hover_thrusts)

    @property
    def substeps(self) -> int:
        """Physics steps in one control step."""
        return round(self.control_step / self.physics_step)

    def thrust_to_action(self, thrust: FloatArray) -> FloatArray:
        """Return the actions that command rotor thrusts in N, any shape.

        It inverts Eq. 3.18, and does not clip to [-1, 1].
        """
        middle, half = self._middle_and_half
        return (thrust - middle) / half

    def action_to_thrust(self, action: FloatArray) -> FloatArray:
        """Return rotor thrusts in N from actions, any shape; outside [-1, 1] clipped (Eq. 3.18)."""
        middle, half = self._middle_and_half
        return middle + half * np.clip(action, -1.0, 1.0)

    def parameters(self) -> FloatArray:
        """Return the numbers that the compiled kernel needs, in the order of ``PARAMETER_NAMES``,
        (names,).
        """
        limits, gains = self.rate_limits_and_gains
        return np.array(
            [
                self.mass,
                *self.inertia,
                self.lift,
                self.motor_gain_up,
                self.motor_gain_down,
                self.motor_integration == "exact",
                self.gravity,
                *self.drag,
                self.hover_thrust,
                *self._middle_and_half,
                1.0,  # a full battery
                self.saturation == "shared",
                self.collision_radius,
                self.delay,
                *self.rotor_arms.flat,
                *self.hover_shares,
                *self.rotor_drag,
                self.translational_lift,
                *self.airspeed_moment,
                *self.rate_damping,
                self.rotor_inertia,
                self.ground_effect_radius,
                *self.thrust_factors,
                *limits,
                *np.multiply(gains, self.inertia),
                self.rates.lag,
                *self.mixer_inverse[:, 1:].T.flat,
            ]
        )


def _delay(latency: float, control_step: float) -> int:
    """Return a latency, s, in control steps.

    :raises ValueError: it is no multiple of the control step.
    """
    steps = round(latency / control_step)
    if abs(latency - steps * control_step) > 1e-6 * control_step:
        fitting = latency / max(steps, 1)
        substeps = math.ceil(fitting / MAX_PHYSICS_STEP - 1e-9)
        raise ValueError(
            f"latency {latency:g}: must be a multiple of control_step {control_step:g}, since "
            f"commands act from one control step to the next; give control_step: {fitting:.12g} "
            f"with physics_step: {fitting / substeps:.12g}, or latency: {steps * control_step:g}"
        )
    return steps


VehicleSource = StrPath | Vehicle
"""The name of a vehicle (``"itm"``), the path of a YAML file, or a vehicle."""


def load_vehicle(source: VehicleSource, layout: VehicleSource | None = None) -> Vehicle:
    """Return a vehicle by name or path; a Vehicle is returned as it is.

    A line on stderr warns of a user's file whose inertia no rigid body has.

    :param layout: the vehicle in whose layout it is flown, as for ``rotor_layout``; None: its own.
    :raises CannotHover: the only fault of the file is that hover lies outside the rotors' limits.
    :raises ConfigError: an unknown name, a missing or unreadable file, or a key that is unknown,
        missing or out of range.
    """
    if isinstance(source, Vehicle):
        vehicle = source
    else:
        data, where = VEHICLES.read(source)
        vehicle = validate(Vehicle, data, where)
        if vehicle.inertia_fault and VEHICLES.is_path(source):
            print_once(
                f"warning: {where}: inertia {list(vehicle.inertia)}: {vehicle.inertia_fault}; "
                "it is flown as it is"
            )
    if layout is None:
        return vehicle
    return vehicle.in_layout_of(load_vehicle(layout))


def first_vehicle(given: Any, layout: VehicleSource | None = None) -> Vehicle:
    """Return the vehicle that is given, or the first of a list, as ``env_kwargs`` may have one, see
    :func:`load_vehicle`.
    """
    if isinstance(given, (list, tuple)):
        if not given:
            raise ConfigError("vehicle []: give at least one")
        given = given[0]
    return load_vehicle(given, layout)
