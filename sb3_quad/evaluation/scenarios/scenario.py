"""A scenario: one way to judge a controller, flown many times; and a suite of them."""

from collections.abc import Sequence
from functools import cache
from typing import Annotated

import numpy as np
from pydantic import AfterValidator, Field, PositiveFloat, field_validator, model_validator

from sb3_quad.base.errors import refuse_unknown
from sb3_quad.base.seeds import Seed, row_seeds, seed_for
from sb3_quad.base.types import StrDict
from sb3_quad.base.validate import Frozen, Share, validate
from sb3_quad.envs.batch_env import Vector
from sb3_quad.envs.simulation.randomization import Randomization
from sb3_quad.envs.simulation.recordings import Recording
from sb3_quad.envs.simulation.references import Reference
from sb3_quad.envs.simulation.settings import Action, FlightSettings, Noise
from sb3_quad.envs.simulation.tasks import T, Task, resolve_tasks
from sb3_quad.envs.simulation.vehicle_distribution import VehicleDistribution
from sb3_quad.envs.vehicles.vehicle import VEHICLES, Vehicle, first_vehicle, load_vehicle
from sb3_quad.evaluation.scenarios.events import Start, Wrench

# m: the tolerances of Figs. 4.6 and 4.7, and a tighter one
TOLERANCES = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
NAME = r"^[A-Za-z0-9][A-Za-z0-9_.-]*$"  # is part of file names
DEFAULT_VEHICLE = "itm"
Printed = float | tuple[float, float] | None  # None: not known
# Vehicles of the package are loaded once for the many scenarios of a suite.
_by_name = cache(load_vehicle)


class Published(Frozen):
    """Metrics that others have published, printed next to our own; a pair is a range."""

    success: Printed = None
    """share of flights that end at their target, 0 to 1"""
    survival: Printed = None
    """share that neither crash nor leave the range: the thesis's success"""
    reward: Printed = None
    """mean per episode"""
    time_to: dict[float, Printed] = {}
    """from tolerances in m to mean times in s; null: never within it"""
    path: Printed = None
    """mean length of the path, m"""
    final_error: Printed = None
    """|r - r_T| at the end, m"""
    flown: Printed = None
    """mean time until the flight ended, s"""
    recovery_time: Printed = None
    """mean time until the vehicle was stable again, s"""
    note: str = ""
    """the source's own words"""


