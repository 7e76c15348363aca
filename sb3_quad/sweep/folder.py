"""The files of a sweep; every file appears whole or not at all.

A sweep's folder holds

- ``sweep.yaml``, the sweep as given; ``plan.json``, a :class:`Sweep`: its runs with all their
  settings;
- ``runs/<configuration>/seed_<k>/``, folders as ``train`` leaves them;
- ``records/<configuration>/seed_<k>.json``, a :class:`RunResult` of each run that ended;
- ``results.csv``, ``results.json``, ``report.md``, ``curves.png``: the measurements.
"""

from pathlib import Path
from typing import Literal

import yaml
from pydantic import ConfigDict, Field

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import write_text
from sb3_quad.base.validate import Frozen, read_record
from sb3_quad.evaluation.scenarios.scenario import Suite
from sb3_quad.sweep.runs import Run
from sb3_quad.sweep.spec import SweepSpec

PLAN = "plan.json"
RECORDS = "records"


class RunResult(Frozen):
    """The end of a run."""

    # A file has null for NaN.
    model_config = ConfigDict(allow_inf_nan=True)

    name: str
    state: Literal["finished", "failed"]
    message: str = ""
    """why it failed, in one line"""
    agent: str = ""
    """the zip that flew, relative to the run's folder"""
    timesteps: int = 0
    seconds: float = 0.0
    """wall-clock time of the training; if the run was resumed, since then"""
    flights: dict[str, dict[str, list[float | None]]] = {}
    """by scenario and measure, a number for each episode, the same episodes in every run: success
    and survival 0 or 1; reward the sum; final_error in m (NaN: crashed or out of range); time in s
    to the tightest tolerance, or until stable if it starts at its target (NaN: never)
    """


class Sweep(Frozen):
    """A sweep with the contents of its files; resuming does not read the settings files again."""

    spec: SweepSpec
    runs: list[Run] = Field(min_length=1)
    suite: Suite | None = None


def write_sweep(folder: Path, sweep: Sweep) -> None:
    """Write a sweep, before its first run."""
    write_text(
        folder / "sweep.yaml",
        yaml.safe_dump(sweep.spec.model_dump(mode="json", exclude_defaults=True), sort_keys=False),
    )
    write_text(folder / PLAN, sweep.model_dump_json(indent=1) + "\n")


def read_sweep(folder: Path) -> Sweep:
    """Read the sweep in a folder.

    :raises ConfigError: a folder that holds no sweep, or a damaged file.
    """
    if not (folder / PLAN).is_file():
        raise ConfigError(f"sweep folder {folder}: holds no sweep ({PLAN} is missing)")
    return read_record(folder / PLAN, Sweep)


def write_result(folder: Path, result: RunResult) -> None:
    """Write the result of a run that ended."""
    write_text(folder / RECORDS / f"{result.name}.json", result.model_dump_json() + "\n")


def read_results(folder: Path) -> dict[str, RunResult]:
    """Read the results of all runs that ended, by name."""
    results = [read_record(path, RunResult) for path in (folder / RECORDS).rglob("*.json")]
    return {result.name: result for result in results}
