"""Vehicles: the validated parameters of a quadcopter, the values derived from them, and the YAML
files that hold them.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, model_validator

from sb3_quad.base.arrays import FloatArray
from sb3_quad.base.errors import CannotHover, ConfigError
from sb3_quad.base.process import print_once
from sb3_quad.base.validate import Frozen, validate
from sb3_quad.base.yaml_files import YamlFolder
from sb3_quad.vehicles.gains import GeometricGains
from sb3_quad.vehicles.layout import Turn, find_turn

VEHICLES = YamlFolder("vehicle", "sb3_quad.vehicles")
MAX_SUBSTEPS = 1000  # physics steps in a control step
# Published moments of inertia are inaccurate: the largest may be this much of the other two's sum.
INACCURACY = 1.05
MAX_PHYSICS_STEP = 0.0025  # s, up to which the compiled rotation is exact
PerRotor = tuple[tuple[float, float], tuple[float, float], tuple[float, float], tuple[float, float]]

PARAMETER_NAMES = (
    "mass",
    "ixx",
    "iyy",
    "izz",
    "thrust_coefficient",
    "motor_gain_up",
    "motor_gain_down",
    "exact_motors",
    "gravity",
    "drag_x",
    "drag_y",
    "drag_z",
    "hover_thrust",
    "thrust_middle",
    "thrust_half_range",
    "collision_radius",
    "delay",
    *(f"{axis}_arm_{rotor}" for axis in ("roll", "pitch", "yaw") for rotor in range(4)),
)
"""The numbers of :meth:`Vehicle.parameters`, and the rows of an array (parameters, n) of n
vehicles.
"""
# A name becomes a part of file names, and of the text in reports and exported files.
NAME = r"^[^/\\<>\p{C}]{1,100}$"
Limits = tuple[NonNegativeFloat, PositiveFloat]
MOTOR_GAINS = ("motor_gain_up", "motor_gain_down")
LIMITS = ("thrust_limits", "rotor_thrust_limits", "rotor_speed_limits")
# Results of searches for one vehicle; another with other parameters does not have them.
_FOUND = ("geometric_gains", "time_optimal")


class Vehicle(Frozen):
    """The parameters of a quadcopter (specification table; thesis 4.1.1) and the values derived
    from them.

    You may give the limits of the rotors as they are published: ``rotor_thrust_limits`` in N or
    ``rotor_speed_limits`` in rad/s, in place of ``thrust_limits`` in hover thrusts. They become
    ``thrust_limits``, which a copy with another mass keeps, and are None afterwards. ``motor_gain``
    sets both ``motor_gain_up`` and ``motor_gain_down``.

    Frozen: ``vehicle.model_copy(update={"mass": 2.0})`` returns another vehicle, also validated.
    :func:`load_vehicle` raises :class:`ConfigError` for values that do not fit, the constructor
    pydantic's ``ValidationError``.
    """

    name: str = Field(
        pattern=NAME,
        description="name of the vehicle: up to 100 characters, without / \\ < > and control"
        " characters",
    )
    mass: PositiveFloat = Field(description="m, kg")
    inertia: tuple[PositiveFloat, PositiveFloat, PositiveFloat] = Field(
        description="Ixx, Iyy, Izz of the diagonal inertia, kg m^2"
    )
    rotor_positions: PerRotor = Field(
        description="x, y of each rotor in the body frame (x forward, y left), m"
    )
    rotor_directions: tuple[int, int, int, int] = Field(
        description="sign of the yaw moment of each rotor: two of 1, two of -1"
    )
    moment_thrust_ratio: PositiveFloat = Field(description="kM / kF, m")
    thrust_coefficient: PositiveFloat = Field(description="kF, N s^2, in F = kF ω^2 (Eq. 2.4)")
    motor_gain_up: PositiveFloat = Field(description="k_m of a rotor that speeds up, 1/s (Eq. 4.1)")
    motor_gain_down: PositiveFloat = Field(description="k_m of a rotor that slows down, 1/s")
    motor_integration: Literal["euler", "exact"] = Field(
        default="euler",
        description="euler: Eq. 4.1 as printed, thrust of the new speed; exact: the exponential"
        " solution, thrust of the step's middle",
    )
    drag: tuple[NonNegativeFloat, NonNegativeFloat, NonNegativeFloat] = Field(
        default=(0.0, 0.0, 0.0),
        description="d of the drag -d (v - wind) along each body axis, N s/m (Faessler 2018)",
    )
    gravity: PositiveFloat = Field(default=9.81, description="g, m/s^2")
    thrust_limits: Limits = Field(
        default=(0.0, 0.0),
        description="least and greatest rotor thrust in hover thrusts m g / 4 (Eq. 3.18)",
    )
    rotor_thrust_limits: Limits | None = Field(
        default=None, exclude=True, description="least and greatest rotor thrust, N"
    )
    rotor_speed_limits: Limits | None = Field(
        default=None, exclude=True, description="least and greatest rotor speed, rad/s"
    )
    physics_step: PositiveFloat = Field(
        default=0.0025, le=MAX_PHYSICS_STEP, description="s; at most 0.0025"
    )
    control_step: PositiveFloat = Field(
        default=0.01, description="s; a whole number of physics steps"
    )
    delay: int = Field(
        default=1, ge=0, le=100, description="control steps from a command to its effect"
    )
    collision_radius: PositiveFloat = Field(
        description="radius of the collision sphere at the centre of mass, m"
    )
    geometric_gains: GeometricGains | None = Field(
        default=None,
        description="gains of the geometric expert that were tuned for this vehicle; without them"
        " the expert derives its own",
    )
    time_optimal: dict[PositiveFloat, PositiveFloat] | None = Field(
        default=None,
        description="least time from hover to rest within 0.1 m of a target, s, by its distance, m"
        " (examples/time_optimal.py)",
    )

    @model_validator(mode="before")
    @classmethod
    def _same_motor_gains(cls, data: Any) -> Any:
        """Replace ``motor_gain`` by ``motor_gain_up`` and ``motor_gain_down``."""
        if not isinstance(data, Mapping) or "motor_gain" not in data:
            return data
        if data.keys() & MOTOR_GAINS:
            raise ValueError("motor_gain: give it, or motor_gain_up and motor_gain_down")
        changed = dict(data)
        return {**dict.fromkeys(MOTOR_GAINS, changed.pop("motor_gain")), **changed}

    @model_validator(mode="after")
    def _limits_as_published(self) -> "Vehicle":
        """Replace ``rotor_thrust_limits`` or ``rotor_speed_limits`` by ``thrust_limits``."""
        given = [name for name in self.model_fields_set & {*LIMITS} if getattr(self, name)]
        if len(given) != 1:
            names = [name for name in LIMITS if not given or name in given]
            raise ValueError(f"{' and '.join(names)}: give exactly one of them")
        (name,) = given
        if name == "thrust_limits":
            return self
        low, high = getattr(self, name)
        if low >= high:
            raise ValueError(f"{name} [{low:g}, {high:g}]: must rise")
        if name == "rotor_speed_limits":
            # F = kF ω² (Eq. 2.4)
            low, high = self.thrust_coefficient * low**2, self.thrust_coefficient * high**2
        hover = self.hover_thrust
        # The model is frozen for everybody else.
        object.__setattr__(self, "thrust_limits", (low / hover, high / hover))
        object.__setattr__(self, name, None)
        return self

    @model_validator(mode="after")
    def _consistent(self) -> "Vehicle":
        low, high = self.thrust_limits
        if not low < 1.0 < high:
            raise CannotHover(
                f"thrust_limits [{low:.4g}, {high:.4g}] for a mass of {self.mass:g} kg:"
                " hover (1.0) must lie between them, or it cannot hover; is the mass in kg?"
            )
        if sorted(self.rotor_directions) != [-1, -1, 1, 1]:
            raise ValueError(
                f"rotor_directions {list(self.rotor_directions)}: must be two of 1 and two of -1"
            )
        if self.largest_moment > INACCURACY:
            raise ValueError(f"inertia {list(self.inertia)}: {self.inertia_fault}")
        substeps = self.control_step / self.physics_step
        if abs(substeps - round(substeps)) > 1e-9 or not 1 <= round(substeps) <= MAX_SUBSTEPS:
            raise ValueError(
                f"control_step {self.control_step}: must be a whole multiple of physics_step"
                f" {self.physics_step}, at most {MAX_SUBSTEPS} times"
            )
        gain = max(self.motor_gain_up, self.motor_gain_down)
        if gain * self.physics_step > 1.0:
            raise ValueError(
                f"motor_gain {gain}: times physics_step it may not exceed 1, or Eq. 4.1 overshoots"
            )
        mixer = self.mixer
        if abs(np.linalg.det(mixer)) < 1e-12:
            raise ValueError(
                "rotor_positions: these rotors cannot give thrust, roll, pitch and yaw"
                " independently"
            )
        if not np.allclose(mixer[1:].sum(axis=1), 0.0, atol=1e-9):
            raise ValueError(
                "rotor_positions: equal thrusts must give no moment (rotors symmetrical about the"
                " centre of mass)"
            )
        return self

    def model_copy(
        self, *, update: Mapping[str, Any] | None = None, deep: bool = False
    ) -> "Vehicle":
        """Return another vehicle that differs in ``update``; unlike pydantic's own method, this
        validates it.

        ``geometric_gains`` and ``time_optimal`` were found for this vehicle. A copy that differs in
        more than its name and its gains does not have them, unless ``update`` brings some.
        """
        changes = dict(update or {})
        own = self.model_dump()
        if changes.keys() - {"name", "geometric_gains"}:
            own.update(dict.fromkeys(_FOUND))
        # An update may state these in another way.
        if "motor_gain" in changes:
            del own["motor_gain_up"], own["motor_gain_down"]
        if changes.keys() & {*LIMITS}:
            del own["thrust_limits"]
        return Vehicle.model_validate({**own, **changes})

    def turn_to(self, other: "Vehicle") -> Turn:
        """Return the yaw rotation and renumbering that map each rotor onto one of ``other``.

        :raises ConfigError: no turn does.
        """
        turn = find_turn(
            self.rotor_positions,
            self.rotor_directions,
            other.rotor_positions,
            other.rotor_directions,
        )
        if turn is None:
            raise ConfigError(
                "rotor_layout: rotor layouts are incompatible: no yaw rotation and renumbering maps"
                f" the rotors of {self.name} (position and spin direction) onto those of"
                f" {other.name}"
            )
        return turn

    def in_layout_of(self, other: "Vehicle") -> "Vehicle":
        """Return the same vehicle in the layout of another: its body axes are turned about z and
        its rotors renumbered until each is where ``other`` has it.

        A policy knows one order of the rotors. In its layout it can also fly vehicles that number
        their rotors in another way, or whose rotors form a plus instead of an X.

        :raises ConfigError: no turn maps the rotors; or it turns axes of different moments of
            inertia, which would give products of inertia.
        """
        turn = self.turn_to(other)
        if turn == Turn():
            return self
        cosine, sine = math.cos(turn.angle), math.sin(turn.angle)
        for name, (x, y, _) in (("Ixx and Iyy", self.inertia), ("drag in x and in y", self.drag)):
            if abs((x - y) * sine * cosine) > 0.02 * min(x, y):
                raise ConfigError(
                    f"rotor_layout: {self.name} has to be turned by"
                    f" {math.degrees(turn.angle):.0f}° to the layout of {other.name},"
                    f" but its {name} differ"
                )

        def turned(values: tuple[float, float, float]) -> tuple[float, float, float]:
            x, y, z = values
            return x * cosine**2 + y * sine**2, x * sine**2 + y * cosine**2, z

        positions = np.array(self.rotor_positions)[list(turn.order)] @ turn.axes[:2, :2].T
        changes: dict[str, Any] = {
            "inertia": turned(self.inertia),
            "drag": turned(self.drag),
            "rotor_positions": tuple(map(tuple, positions.tolist())),
            "rotor_directions": other.rotor_directions,
        }
        return self.model_copy(update={**changes, **{name: getattr(self, name) for name in _FOUND}})

    def flies_as(self, other: "Vehicle") -> bool:
        """Return whether both have the same parameters; names and an expert's gains do not
        matter.
        """
        ignored = {"name", *_FOUND}
        return self.model_dump(exclude=ignored) == other.model_dump(exclude=ignored)

    @property
    def mixer(self) -> FloatArray:
        """[ΣF; Mx; My; Mz] = mixer · F, shape (4, 4), from rotor thrusts in N.

        Eq. 2.7 prints this for a plus layout; ITM's rotors form an X, so that each acts on roll and
        pitch.
        """
        x, y = np.array(self.rotor_positions).T
        return np.stack(
            [np.ones(4), y, -x, self.moment_thrust_ratio * np.array(self.rotor_directions)]
        )

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
        """Thrust of one rotor in hover, m g / 4, N."""
        return self.mass * self.gravity / 4.0

    @property
    def thrust_range(self) -> tuple[float, float]:
        """Least and greatest thrust of one rotor, N."""
        return self.thrust_limits[0] * self.hover_thrust, self.thrust_limits[1] * self.hover_thrust

    @property
    def rotor_speed_range(self) -> tuple[float, float]:
        """Least and greatest speed of one rotor, rad/s (Eq. 2.4 at the thrust limits)."""
        low, high = self.thrust_range
        return math.sqrt(low / self.thrust_coefficient), math.sqrt(high / self.thrust_coefficient)

    @property
    def command_lag(self) -> float:
        """Time τ from a command to its thrust, s: delay, half the control step that the command is
        held for, and the motors' time constant.
        """
        return (self.delay + 0.5) * self.control_step + self.motor_time_constant

    @property
    def motor_time_constant(self) -> float:
        """1/k_m, the mean of a rotor that speeds up and one that slows down, s."""
        return (1.0 / self.motor_gain_up + 1.0 / self.motor_gain_down) / 2.0

    @property
    def greatest_moments(self) -> FloatArray:
        """Greatest moments about roll, pitch and yaw, (3,), N m, each by itself."""
        # Equal thrusts give no moment, so each thrust counts by its distance from the middle.
        low, high = self.thrust_range
        return np.asarray(np.abs(self.mixer[1:]).sum(axis=1) * (high - low) / 2)

    @property
    def gyration_ratios(self) -> FloatArray:
        """Radii of gyration √(I/m) divided by the arm length, (3,). Above 1 the mass would lie
        beyond the rotors.
        """
        return np.asarray(np.sqrt(np.array(self.inertia) / self.mass) / self.arm_length)

    @property
    def largest_moment(self) -> float:
        """Largest moment of inertia divided by the sum of the other two; at most 1 for a rigid
        body.
        """
        return max(self.inertia) / (sum(self.inertia) - max(self.inertia))

    @property
    def inertia_fault(self) -> str:
        """Why no rigid body has this inertia; empty where one can."""
        excess = self.largest_moment - 1.0
        if excess <= 1e-9:
            return ""
        return (
            "no rigid body has one moment larger than the other two together,"
            f" here by {100 * excess:.2g} %"
        )

    @property
    def hover_rotor_speed(self) -> float:
        """Speed of one rotor in hover, rad/s."""
        return math.sqrt(self.hover_thrust / self.thrust_coefficient)

    @property
    def hover_action(self) -> float:
        """Action of each rotor in hover; 0 if hover is in the middle of the thrust limits."""
        return float(self.thrust_to_action(np.array(self.hover_thrust)))

    @property
    def substeps(self) -> int:
        """Physics steps in one control step."""
        return round(self.control_step / self.physics_step)

    def thrust_to_action(self, thrust: FloatArray) -> FloatArray:
        """Actions in [-1, 1] from rotor thrusts in N, any shape; the inverse of Eq. 3.18 (not
        clipped).
        """
        low, high = self.thrust_range
        return (thrust - (high + low) / 2) / ((high - low) / 2)

    def action_to_thrust(self, action: FloatArray) -> FloatArray:
        """Rotor thrusts in N from actions, any shape; Eq. 3.18, actions outside [-1, 1] clipped."""
        low, high = self.thrust_range
        return (high + low) / 2 + (high - low) / 2 * np.clip(action, -1.0, 1.0)

    def parameters(self) -> FloatArray:
        """Return the numbers for compiled code, shape (len(PARAMETER_NAMES),), in that order."""
        low, high = self.thrust_range
        return np.array(
            [
                self.mass,
                *self.inertia,
                self.thrust_coefficient,
                self.motor_gain_up,
                self.motor_gain_down,
                self.motor_integration == "exact",
                self.gravity,
                *self.drag,
                self.hover_thrust,
                (high + low) / 2,
                (high - low) / 2,
                self.collision_radius,
                self.delay,
                *self.mixer[1:].ravel(),
            ],
            dtype=np.float64,
        )


def load_vehicle(source: str | Path | Vehicle) -> Vehicle:
    """Return a vehicle by its name (``"itm"``) or the path of a YAML file; a vehicle as it is.

    It warns on stderr where a user's file has an inertia that no rigid body has, but within
    ``INACCURACY``.

    :raises CannotHover: the only fault of the file is that hover is not between the rotors' limits.
    :raises ConfigError: an unknown name, a missing or unreadable file, or a key that is unknown,
        missing or out of range.
    """
    if isinstance(source, Vehicle):
        return source
    data, where = VEHICLES.read(source if isinstance(source, Path) else str(source))
    vehicle = validate(Vehicle, data, where)
    if vehicle.inertia_fault and VEHICLES.is_path(source):
        print_once(
            f"warning: {where}: inertia {list(vehicle.inertia)}: {vehicle.inertia_fault};"
            " it is flown as it is"
        )
    return vehicle


def first_vehicle(given: Any, layout: str | Path | Vehicle | None = None) -> Vehicle:
    """Return a vehicle like :func:`load_vehicle`; of a list, as ``env_kwargs`` may have one, the
    first.

    :param layout: the vehicle in whose layout it is flown, as in ``rotor_layout``; None: its own.
    """
    if isinstance(given, (list, tuple)):
        if not given:
            raise ConfigError("vehicle []: give at least one")
        given = given[0]
    vehicle = load_vehicle(given)
    return vehicle if layout is None else vehicle.in_layout_of(load_vehicle(layout))
