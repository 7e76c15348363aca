"""What an evaluation leaves behind, as validated objects: ``results.json`` is one :class:`Results`.

A folder of results holds

- ``results.json``, a :class:`Results`: scenarios, controllers, metrics with their intervals;
- ``episodes.csv``, one line per flight: seed, start, outcome, times, path, final error;
- ``flights/<controller>/<scenario>.json``, an :class:`Entry`, written when its flights are done;
- ``flights/<controller>/<scenario>.npz``, the same flights in numbers, and the sampled trajectories (``flightlog.py``).

A number that does not exist is None, never NaN.
"""

from typing import Any, Literal

from pydantic import Field, model_validator

from sb3_quad.base.validate import Frozen
from sb3_quad.evaluation.scenarios.parts import Vector
from sb3_quad.evaluation.scenarios.scenario import Scenario

SCHEMA_VERSION: Literal[2] = 2
Scaling = Literal["none", "adaptive"]


class Estimate(Frozen):
    """A mean or a share with its 95 % interval: Wilson's for shares, the bootstrap percentiles for means."""

    value: float
    low: float
    high: float
    n: int = Field(description="flights it is taken over")


class Moment(Frozen):
    """Something that a flight comes to, or never does."""

    share: Estimate = Field(description="of the flights that came to it")
    time: Estimate | None = Field(description="mean time until then of those flights, s; None: no flight did")


class Arrival(Moment):
    """Arrival within one tolerance."""

    tolerance: float = Field(description="m")


class Course(Frozen):
    """A course of waypoints."""

    reached: Estimate = Field(description="mean number of waypoints reached")
    completed: Estimate = Field(description="share of the flights that reached all")
    time: Estimate | None = Field(description="mean time until the last waypoint of those flights, s")


class Metrics(Frozen):
    """What one controller reached in one scenario; path and errors are of the flights that were not lost."""

    n: int = Field(description="flights")
    success: Estimate | None = Field(
        default=None,
        description="share that survived and ended at the target; None: flown by version 0.1, which noted survival",
    )
    survival: Estimate = Field(description="share that neither touched the ground nor left the range")
    collisions: int = Field(description="flights that touched the ground")
    out_of_range: int = Field(description="flights that left the range")
    reward: Estimate = Field(description="mean sum of rewards (Eqs. 4.5-4.9)")
    flown: Estimate = Field(description="mean time flown, until lost or the end, s")
    arrivals: list[Arrival] = Field(description="by tolerance, the tightest first")
    path: Estimate | None = Field(description="mean length of the path over the whole episode, m")
    final_error: Estimate | None = Field(description="mean |r - r_T| at the end, m")
    final_error_median: float | None = Field(description="m")
    final_error_95: Estimate | None = Field(default=None, description="its 95 % quantile, m; None in older results, too")
    final_error_max: float | None = Field(description="m")
    final_offset: Vector | None = Field(description="mean r - r_T at the end, world frame, m")
    stabilised: Moment | None = Field(default=None, description="which flights got stable again, and when; older: None")
    sideways: Estimate | None = Field(default=None, description="mean largest distance from the straight way, m")
    course: Course | None = Field(default=None, description="of scenarios with waypoints")

    @model_validator(mode="before")
    @classmethod
    def _of_version_0_1(cls, data: Any) -> Any:
        return data if "survival" in data else {**data, "survival": data["success"], "success": None}


class HitTrial(Frozen):
    """The flights with one factor of the wrenches."""

    factor: float
    survived: Estimate


class HitLimit(Frozen):
    """How large the wrenches of a scenario may get: the factor at which half of the flights are lost."""

    factor: float | None = Field(description="None: more than half survive even the greatest factor tried")
    low: float = Field(description="greatest factor that more than half survive for certain (95 %)")
    high: float | None = Field(description="least factor that fewer than half survive for certain; None: not found")
    force: float = Field(description="largest force of the scenario, N; times the factor is what is survived")
    torque: float = Field(description="largest torque of the scenario, N m")
    trials: list[HitTrial] = Field(description="all factors tried, rising")


class ControllerRecord(Frozen):
    """Who flew."""

    label: str = Field(description="column title; unique in a folder")
    spec: str = Field(description="as given: pid, geometric, the file name of a zip, package.module:factory")
    kind: Literal["expert", "model", "factory"]
    algorithm: str | None = Field(default=None, description="SB3 class that loaded a zip")
    content: str = Field(description="SHA-256 of the zip, or of the source and version of an expert or factory")
    scaling: Scaling = Field(default="none", description="of its observation (4.3.1)")
    offset: Vector | None = Field(
        default=None, description="with adaptive scaling: the position components of μ, measured beforehand, m"
    )


class Entry(Frozen):
    """One controller in one scenario."""

    controller: str = Field(description="label")
    scenario: str = Field(description="name")
    key: str = Field(description="hash of all that the flights depend on: equal keys, equal flights")
    scenario_key: str = Field(description="hash of the part of it that is not the controller")
    seed: int = Field(description="of the scenario; the files tell that of each episode")
    backend: str
    seconds: float = Field(description="wall-clock time it took")
    date: str = Field(default="", description="day on which it was flown, UTC, year-month-day; empty in older results")
    figures: Metrics = Field(description="its metrics, by their name in files")
    hit_limit: HitLimit | None = None
    flights: str = Field(description="path of the .npz, relative to the folder")

    @property
    def metrics(self) -> Metrics:
        """The metrics, which files call figures."""
        return self.figures


class Failure(Frozen):
    """A controller that could not be loaded, or did not get through a scenario."""

    controller: str
    scenario: str | None = Field(description="None: it could not be loaded")
    message: str


class Results(Frozen):
    """A folder of results."""

    schema_version: Literal[2] = SCHEMA_VERSION
    suite: str
    description: str
    source: str = Field(default="reference", description="where the scenarios' reference comes from")
    package_version: str
    controllers: list[ControllerRecord]
    scenarios: list[Scenario]
    entries: list[Entry]
    failures: list[Failure] = Field(default_factory=list)

    @model_validator(mode="before")
    @classmethod
    def _of_version_0_1(cls, data: Any) -> Any:
        if data.get("schema_version") != 1:
            return data
        for scenario in data["scenarios"]:  # whose reference calls survival success
            references = scenario["reference"].items()
            scenario["reference"] = {name: {**each, "success": None, "survival": each["success"]} for name, each in references}
        return {**data, "schema_version": 2}

    def entry(self, controller: str, scenario: str) -> Entry | None:
        """The entry of a controller's label and a scenario's name, None if there is none."""
        return next((each for each in self.entries if each.controller == controller and each.scenario == scenario), None)
