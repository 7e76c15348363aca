"""What a sweep trains: settings that all runs share, a grid or a list of those that differ, and the
seeds.

The words are rl-zoo's. Keys at the top hold for every configuration; ``grid`` maps keys, dotted
where they lie deeper, to lists of values, of which every combination is a configuration, such as
``grid: {hyperparams.learning_rate: [1e-3, 5e-3]}``; ``configurations`` lists some one by one.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, NonNegativeFloat, PositiveInt, model_validator

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.literals import parse_number
from sb3_quad.base.seeds import Seed
from sb3_quad.base.validate import Frozen, validate
from sb3_quad.base.yaml_files import YamlFolder
from sb3_quad.training.classes import as_list
from sb3_quad.training.options import RunOptions, SettingsOptions
from sb3_quad.vehicles.vehicle import NAME

SWEEPS = YamlFolder("sweep", "sb3_quad.zoo_configs.sweeps", ".yml")
MAX_RUNS = 10_000


class Configuration(SettingsOptions, RunOptions):
    """What one training is given, less its seed; what is left out is as for ``train``."""

    name: str | None = Field(
        default=None,
        pattern=NAME,
        description="in tables and folders; made of what differs without it",
    )
    algo: str | None = Field(default=None, description="algorithm of a single run")
    env: str | None = Field(default=None, description="environment id of a single run")
    conf_file: str | None = Field(
        default=None, description="settings file, of a single run or of a pipeline"
    )
    hyperparams: dict[str, Any] = Field(
        default={}, description="settings to change, such as n_steps: 500"
    )
    vehicle: str | None = Field(
        default=None, description="env_kwargs' vehicle, by name or YAML file"
    )

    @model_validator(mode="before")
    @classmethod
    def _parse_numbers(cls, data: Any) -> Any:
        """``1e6`` is a text to YAML."""
        if not isinstance(data, Mapping):
            return data
        options = {*SettingsOptions.model_fields, *RunOptions.model_fields}
        return {
            key: parse_number(value) if key in options else value for key, value in data.items()
        }

    @property
    def given(self) -> dict[str, Any]:
        """The keys that have another value than their default."""
        return self.model_dump(include={*Configuration.model_fields}, exclude_defaults=True)


class Resources(Frozen):
    """What a run takes, for Ray to place it."""

    num_cpus: NonNegativeFloat = Field(default=1, description="cores")
    num_gpus: NonNegativeFloat = Field(default=0, description="GPUs")


class Evaluation(Frozen):
    """The fresh episodes on which all agents are compared."""

    suite: str | None = Field(
        default=None, description="name or YAML file; without it, fresh episodes of both tasks"
    )
    scenario: Annotated[tuple[str, ...], BeforeValidator(as_list)] = Field(
        default=(), description="only these of the suite"
    )
    episodes: PositiveInt | None = Field(
        default=None, description="of each scenario; without a suite 240"
    )
    seed: Seed | None = Field(default=None, description="of the episodes")


class SweepSpec(Configuration):
    """A sweep."""

    seed: Annotated[tuple[Seed, ...], BeforeValidator(as_list)] = Field(
        default=(0,), min_length=1, description="one or a list"
    )
    grid: dict[str, Any] = Field(default={}, description="keys, each with a list of values")
    configurations: tuple[dict[str, Any], ...] = Field(
        default=(), description="a list of keys and values each"
    )
    evaluation: Evaluation = Field(
        default=Evaluation(), description="what the agents fly in the end"
    )
    resources: Resources = Field(default=Resources(), description="what a run takes")
    gym_packages: tuple[str, ...] = Field(
        default=(), description="modules that register further environments"
    )


def load_sweep(source: str | Path) -> SweepSpec:
    """The sweep in a YAML file, by path or by the name of one in the package.

    :raises ConfigError: an unreadable file, or a key that is unknown or does not fit.
    """
    data, where = SWEEPS.read(source)
    spec = validate(SweepSpec, data, where)
    if len(set(spec.seed)) < len(spec.seed):
        raise ConfigError(f"{where}: seed: one is there twice")
    return spec if spec.name else spec.model_copy(update={"name": Path(str(source)).stem})
