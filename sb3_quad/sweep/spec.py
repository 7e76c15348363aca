"""The settings of a sweep: those that all runs share, a grid or a list of those that differ, and
the seeds.

The terms are rl-zoo's. Keys at the top apply to every configuration; ``grid`` maps keys, dotted for
nested ones, to lists of values. Every combination of them is a configuration, such as ``grid:
{hyperparams.learning_rate: [1e-3, 5e-3]}``; ``configurations`` lists some one by one.
"""

from pathlib import Path
from typing import Annotated

from pydantic import BeforeValidator, Field, NonNegativeFloat, PositiveInt

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.seeds import Seed
from sb3_quad.base.types import StrDict, StrPath
from sb3_quad.base.validate import Frozen, validate
from sb3_quad.base.yaml_files import YamlFolder
from sb3_quad.envs.vehicles.vehicle import NAME
from sb3_quad.training.algorithms import as_list
from sb3_quad.training.config import SETTINGS
from sb3_quad.training.options import RunOptions, SettingsOptions

SWEEPS = YamlFolder("sweep", "sb3_quad.zoo_configs.sweeps", ".yml")


class Configuration(SettingsOptions, RunOptions):
    """The settings of one training, except for its seed; a missing key has the default of
    ``train``.
    """

    name: str | None = Field(default=None, pattern=NAME)
    """in tables and folders; made of the settings that differ without it"""
    algo: str | None = None
    """algorithm of a single run"""
    env: str | None = None
    """environment id of a single run"""
    conf_file: str | None = None
    """settings file, of a single run or of a pipeline"""
    hyperparams: StrDict = {}
    """settings to change, such as n_steps: 500"""
    vehicle: str | None = None
    """env_kwargs' vehicle, by name or YAML file"""

    def given(self, options: type[Frozen]) -> StrDict:
        """Return the keys of some options that have another value than their default."""
        return self.model_dump(include={*options.model_fields}, exclude_defaults=True)


class Resources(Frozen):
    """The resources of a run, for Ray to place it."""

    num_cpus: NonNegativeFloat = 1
    """cores"""
    num_gpus: NonNegativeFloat = 0
    """GPUs"""


class Evaluation(Frozen):
    """The fresh episodes on which all agents are compared."""

    suite: str | None = None
    """name or YAML file; without it, fresh episodes of both tasks"""
    scenario: Annotated[list[str], BeforeValidator(as_list)] = []
    """only these of the suite"""
    episodes: PositiveInt | None = None
    """of each scenario; without a suite 240"""
    seed: Seed | None = None
    """of the episodes"""


class SweepSpec(Configuration):
    """The keys of a sweep's file."""

    seed: Annotated[list[Seed], BeforeValidator(as_list)] = Field(default=[0], min_length=1)
    """one or a list"""
    grid: StrDict = {}
    """keys, each with a list of values"""
    configurations: list[StrDict] = []
    """a list of keys and values each"""
    evaluation: Evaluation = Evaluation()
    """the episodes that the agents fly in the end"""
    resources: Resources = Resources()
    """the resources of a run"""
    gym_packages: list[str] = []
    """modules that register further environments"""


def load_sweep(source: StrPath) -> SweepSpec:
    """Load the sweep in a YAML file, by path or by the name of one in the package.

    :raises ConfigError: an unreadable file, or a key that is unknown or does not fit; a sweep of
        the package if a user's file has the name of one of its settings files.
    """
    data, where = SWEEPS.read(source)
    spec = validate(SweepSpec, {"name": Path(source).stem, **data}, where)
    if SWEEPS.is_path(source):
        return spec
    for own in ({"conf_file": spec.conf_file}, *spec.configurations):
        file = own.get("conf_file")
        if file and SETTINGS.is_path(file):
            raise ConfigError(
                f"{file} in this folder would replace the package's in the sweep {source}; "
                "sweep in another folder"
            )
    return spec
