"""A scenario: one way to judge a controller, flown many times; and a suite of them."""

import itertools
import math
from collections.abc import Sequence
from functools import cache
from typing import Annotated, Any

from pydantic import Field, PositiveFloat, ValidationError, field_validator, model_validator

from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.base.seeds import row_seeds, seed_for
from sb3_quad.base.validate import Frozen, explain, validate
from sb3_quad.evaluation.scenarios.parts import Start, Target, VehicleChanges, Wrench
from sb3_quad.simulation.randomization import Randomization
from sb3_quad.simulation.settings import FlightSettings, Noise
from sb3_quad.simulation.tasks import RECOVERED, Task
from sb3_quad.simulation.vehicle_distribution import VehicleDistribution
from sb3_quad.vehicles.vehicle import VEHICLES, Vehicle, first_vehicle, load_vehicle

TOLERANCES = (
    0.05,
    0.1,
    0.2,
    0.3,
    0.4,
    0.5,
    0.6,
    0.7,
    0.8,
    0.9,
    1.0,
)  # m: Figs. 4.6 and 4.7, and below
NAME = r"^[A-Za-z0-9][A-Za-z0-9_.-]*$"  # is part of file names
DEFAULT_VEHICLE = "itm"
NumberOrRange = float | tuple[float, float]


class Reference(Frozen):
    """What others measured, printed beside our own metrics; a pair is a range."""

    success: NumberOrRange | None = None
    """share of flights that end at their target, 0 to 1"""
    survival: NumberOrRange | None = None
    """share that neither crash nor get lost: the thesis's success"""
    reward: NumberOrRange | None = None
    """mean per episode"""
    time_to: dict[str, NumberOrRange | None] = Field(default_factory=dict)
    """from tolerances in m to mean times in s; null: never within it"""
    path: NumberOrRange | None = None
    """mean path, m"""
    final_error: NumberOrRange | None = None
    """|r - r_T| at the end, m"""
    flown: NumberOrRange | None = None
    """until the flight ended, s"""
    recovery_time: NumberOrRange | None = None
    """until the vehicle was stable again, s"""
    note: str = ""
    """what the source says in words"""

    @field_validator("time_to", mode="before")
    @classmethod
    def _as_text(cls, value: Any) -> Any:
        if not isinstance(value, dict):
            raise ValueError("must map tolerances in m to times in s")
        return {
            f"{key:g}" if isinstance(key, float) else str(key): time for key, time in value.items()
        }


