"""A sweep on the disk: what it is to do, and what is done; every file appears whole or not at all.

A sweep's folder holds

- ``sweep.yaml``, what was asked for; ``plan.json``, a :class:`Plan`: its runs with all their
  settings;
- ``runs/<configuration>/seed_<k>/``, folders as ``train`` leaves them;
- ``records/<configuration>/seed_<k>.json``, a :class:`RunRecord` of each run that ended;
- ``results.csv``, ``results.json``, ``report.md``, ``report.html``, ``figures/``: what was
  measured.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, TypeAlias

import yaml
from pydantic import Field

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import write_text
from sb3_quad.base.validate import Frozen, read_record
from sb3_quad.evaluation.scenarios.scenario import Suite
from sb3_quad.sweep.expand import Run
from sb3_quad.sweep.spec import SweepSpec

PLAN = "plan.json"
Numbers: TypeAlias = tuple[float | None, ...]
SUCCESS, SURVIVAL, REWARD, ERROR, TIME = "success", "survival", "reward", "final_error", "time"
MEASURES = (SUCCESS, SURVIVAL, REWARD, ERROR, TIME)
"""Of an episode: 0 or 1, 0 or 1, sum, m (None: lost), s to the tightest tolerance, or, where it
starts at its target, until stable (None: never)."""


class RunRecord(Frozen):
    """How a run ended."""

    name: str
    configuration: str
    seed: int
    state: Literal["finished", "failed", "interrupted"]
    message: str = Field(default="", description="why it failed, in one line")
    agent: str = Field(default="", description="the zip that flew, relative to the run's folder")
    weights: str = Field(default="", description="SHA-256 of that agent's parameters")
    timesteps: int = 0
    seconds: float = Field(
        default=0.0,
        description="wall-clock time of the training; of a run that was resumed, since then",
    )
    flights: dict[str, dict[str, Numbers]] = Field(
        default={},
        description="by scenario and measure, a number for each episode, the same episodes in every run",
    )


class Plan(Frozen):
    """A resolved sweep; resuming does not reread the settings files."""

    spec: SweepSpec
    runs: tuple[Run, ...] = Field(min_length=1)
    suite: Suite | None = None


class SweepFolder:
    """The files of a sweep.

    :param path: the folder.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.plan = self.path / PLAN

    def write(self, plan: Plan) -> None:
        """Write what the sweep is to do."""
        spec = plan.spec.model_dump(mode="json", exclude_defaults=True)
        write_text(self.path / "sweep.yaml", yaml.safe_dump(spec, sort_keys=False))
        write_text(self.plan, plan.model_dump_json(indent=1) + "\n")

    def read(self) -> Plan:
        """What the sweep is to do.

        :raises ConfigError: a folder that holds no sweep, or a damaged file.
        """
        if not self.path.is_dir():
            raise ConfigError(f"sweep folder {self.path}: no such folder")
        if not self.plan.is_file():
            raise ConfigError(f"sweep folder {self.path}: holds no sweep ({PLAN} is missing)")
        return read_record(self.plan, Plan)

    def run(self, run: Run) -> Path:
        """The folder of a run, absolute: what is written in it names files that are looked for from
        anywhere.
        """
        return self.path.absolute() / "runs" / run.name

    def add(self, record: RunRecord) -> None:
        """Keep the record of a run that ended."""
        write_text(self._record(record.name), record.model_dump_json() + "\n")

    def records(self, runs: Sequence[Run]) -> dict[str, RunRecord]:
        """The records of those runs that ended, by name."""
        return {
            run.name: read_record(self._record(run.name), RunRecord)
            for run in runs
            if self._record(run.name).is_file()
        }

    def _record(self, name: str) -> Path:
        return self.path / "records" / f"{name}.json"
