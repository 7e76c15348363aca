"""What an evaluation leaves behind in its folder; every file appears whole or not at all.

- ``results.json``, a :class:`Results`: scenarios, controllers, metrics with their intervals;
- ``episodes.csv``, one line per flight: seed, start, outcome, times, path, final error;
- ``flights/<controller>/<scenario>.npz``, the same flights as arrays, with sampled trajectories (``flightlog.py``);
- ``unfinished.json``, an :class:`Unfinished`, while an evaluation is under way.

A number that does not exist is None, never NaN.
"""

import csv
import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from sb3_quad.base.arrays import Arrays
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import read_arrays, write_text
from sb3_quad.base.validate import Frozen, read_record
from sb3_quad.evaluation.metrics import Metrics
from sb3_quad.evaluation.scenario_flights import HitLimit
from sb3_quad.evaluation.scenarios.parts import Vector
from sb3_quad.evaluation.scenarios.scenario import Scenario

RESULTS, EPISODES, FLIGHTS, UNFINISHED = "results.json", "episodes.csv", "flights", "unfinished.json"
Scaling = Literal["none", "adaptive"]
_TARGET = ("target_x", "target_y", "target_z")
_START = (
    *("start_x", "start_y", "start_z", "start_qw", "start_qx", "start_qy", "start_qz"),
    *("start_vx", "start_vy", "start_vz", "start_rate_x", "start_rate_y", "start_rate_z"),
)


class ControllerRecord(Frozen):
    """Who flew."""

    label: str = Field(description="column title; unique in a folder")
    spec: str = Field(description="as given: pid, geometric, the file name of a zip, package.module:factory")
    kind: Literal["expert", "model", "factory"]
    algorithm: str | None = Field(default=None, description="SB3 class that loaded a zip")
    content: str = Field(description="SHA-256 of the zip, or of the module of an expert or factory")
    scaling: Scaling = Field(default="none", description="of its observation (4.3.1)")
    offset: Vector | None = Field(
        default=None, description="with adaptive scaling: the position components of μ, measured beforehand, m"
    )

    def is_same(self, other: "ControllerRecord") -> bool:
        """Whether it flies as ``other`` does, whatever both are called."""
        return (self.content, self.scaling, self.offset) == (other.content, other.scaling, other.offset)


class Entry(Frozen):
    """One controller in one scenario."""

    controller: str = Field(description="label")
    scenario: str = Field(description="name")
    seed: int = Field(description="of the scenario; the files tell that of each episode")
    backend: str
    seconds: float = Field(description="wall-clock time it took")
    date: str = Field(description="day on which it was flown, UTC, year-month-day")
    metrics: Metrics
    hit_limit: HitLimit | None
    flights: str = Field(description="path of the .npz, relative to the folder")

    @property
    def name(self) -> tuple[str, str]:
        """Scenario and controller."""
        return self.scenario, self.controller


class Failure(Frozen):
    """A controller that could not be loaded, or did not get through a scenario."""

    controller: str
    scenario: str | None = Field(description="None: it could not be loaded")
    message: str


class Results(Frozen):
    """A folder of results."""

    schema_version: Literal[3] = 3
    suite: str
    description: str
    source: str = Field(default="reference", description="where the scenarios' reference comes from")
    package_version: str
    controllers: list[ControllerRecord]
    scenarios: list[Scenario]
    entries: list[Entry]
    failures: list[Failure] = Field(default_factory=list)

    def entry(self, controller: str, scenario: str) -> Entry | None:
        """The entry of a controller's label and a scenario's name, None if there is none."""
        return next((each for each in self.entries if each.name == (scenario, controller)), None)

    def controller(self, label: str) -> ControllerRecord:
        """The record of a controller that has flown."""
        return next(each for each in self.controllers if each.label == label)

    def scenario(self, name: str) -> Scenario:
        """A scenario that has been flown."""
        return next(each for each in self.scenarios if each.name == name)


class Unfinished(Frozen):
    """An evaluation under way: the same command goes on from here after an interruption, no other one."""

    evaluation: str = Field(description="SHA-256 of all that its flights depend on")
    entries: list[Entry]


def load_results(folder: str | Path) -> Results:
    """The ``results.json`` of a folder.

    :raises ConfigError: no such file, a damaged one, or one of another version.
    """
    path = Path(folder) / RESULTS
    if not path.is_file():
        raise ConfigError(f"{path}: no such file; evaluate writes it")
    return read_record(path, Results)


def write_record(path: Path, record: Frozen) -> None:
    """Write a record as JSON.

    :raises ConfigError: a folder that cannot be written, a full disk.
    """
    write_text(path, record.model_dump_json(indent=2) + "\n")


def file_name(label: str) -> str:
    """A label as part of file names."""
    return re.sub(r"[^A-Za-z0-9_.-]+", "_", label).strip("_.") or "_"


def flights_path(controller: str, scenario: str) -> str:
    """Where the flights of a controller's label and a scenario's name lie, relative to the folder."""
    return f"{FLIGHTS}/{file_name(controller)}/{scenario}.npz"


def write_results(folder: Path, results: Results) -> None:
    """Write ``results.json`` and ``episodes.csv``.

    :raises ConfigError: a folder that cannot be written, a full disk, flights that cannot be read.
    """
    flights = [(entry, read_arrays(folder / entry.flights, "episode_")) for entry in results.entries]
    tolerances = sorted({float(value) for _, arrays in flights for value in arrays["episode_tolerances"]})
    waypoints = max((arrays["episode_waypoints"].shape[1] for _, arrays in flights), default=0)
    columns = [
        *("controller", "scenario", "episode", "seed", "outcome", "flown", "reward", "path", "final_error"),
        *(f"time_to_{value:g}" for value in tolerances),
        *("waypoints_reached", *(f"waypoint_{number + 1}" for number in range(waypoints)), *_TARGET, *_START),
    ]
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    for entry, arrays in flights:
        writer.writerows(_rows(entry, arrays))
    write_text(folder / EPISODES, text.getvalue())
    write_record(folder / RESULTS, results)


def _rows(entry: Entry, arrays: Arrays) -> Iterator[dict[str, Any]]:
    """A line of the table for each flight; empty where there is no number."""
    for episode, reached in enumerate(arrays["episode_waypoints"]):
        numbers = {name: arrays[f"episode_{name}"][episode] for name in ("flown", "reward", "path", "final_error")}
        for tolerance, time in zip(arrays["episode_tolerances"], arrays["episode_time_to"][episode], strict=True):
            numbers[f"time_to_{tolerance:g}"] = time
        numbers |= {f"waypoint_{number + 1}": time for number, time in enumerate(reached)}
        numbers |= zip(_TARGET, arrays["episode_target"][episode], strict=True)
        numbers |= zip(_START, arrays["episode_start"][episode], strict=True)
        yield {
            "controller": entry.controller,
            "scenario": entry.scenario,
            "episode": episode,
            **{name: arrays[f"episode_{name}"][episode] for name in ("seed", "outcome")},
            **{name: f"{value:.9g}" if np.isfinite(value) else "" for name, value in numbers.items()},
            "waypoints_reached": int(np.isfinite(reached).sum()),
        }