class Scenario(Frozen):
    """What is flown, how often, and what others measured there. Units m, s, rad, N, N m, kg."""

    name: str = Field(pattern=NAME)
    """letters, digits, _ . -; unique in its suite"""
    title: str = ""
    """heading of tables and plots; left out: the name"""
    description: str = ""
    """what it is, and where it comes from"""
    start: Start = Start()
    """where an episode starts; left out: hovering at (0, 0, 15) m"""
    target: Target = Target(distance=0.0)
    """where to fly; left out: to the start"""
    wrenches: tuple[Wrench, ...] = ()
    """external forces and torques"""
    noise: Noise | Annotated[float, Field(ge=0, le=1)] = 0.05
    """relative std of the observation noise, a share: 0.05 is 5 %; or {relative: …, additive: …}"""
    duration: Annotated[float, Field(gt=0, le=600)] = 15.0
    """of an episode; the unit is s"""
    max_distance: PositiveFloat = 30.0
    """farther than this from the target ends an episode, m"""
    vehicle: str | Vehicle | None = None
    """name, or path of a YAML file (relative to the suite's); left out: the agent's own, or itm"""
    vehicle_changes: VehicleChanges = VehicleChanges()
    """unknown to the controller"""
    vehicles: VehicleDistribution | None = None
    """each episode has a vehicle of it, unknown to the controller, such as {distribution: raptor}"""
    randomize: Randomization | None = None
    """what differs by episode, unknown to the controller, such as {gusts: {std: 1}}"""
    episodes: Annotated[int, Field(ge=1, le=1_000_000)] = 240
    """how many are flown"""
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    """from which every episode gets its own"""
    tolerances: tuple[PositiveFloat, ...] = Field(default=TOLERANCES, min_length=1)
    """of arrival, |r - r_T|, m"""
    reference: dict[str, Reference] = Field(default_factory=dict)
    """from a column's title to others' metrics"""
    group: str | None = None
    """the scenario that this one is a cell of; set by vary"""
    cell: dict[str, float] = Field(default_factory=dict)
    """this cell's values, by key; set by vary"""

    @field_validator("vehicle")
    @classmethod
    def _read(cls, value: str | Vehicle | None) -> str | Vehicle | None:
        # From here on, no file matters.
        return load_vehicle(value) if isinstance(value, str) and VEHICLES.is_path(value) else value

    @field_validator("tolerances")
    @classmethod
    def _rising(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        return tuple(sorted(set(value)))

    @model_validator(mode="after")
    def _possible(self) -> "Scenario":
        vehicle = self.flown_vehicle()
        vehicle = self.vehicles.weakest(vehicle) if self.vehicles is not None else vehicle
        self._check_way(vehicle)
        try:
            _ = self.task
        except ValidationError as error:
            raise ValueError(explain(error, Task)) from None
        if self.randomize is not None:
            self.randomize.check(vehicle)
            if self.randomize.sets_wrench and self.wrenches:
                raise ValueError(
                    "randomize: force and torque do not go with wrenches, which replace them"
                )
        step = vehicle.control_step
        if self.duration < step:
            raise ValueError(f"duration: {self.duration:g} s is below a control step, {step:g} s")
        for number, wrench in enumerate(self.wrenches):
            if wrench.duration is not None and wrench.duration < step * (1 - 1e-9):
                raise ValueError(
                    f"wrenches.{number}: a duration of {wrench.duration:g} s is below a control step, {step:g} s"
                )
            if wrench.start >= self.duration:
                over = f"when the episode of {self.duration:g} s is over"
                raise ValueError(f"wrenches.{number}: starts at {wrench.start:g} s, {over}")
        return self

    def nominal_vehicle(self) -> Vehicle:
        """The vehicle before the changes: the one that experts are made for.

        :raises ConfigError: it cannot be loaded.
        """
        return (
            self.vehicle
            if isinstance(self.vehicle, Vehicle)
            else _by_name(self.vehicle or DEFAULT_VEHICLE)
        )

    def flown_by(self, own: Any) -> "Scenario":
        """The scenario with an agent's ``own`` vehicle (None: it has none), unless it names one
        itself.

        :raises ConfigError: it is impossible for that vehicle.
        """
        if own is None or self.vehicle is not None:
            return self
        vehicle = first_vehicle(own)
        return validate(
            Scenario,
            {**self.model_dump(), "vehicle": vehicle},
            f"scenario {self.name}, flown by {vehicle.name}",
        )

    def flown_vehicle(self) -> Vehicle:
        """The vehicle that flies, changes included.

        :raises ValueError: a vehicle that cannot be loaded (ConfigError), or cannot fly once
            changed.
        """
        nominal = self.nominal_vehicle()
        try:
            return self.vehicle_changes.apply(nominal)
        except ValidationError as error:
            raise ValueError(
                f"vehicle_changes: no such vehicle can fly ({explain(error, Vehicle)})"
            ) from None

    def episode_seeds(self) -> list[int]:
        """The seeds of the episodes, for ``reset(seed=…)`` of one environment."""
        return row_seeds(seed_for("suite", self.seed), self.episodes)

    @property
    def heading(self) -> str:
        """The title, or the name."""
        return self.title or self.name

    @property
    def steps(self) -> int:
        """Control steps of an episode."""
        return round(self.duration / self.nominal_vehicle().control_step)

    @property
    def task(self) -> Task:
        """What the environments sample themselves, so that random targets and attitudes are those
        of training.
        """
        elsewhere = self.target.distance or any(
            point != self.start.position for point in self.target.points
        )
        return Task(
            name="scenario",
            start_position=self.start.position,
            target_distance=self.target.distance or 0.0,
            random_attitude=self.start.attitude.distribution == "uniform",
            velocity_std=self.start.velocity.std or 0.0,
            body_rates_std=self.start.body_rates.std or 0.0,
            max_distance=self.max_distance,
            **({} if elsewhere else RECOVERED),
        )

    @property
    def flown_as(self) -> FlightSettings:
        """How the episodes are flown."""
        return FlightSettings(
            task=self.task,
            vehicle=self.flown_vehicle(),
            noise=self.noise,
            vehicles=self.vehicles,
            randomize=self.randomize,
            max_episode_steps=self.steps,
        )

    @property
    def physical_limit(self) -> float | None:
        """The least mean time, s, after which the vehicle could stay within 0.1 m of its targets;
        None: it is not known.
        """
        if (
            self.start != Start()
            or self.wrenches
            or self.randomize
            or self.vehicles
            or 0.1 not in self.tolerances
        ):
            return None
        return (self.flown_vehicle().time_optimal or {}).get(self.target.distance or 0.0)

    @property
    def is_fixed(self) -> bool:
        """Whether every episode has the same start, target and wrenches, so that only noise tells
        them apart.
        """
        vectors = [self.start.velocity, self.start.body_rates]
        vectors += [vector for wrench in self.wrenches for vector in (wrench.force, wrench.torque)]
        attitude = self.start.attitude
        random = (
            attitude.distribution,
            attitude.tilt,
            self.target.distance,
            self.randomize,
            self.vehicles,
        )
        return not any(random) and all(
            vector.value is not None or vector.largest == 0.0 for vector in vectors
        )

    def _check_way(self, vehicle: Vehicle) -> None:
        """See that start and targets lie above ground, within ``max_distance`` of each other."""
        start, points, least = self.start.position, self.target.points, vehicle.collision_radius
        for place, point in (("start.position", start), *(("target", point) for point in points)):
            if point[2] <= least:
                raise ValueError(
                    f"{place}: {list(point)} touches the ground; z must exceed {least:g} m"
                )
        legs = list(itertools.starmap(math.dist, itertools.pairwise([start, *points]))) or [
            self.target.distance or 0.0
        ]
        if max(legs) > self.max_distance:
            limit = f"an episode ends beyond max_distance {self.max_distance:g} m"
            raise ValueError(f"target: {max(legs):.3g} m away, and {limit}")


class Suite(Frozen):
    """Scenarios that belong together."""

    name: str = Field(pattern=NAME)
    """what the suite is called"""
    description: str = ""
    """what it is for"""
    source: str = "reference"
    """where the reference comes from; heads its column"""
    scenarios: tuple[Scenario, ...] = Field(min_length=1)

    def scenario(self, name: str) -> Scenario:
        """The scenario of that name.

        :raises ConfigError: there is none.
        """
        scenarios = {scenario.name: scenario for scenario in self.scenarios}
        if name not in scenarios:
            raise ConfigError(unknown("scenario", name, scenarios))
        return scenarios[name]

    def with_changes(
        self,
        names: Sequence[str] = (),
        episodes: int | None = None,
        seed: int | None = None,
        vehicle: str | None = None,
    ) -> "Suite":
        """A suite with some of these scenarios, other numbers of episodes or seeds, or another
        vehicle.

        :param names: of scenarios, or of those whose cells ``vary`` makes; none: all.
        :param vehicle: name, or path of a YAML file, that flies all scenarios; forces and torques
            stay what they are, in N and N m, and references, which are of another vehicle, go.
        :raises ConfigError: an unknown name, a number out of range, a scenario that is impossible
            for the vehicle.
        """
        known = {
            name
            for scenario in self.scenarios
            for name in (scenario.name, scenario.group)
            if name is not None
        }
        for name in names:
            if name not in known:
                raise ConfigError(unknown("scenario", name, known))
        changes: dict[str, Any] = {"episodes": episodes, "seed": seed}
        changes = {key: value for key, value in changes.items() if value is not None}
        if vehicle is not None:
            changes |= {"vehicle": vehicle, "reference": {}}
        changed = []
        for scenario in self.scenarios:
            if names and scenario.name not in names and scenario.group not in names:
                continue
            where = f"scenario {scenario.name}" + (
                "" if vehicle is None else f", flown by {vehicle}"
            )
            changed.append(validate(Scenario, {**scenario.model_dump(), **changes}, where))
        return self.model_copy(update={"scenarios": tuple(changed)})

    @model_validator(mode="after")
    def _unique(self) -> "Suite":
        names = [scenario.name for scenario in self.scenarios]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"scenarios: {name!r} is there twice; names must be unique")
        return self


@cache
def _by_name(vehicle: str) -> Vehicle:
    """A vehicle of the package, read once: suites have many scenarios."""
    return load_vehicle(vehicle)
