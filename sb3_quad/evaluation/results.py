"""What an evaluation leaves behind in its folder; every file appears whole or not at all.

- ``results.json``, a :class:`Results`: scenarios, controllers, metrics with their intervals;
- ``flights/<controller>/<scenario>.npz``, the flights as arrays, with sampled trajectories
  (``flightlog.py``);
- ``episodes.csv``, at the end, one line per flight: seed, start, outcome, times, path, final error.

A number that does not exist is None, never NaN.
"""

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import read_arrays, write_csv
from sb3_quad.base.validate import Frozen, read_record
from sb3_quad.evaluation.metrics import Metrics
from sb3_quad.evaluation.scenarios.scenario import Scenario

RESULTS, EPISODES, FLIGHTS = "results.json", "episodes.csv", "flights"
WRITTEN = (
    RESULTS,
    EPISODES,
    "report.html",
    "report.md",
)  # what does not outlast the results; the last two by a report
_AXES = {
    "target": ("x", "y", "z"),
    "start": (
        *("x", "y", "z", "qw", "qx", "qy", "qz"),
        *("vx", "vy", "vz", "rate_x", "rate_y", "rate_z"),
    ),
}


class ControllerRecord(Frozen):
    """Who flew."""

    label: str = Field(description="column title; unique in a folder")
    spec: str = Field(
        description="as given: pid, geometric, the file name of a zip, package.module:factory"
    )
    kind: Literal["expert", "model", "factory"]
    algorithm: str | None = Field(default=None, description="SB3 class that loaded a zip")
    content: str | None = Field(default=None, description="SHA-256 of the zip")


class Entry(Frozen):
    """One controller in one scenario."""

    controller: str = Field(description="label")
    scenario: str = Field(description="name")
    seed: int = Field(description="of the scenario; the files tell that of each episode")
    backend: str
    seconds: float = Field(description="wall-clock time it took")
    date: str = Field(description="day on which it was flown, UTC, year-month-day")
    metrics: Metrics
    physical_limit: float | None = Field(
        default=None, description="Scenario.physical_limit, beside the time to stay, s"
    )
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

    schema_version: Literal[4] = 4
    suite: str
    description: str
    source: str = Field(
        default="reference", description="where the scenarios' reference comes from"
    )
    package_version: str
    controllers: list[ControllerRecord]
    scenarios: list[Scenario]
    entries: list[Entry]
    failures: list[Failure] = Field(default_factory=list)
    digest: str = Field(
        default="",
        description="SHA-256 of all that the evaluation depends on: only the same one goes on",
    )
    finished: bool = Field(default=True, description="whether it has come to its end")

    def entry(self, controller: str, scenario: str) -> Entry | None:
        """The entry of a controller's label and a scenario's name, None if there is none."""
        return next((each for each in self.entries if each.name == (scenario, controller)), None)


def load_results(folder: str | Path) -> Results:
    """The ``results.json`` of a folder.

    :raises ConfigError: no such file, a damaged one, or one of another version.
    """
    path = Path(folder) / RESULTS
    if not path.is_file():
        raise ConfigError(f"{path}: no such file; evaluate writes it")
    return read_record(path, Results)


def file_name(label: str) -> str:
    """A label as part of file names."""
    return re.sub(r"[^A-Za-z0-9_.-]+", "_", label).strip("_.") or "_"


def flights_path(controller: str, scenario: str) -> str:
    """Where the flights of a controller's label and a scenario's name lie, relative to the folder."""
    return f"{FLIGHTS}/{file_name(controller)}/{scenario}.npz"


def write_episodes(folder: Path, entries: Iterable[Entry]) -> None:
    """Write ``episodes.csv``, empty where there is no number.

    :raises ConfigError: a folder that cannot be written, a full disk, flights that cannot be read.
    """
    rows = [
        row
        for entry in entries
        for row in _rows(entry, read_arrays(folder / entry.flights, "episode_"))
    ]
    write_csv(folder / EPISODES, dict.fromkeys(name for row in rows for name in row), rows)


def _rows(entry: Entry, arrays: dict[str, Any]) -> list[dict[str, Any]]:
    """A line of the table for each flight."""
    columns = {
        name: arrays[f"episode_{name}"]
        for name in ("seed", "outcome", "flown", "reward", "path", "final_error")
    }
    columns["waypoints_reached"] = np.isfinite(arrays["episode_waypoints"]).sum(axis=1)
    for name, axes in _AXES.items():
        columns |= {
            f"{name}_{axis}": values
            for axis, values in zip(axes, arrays[f"episode_{name}"].T, strict=True)
        }
    for name in ("time_to", "settling_time"):
        times = zip(arrays["episode_tolerances"], arrays[f"episode_{name}"].T, strict=True)
        columns |= {f"{name}_{tolerance:g}": values for tolerance, values in times}
    columns["overshoot"] = arrays["episode_overshoot"]
    columns |= {
        f"waypoint_{number}": values
        for number, values in enumerate(arrays["episode_waypoints"].T, 1)
    }
    return [
        {"controller": entry.controller, "scenario": entry.scenario, "episode": episode}
        | {
            name: str(value)
            if not isinstance(value, np.floating)
            else f"{value:.9g}"
            if np.isfinite(value)
            else ""
            for name, value in zip(columns, row, strict=True)
        }
        for episode, row in enumerate(zip(*columns.values(), strict=True))
    ]