class Scenario(Frozen):
    """One way to judge a controller: keywords of the environments, events, and the number of the
    episodes.

    ``task``, ``task_kwargs``, ``vehicle``, ``action``, ``noise``, ``vehicles``, ``randomize``,
    ``reference``, ``wrench`` and ``wind`` are those of
    :class:`~sb3_quad.envs.simulation.settings.FlightSettings`. ``start``, ``target``, ``waypoints``
    and ``wrenches`` are events, which come on top of what the task samples. Units m, s, rad, N,
    N m, kg.
    """

    name: str = Field(pattern=NAME)
    """letters, digits, _ . -; unique in its suite"""
    title: str = ""
    """heading of tables and plots; default: the name"""
    description: str = ""
    """what it tests, and its source"""
    task: str | Task | dict[str, float] = "target_tracking"
    """name of a task or mixture, fields of Task, or mixture {name: weight}"""
    task_kwargs: StrDict | None = None
    """fields of the task to override, such as {target_distance: 15}"""
    vehicle: str | Vehicle | None = None
    """name, or path of a YAML file (relative to the suite's); default: the agent's own, or itm"""
    action: Action = "thrusts"
    """what the actions of experts command; an agent's are those of its training"""
    noise: Noise | Share = 0.05
    """relative std of the observation noise, a share: 0.05 is 5 %; or {relative: …, additive: …,
    estimator: {position: …, …}}; with an estimator, experts see its estimate
    """
    vehicles: VehicleDistribution | None = None
    """each episode has one of these, unknown to the controller, such as {distribution: raptor}"""
    randomize: Randomization | None = None
    """what differs from the vehicle, unknown to the controller, such as {mass: 1.3} or {gusts:
    {std: 1}}
    """
    reference: Reference | None = None
    """how the target moves from there: a curve's name, the path of a CSV file (relative to the
    suite's) or fields of Reference; default: it rests
    """
    wrench: Recording | None = None
    """a log's force and torque: the path of a CSV file (relative to the suite's), t,fx,fy,fz and
    maybe tx,ty,tz; or fields of Recording
    """
    wind: Recording | None = None
    """likewise, a log's velocity of the air: t,vx,vy,vz"""
    start: Start = Start()
    """replaces the task's attitude, velocity or body rates"""
    target: Vector | None = None
    """r_T, world frame, m; default: the task's"""
    waypoints: tuple[Vector, ...] = ()
    """instead, targets one after the other, world frame, m"""
    waypoint_radius: PositiveFloat = 0.5
    """a waypoint counts as reached within this, m"""
    wrenches: tuple[Wrench, ...] = ()
    """external forces and torques"""
    duration: float = Field(default=15.0, gt=0, le=600)
    """length of an episode, s"""
    n_episodes: int = Field(default=240, ge=1, le=1_000_000)
    """number of episodes"""
    seed: Seed = 0
    """each episode derives its own seed from it"""
    tolerances: Annotated[
        tuple[PositiveFloat, ...], AfterValidator(lambda values: tuple(sorted(set(values))))
    ] = Field(default=TOLERANCES, min_length=1)
    """of arrival, |r - r_T|, m"""
    published: dict[str, Published] = {}
    """published metrics, by column title"""

    @field_validator("vehicle")
    @classmethod
    def _read(cls, value: str | Vehicle | None) -> str | Vehicle | None:
        # Load the file now; nothing below reads it again.
        if isinstance(value, str) and VEHICLES.is_path(value):
            return load_vehicle(value)
        return value

    @model_validator(mode="after")
    def _check_flight(self) -> "Scenario":
        vehicle = self.nominal_vehicle()
        if self.steps < 1:
            raise ValueError(f"duration: must be at least a step, {vehicle.control_step:g} s")
        # The settings check their own fields. Of a distribution, the least capable vehicle decides.
        settings = self.settings
        if settings.vehicles is not None:
            vehicle = settings.vehicles.hardest(vehicle)
        if settings.randomize is not None:
            settings.randomize.hardest(vehicle)
            if settings.randomize.sets_wrench and self.wrenches:
                raise ValueError(
                    "randomize: force and torque do not go with wrenches, which replace them"
                )
        for number, wrench in enumerate(self.wrenches):
            acts = wrench.steps(vehicle.control_step, self.steps)
            # It begins and ends between two control steps.
            if acts.start >= min(acts.stop, self.steps):
                raise ValueError(
                    f"wrenches.{number}: must start within the episode of {self.duration:g} s, and"
                    f" last for a control step, {vehicle.control_step:g} s"
                )
        self._check_way(vehicle)
        return self

    def _check_way(self, vehicle: Vehicle) -> None:
        """Check that the way lies above ground, its targets within ``max_distance`` of each
        other.
        """
        if self.target is not None and self.waypoints:
            raise ValueError("waypoints: give them or target, not both")
        tasks, _ = resolve_tasks(self.task, self.task_kwargs)
        points = np.array([tasks[0, T.start_position :][:3], *self.targets])
        lowest = points[:, 2].min()
        if self.reference is not None:
            if self.waypoints or self.reference.function is not None:
                raise ValueError(
                    "reference: must be a curve or file, no function, and goes with no waypoints;"
                    " the curve polynomial has waypoints of its own"
                )
            # Tasks that end by landing may lead through the ground.
            if not tasks[:, T.touchdown_speed].all():
                heights = self.reference.tracks(vehicle.control_step).table[:, 2]
                lowest = min(lowest, points[-1, 2] + heights.min())
        if lowest <= vehicle.collision_radius:
            raise ValueError(
                f"start_position, target, reference: touch the ground at z = {lowest:.3g} m;"
                f" z must exceed {vehicle.collision_radius:g} m"
            )
        farthest = np.linalg.norm(np.diff(points, axis=0), axis=1).max(initial=0.0)
        most = tasks[:, T.max_distance].min()
        if farthest > most:
            raise ValueError(
                f"target: {farthest:.3g} m away, and an episode ends beyond max_distance {most:g} m"
            )

    def nominal_vehicle(self) -> Vehicle:
        """The vehicle that experts are made for: ``randomize`` changes it unknown to them.

        :raises ConfigError: it cannot be loaded.
        """
        if isinstance(self.vehicle, Vehicle):
            return self.vehicle
        return _by_name(self.vehicle or DEFAULT_VEHICLE)

    def flown_by(self, own: FlightSettings | None) -> "Scenario":
        """Return the scenario with an agent's vehicle, unless it names one itself.

        :param own: the agent's settings; None: it has none.

        :raises ConfigError: it is impossible for that vehicle.
        """
        if own is None or self.vehicle is not None:
            return self
        return self.changed({"vehicle": first_vehicle(own.vehicle)})

    def changed(self, changes: StrDict) -> "Scenario":
        """Return the scenario with other values of some keys.

        :raises ConfigError: it is impossible with them.
        """
        return validate(Scenario, self.model_dump() | changes, f"scenario {self.name}")

    def episode_seeds(self) -> list[int]:
        """The seeds of the episodes, for ``reset(seed=…)`` of one environment."""
        return row_seeds(seed_for("suite", self.seed), self.n_episodes)

    @property
    def group(self) -> str:
        """The name until its first dot: what the cells that ``vary`` makes share."""
        return self.name.partition(".")[0]

    @property
    def heading(self) -> str:
        """The title, or the name, of the scenario or its group."""
        text = self.title or self.group
        return text[:1].upper() + text[1:]

    @property
    def steps(self) -> int:
        """Control steps of an episode."""
        return round(self.duration / self.nominal_vehicle().control_step)

    @property
    def settings(self) -> FlightSettings:
        """The settings of the episodes."""
        given = {name: value for name, value in self if name in FlightSettings.model_fields}
        given |= {"vehicle": self.nominal_vehicle(), "max_episode_steps": self.steps}
        return FlightSettings().with_changes(**given)

    @property
    def targets(self) -> tuple[Vector, ...]:
        """The fixed targets, in order; none if the task samples them."""
        return self.waypoints or tuple(filter(None, [self.target]))

    @property
    def has_way(self) -> bool:
        """Whether the target is elsewhere than the start."""
        tasks, _ = resolve_tasks(self.task, self.task_kwargs)
        return bool(self.targets or tasks[:, T.target_distance].any())

    @property
    def physical_limit(self) -> float | None:
        """The least possible mean settling time (0.1 m) of the vehicle, s; None: unknown."""
        tasks, _ = resolve_tasks(self.task, self.task_kwargs)
        distance = float(tasks[0, T.target_distance])
        # It is known only for undisturbed flights from the start of this task.
        known, _ = resolve_tasks("target_tracking", {"target_distance": distance})
        events = self.start != Start() or self.targets or self.wrenches
        world = self.randomize or self.vehicles or self.wrench or self.wind
        changed = events or world or self.reference
        if changed or 0.1 not in self.tolerances or not np.array_equal(tasks, known):
            return None
        return (self.nominal_vehicle().time_optimal or {}).get(distance)


