"""The results of an evaluation in its folder; every file is written whole or not at all.

- ``results.json``, a :class:`Results`: scenarios, controllers, metrics with their intervals;
- ``flights/<controller>/<scenario>.npz``, the flights as arrays, with sampled trajectories
  (``flightlog.py``);
- ``episodes.csv``, written at the end, one line per flight: seed, start, outcome, times, path,
  final error.

A number that does not exist is None, never NaN.
"""

import re
from collections.abc import Iterable
from itertools import count
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import pandas as pd
from pydantic import FailFast

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import read_arrays, write_text
from sb3_quad.base.types import StrDict, StrPath
from sb3_quad.base.validate import Frozen, read_record
from sb3_quad.evaluation.metrics import Metrics
from sb3_quad.evaluation.scenarios.scenario import Scenario
from sb3_quad.evaluation.tables import colours_of

RESULTS = "results.json"
EPISODES = "episodes.csv"
FLIGHTS = "flights"
# Files that are removed together with the results; a report writes the last two.
REPORT = "report.md"
FIGURES = "figures"
WRITTEN = (RESULTS, EPISODES, REPORT)
# Names of the columns of episodes.csv, for arrays of several numbers
_START = "x y z qw qx qy qz vx vy vz rate_x rate_y rate_z"
_PARTS = {"target": "xyz", "final_offset": "xyz", "start": _START.split()}


class ControllerRecord(Frozen):
    """A controller that flew."""

    label: str
    """column title; unique in a folder"""
    spec: str
    """as given: pid, geometric, the file name of a zip, package.module:factory"""
    kind: Literal["expert", "model", "factory"]
    algorithm: str | None = None
    """SB3 class that loaded a zip"""
    content: str | None = None
    """SHA-256 of the zip"""
    vehicle: str = "itm"
    """name of the vehicle that it flies where a scenario names none"""


class Entry(Frozen):
    """One controller in one scenario."""

    controller: str
    """label"""
    scenario: str
    """name"""
    metrics: Metrics
    physical_limit: float | None = None
    """Scenario.physical_limit of the settling time, s"""
    flights: str
    """path of the .npz, relative to the folder"""


class Results(Frozen):
    """A folder of results."""

    schema_version: Literal[10] = 10
    suite: str
    title: str = ""
    """of the suite"""
    description: str
    source: str = "published"
    """where the scenarios' published metrics come from"""
    package_version: str
    controllers: Annotated[list[ControllerRecord], FailFast()]
    scenarios: Annotated[list[Scenario], FailFast()]
    entries: Annotated[list[Entry], FailFast()] = []
    failures: Annotated[list[str], FailFast()] = []
    """controller, scenario, and what went wrong, in one line each"""

    @property
    def colours(self) -> dict[str, str]:
        """The colours of the controllers in plots, ``#rrggbb``, by label."""
        return colours_of([record.label for record in self.controllers])

    def entry(self, controller: str, scenario: str) -> Entry | None:
        """Return the entry of a controller's label and a scenario's name; None if it failed."""
        for entry in self.entries:
            if (entry.controller, entry.scenario) == (controller, scenario):
                return entry
        return None


def load_results(folder: StrPath) -> Results:
    """Read the ``results.json`` of a folder.

    :raises ConfigError: no such file, a damaged one, or one of another version.
    """
    path = Path(folder) / RESULTS
    if not path.is_file():
        raise ConfigError(f"{path}: no such file; evaluate writes it")
    return read_record(path, Results)


def file_name(label: str) -> str:
    """Return a label as part of file names."""
    return re.sub(r"[^A-Za-z0-9_.-]+", "_", label).strip("_.") or "_"


def write_episodes(folder: Path, entries: Iterable[Entry]) -> None:
    """Write ``episodes.csv``, with empty cells where there is no number.

    :raises ConfigError: a folder that cannot be written, a full disk, flights that cannot be read.
    """
    tables = []
    for entry in entries:
        arrays = read_arrays(folder / entry.flights, "episode_")
        columns: StrDict = {
            "controller": entry.controller,
            "scenario": entry.scenario,
            "episode": range(entry.metrics.n),
            "waypoints_reached": np.isfinite(arrays["episode_waypoints"]).sum(axis=1),
        }
        tolerances = [f"{tolerance:g}" for tolerance in arrays.pop("episode_tolerances")]
        parts = {**_PARTS, "time_to": tolerances, "settling_time": tolerances}
        for key, values in arrays.items():
            name = key.removeprefix("episode_")
            if values.ndim == 1:
                columns[name] = values
                continue
            # An array of several numbers becomes a column for each of them.
            for part, column in zip(parts.get(name, count(1)), values.T, strict=False):
                columns[f"{name}_{part}"] = column
        tables.append(pd.DataFrame(columns))
    # Scenarios differ in tolerances and waypoints, and so in their columns.
    # Nine digits tell any two float32 apart.
    table = pd.concat(tables).to_csv(index=False, float_format="%.9g", lineterminator="\n")
    write_text(folder / EPISODES, table)
