"""The results of an evaluation in its folder; every file is written whole or not at all.

- ``results.json``, a :class:`Results`: scenarios, controllers, metrics with their intervals;
- ``flights/<controller>/<scenario>.npz``, the flights as arrays, with sampled trajectories
  (``flightlog.py``).

A number that does not exist is None, never NaN.
"""

import json
import re
from pathlib import Path
from typing import Annotated, Literal

from pydantic import FailFast

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import read_text
from sb3_quad.base.types import StrPath
from sb3_quad.base.validate import Frozen, validate
from sb3_quad.evaluation.metrics import Metrics
from sb3_quad.evaluation.scenarios.scenario import Scenario
from sb3_quad.evaluation.tables import colours_of

RESULTS = "results.json"
FLIGHTS = "flights"
REPORT = "report.md"
FIGURES = "figures"


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

    schema_version: Literal[12] = 12
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
    text = read_text(path)
    try:
        return validate(Results, json.loads(text), "damaged, or of another version")
    except (ValueError, RecursionError) as error:
        # ValueError: the text is not JSON, or validate() raised its ConfigError.
        raise ConfigError(f"{path}: {error}; name another folder, or remove it") from None


def file_name(label: str) -> str:
    """Return a label as part of file names."""
    return re.sub(r"[^A-Za-z0-9_.-]+", "_", label).strip("_.") or "_"
