"""The files of a sweep; every file appears whole or not at all.

A sweep's folder holds

- ``sweep.yaml``, what was asked for; ``plan.json``, a :class:`Sweep`: its runs with all their
  settings;
- ``runs/<configuration>/seed_<k>/``, folders as ``train`` leaves them;
- ``records/<configuration>/seed_<k>.json``, a :class:`RunResult` of each run that ended;
- ``results.csv``, ``results.json``, ``report.md``, ``report.html``, ``figures/``: what was
  measured.
"""

from pathlib import Path
from typing import Literal, TypeAlias

import yaml
from pydantic import Field

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import write_text
from sb3_quad.base.types import StrPath
from sb3_quad.base.validate import Frozen, read_record
from sb3_quad.evaluation.scenarios.scenario import Suite
from sb3_quad.sweep.runs import Run
from sb3_quad.sweep.spec import SweepSpec

PLAN = "plan.json"
Numbers: TypeAlias = tuple[float | None, ...]
MEASURES = ("success", "survival", "reward", "final_error", "time")
"""The numbers of an episode: 0 or 1, 0 or 1, sum, m (None: crashed or out of range), s to the
tightest tolerance, or, where it starts at its target, until stable (None: never)."""


class RunResult(Frozen):
    """The end of a run."""

    name: str
    configuration: str
    seed: int
    state: Literal["finished", "failed", "interrupted"]
    message: str = ""
    """why it failed, in one line"""
    agent: str = ""
    """the zip that flew, relative to the run's folder"""
    weights: str = ""
    """SHA-256 of that agent's parameters"""
    timesteps: int = 0
    seconds: float = 0.0
    """wall-clock time of the training; of a run that was resumed, since then"""
    flights: dict[str, dict[str, Numbers]] = {}
    """by scenario and measure, a number for each episode, the same episodes in every run"""


class Sweep(Frozen):
    """A sweep with all that its files say; resuming does not read the settings files again."""

    spec: SweepSpec
    runs: tuple[Run, ...] = Field(min_length=1)
    suite: Suite | None = None


class SweepFolder:
    """The files of a sweep.

    :param path: the folder.
    """

    def __init__(self, path: StrPath) -> None:
        self.path = Path(path)

    def write(self, sweep: Sweep) -> None:
        """Write the sweep, before its first run."""
        spec = sweep.spec.model_dump(mode="json", exclude_defaults=True)
        write_text(self.path / "sweep.yaml", yaml.safe_dump(spec, sort_keys=False))
        write_text(self.path / PLAN, sweep.model_dump_json(indent=1) + "\n")

    def read(self) -> Sweep:
        """Read the sweep.

        :raises ConfigError: a folder that holds no sweep, or a damaged file.
        """
        if not (self.path / PLAN).is_file():
            raise ConfigError(f"sweep folder {self.path}: holds no sweep ({PLAN} is missing)")
        return read_record(self.path / PLAN, Sweep)

    def run(self, run: Run) -> Path:
        """The folder of a run, absolute: files in it name others, which must be found from
        anywhere.
        """
        return self.path.absolute() / "runs" / run.name

    def add(self, result: RunResult) -> None:
        """Write the result of a run that ended."""
        path = self.path / "records" / f"{result.name}.json"
        write_text(path, result.model_dump_json() + "\n")

    def results(self) -> dict[str, RunResult]:
        """Read the results of all runs that ended, by name."""
        results = {}
        for path in (self.path / "records").rglob("*.json"):
            result = read_record(path, RunResult)
            results[result.name] = result
        return results