class Suite(Frozen):
    """Scenarios that belong together."""

    name: str = Field(pattern=NAME)
    """letters, digits, _ . -"""
    title: str = ""
    """heading of its report; default: its name"""
    description: str = ""
    """its purpose"""
    source: str = "published"
    """where the published metrics come from; heads their column"""
    scenarios: list[Scenario] = Field(min_length=1)

    def scenario(self, name: str) -> Scenario:
        """Return the scenario of a name.

        :raises ConfigError: an unknown name.
        """
        scenarios = {scenario.name: scenario for scenario in self.scenarios}
        refuse_unknown("scenario", [name], scenarios)
        return scenarios[name]

    def with_changes(
        self,
        names: Sequence[str] = (),
        n_episodes: int | None = None,
        seed: int | None = None,
        vehicle: str | None = None,
    ) -> "Suite":
        """Return a suite of some of these scenarios, with other numbers, seeds or another vehicle.

        :param names: names of scenarios, or of those whose cells ``vary`` makes; none: all.
        :param vehicle: name, or path of a YAML file, that flies all scenarios, also those
            with ``vehicles``. Forces and torques stay the same, in N and N m; published metrics, of
            another vehicle, are removed.
        :raises ConfigError: an unknown name, a number out of range, a scenario that is impossible
            for the vehicle.
        """
        chosen: StrDict = {"n_episodes": n_episodes, "seed": seed, "vehicle": vehicle}
        changes = {key: value for key, value in chosen.items() if value is not None}
        if vehicle is not None:
            changes |= {"vehicles": None, "published": {}}
        known = set[str]()
        changed = []
        for scenario in self.scenarios:
            own = {scenario.name, scenario.group}
            known |= own
            if not names or own & {*names}:
                changed.append(scenario.changed(changes))
        refuse_unknown("scenario", names, known)
        return self.model_copy(update={"scenarios": changed})

    @model_validator(mode="after")
    def _unique(self) -> "Suite":
        names = [scenario.name for scenario in self.scenarios]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"scenarios: {name!r} is there twice; names must be unique")
        return self
