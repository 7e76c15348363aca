"""Sweeps: every configuration of a grid or list, trained with every seed by Ray Tune.

A sweep's YAML file has rl-zoo's terms. Keys at the top apply to every configuration;
``configurations`` maps names to the keys in which some differ; ``grid`` maps keys, dotted for
nested ones, to lists of values, and every combination of them is a configuration. A sweep's folder
holds

- ``sweep.yaml``, the sweep as given;
- ``runs/<configuration>/seed_<k>/``, a pipeline's folder, as ``train`` leaves it;
- ``results.csv``, see :mod:`sb3_quad.training.sweep_results`;
- Ray Tune's own files, among them ``tuner.pkl``.
"""

import copy
import itertools
import os
import platform
import re
import sys
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import BeforeValidator, Field, PositiveInt

from sb3_quad.agents.zips import load_model
from sb3_quad.base.errors import ConfigError, named, raised_as
from sb3_quad.base.files import one_line
from sb3_quad.base.imports import require
from sb3_quad.base.literals import put_key
from sb3_quad.base.process import TRUST_VARIABLE, use_cpus
from sb3_quad.base.seeds import Seed
from sb3_quad.base.types import StrDict, StrMapping, StrPath
from sb3_quad.base.validate import Frozen, validate
from sb3_quad.base.yaml_files import YamlFolder
from sb3_quad.evaluation.controllers import ControllerSpec
from sb3_quad.evaluation.evaluate import fly_scenario
from sb3_quad.evaluation.scenarios.load import load_suite
from sb3_quad.evaluation.scenarios.scenario import Suite
from sb3_quad.training.algorithms import as_list
from sb3_quad.training.options import RunOptions, SettingsOptions, all_changes
from sb3_quad.training.pipeline import (
    STATUS_FILE,
    Pipeline,
    Stage,
    plan_training,
    resume_pipeline,
    run_pipeline,
    stage_jobs,
)
from sb3_quad.training.sweep_results import RunFlights, numbers

SWEEPS = YamlFolder("sweep", "sb3_quad.zoo_configs.sweeps", ".yml")
# How often Ray repeats a run that fails, or whose node is lost. It continues from its snapshot.
RETRIES = 2


class Configuration(SettingsOptions, RunOptions):
    """The settings of one training, except for its seed; a missing key has the default of
    ``train``.
    """

    algo: str | None = None
    """algorithm of a single run"""
    env: str | None = None
    """environment id of a single run"""
    conf_file: str | None = None
    """settings file, of a single run or of a pipeline"""
    hyperparams: StrDict = {}
    """settings to change, such as n_steps: 500"""

    def given(self, options: type[Frozen]) -> StrDict:
        """Return the keys of some options that have another value than their default."""
        return self.model_dump(include={*options.model_fields}, exclude_defaults=True)

    def plan(self) -> tuple[Pipeline, StrDict]:
        """Return the pipeline that this trains, a single run as one of one stage, and the options
        of its jobs.

        :raises ConfigError: what cannot be trained, or an agent that could not fly a suite.
        """
        changes = all_changes(self.hyperparams, self.given(SettingsOptions))
        planned = plan_training(self.given(Configuration), changes)
        if isinstance(planned, Stage):
            planned = Pipeline(stages=[planned])
        options = self.given(RunOptions)
        for job in stage_jobs(planned, options):
            config = job.config
            if not config.task or config.env_wrapper or config.vec_env_wrapper:
                raise ConfigError(
                    f"env {config.env_id}: an agent of a sweep flies a suite, so it must be of "
                    "this package, without wrappers; train others with train --seed"
                )
            # This finds an unknown vehicle, too.
            config.make_expert()
        return planned, options


class Evaluation(Frozen):
    """The fresh episodes on which all agents are compared."""

    suite: str = "quick"
    """name or YAML file"""
    scenario: Annotated[list[str], BeforeValidator(as_list)] = []
    """only these of the suite"""
    episodes: PositiveInt | None = None
    """of each scenario"""

    def load(self) -> Suite:
        """Return the scenarios."""
        return load_suite(self.suite).with_changes(self.scenario, self.episodes)


class Sweep(Configuration):
    """The keys of a sweep's file."""

    seed: Annotated[set[Seed], BeforeValidator(as_list)] = Field(default={0}, min_length=1)
    """one or a list"""
    grid: dict[str, Annotated[list[Any], Field(min_length=1)]] = {}
    """keys, each with a list of values"""
    configurations: dict[str, StrDict] = {}
    """names, each with keys and values"""
    evaluation: Evaluation = Evaluation()
    """the episodes that the agents fly in the end"""
    resources: dict[str, float] = {"cpu": 1}
    """what Ray reserves for a run, such as gpu: 1"""


def load_sweep(source: StrPath) -> Sweep:
    """Load the sweep in a YAML file, by path or by the name of one in the package.

    :raises ConfigError: an unreadable file, or a key that is unknown or does not fit.
    """
    return validate(Sweep, *SWEEPS.read(source))


def checked_configurations(sweep: Sweep) -> dict[str, Configuration]:
    """Return the configurations of a sweep by their names, which are names of folders, too.

    :raises ConfigError: an empty grid, an unknown key, a setting that does not fit its algorithm,
        two configurations with the same name.
    """
    sweep.evaluation.load()
    configurations: dict[str, Configuration] = {}
    # Without configurations there is one, that of the shared keys.
    own = sweep.configurations or {"": {}}
    for label, *values in itertools.product(own, *sweep.grid.values()):
        cell = dict(zip(sweep.grid, values, strict=True))
        data = sweep.given(Configuration)
        for key, value in copy.deepcopy(own[label] | cell).items():
            # The entries of mappings are merged, such as those of env_kwargs.
            if isinstance(value, dict) and isinstance(data.get(key), dict):
                value = data[key] | value
            put_key(data, key, value, f"configuration: {key}")
        words = [f"{key.rpartition('.')[2]}={value}" for key, value in cell.items()]
        # Some file systems do not tell capital letters from small ones.
        name = re.sub(r"[^a-z0-9_.=,+-]+", "-", ",".join([label, *words]).lower())
        name = name.strip("-.,") or "run"
        if name in configurations:
            raise ConfigError(f"configuration {name}: there are two; give them other names")
        with named(f"configuration {name}"):
            configurations[name] = validate(Configuration, data, "sweep")
            configurations[name].plan()
    return configurations


def connect_ray(address: str | None) -> Any:
    """Connect to a Ray cluster.

    :param address: ``auto``, ``host:port`` or ``ray://host:port``; None: a cluster on this machine.
    :return: a context manager that disconnects at its end.
    :raises MissingExtra: Ray Tune is not installed.
    :raises ConfigError: no cluster answers at the address.
    """
    require("ray.tune", "ray", "a sweep")
    import ray

    where = (
        f"--address {address}: cannot be used; give auto, host:port or ray://host:port "
        "of a cluster that ray start has started"
    )
    with raised_as(ConfigError, where):
        return ray.init(
            address or "local",
            runtime_env={"env_vars": {TRUST_VARIABLE: os.environ.get(TRUST_VARIABLE, "0")}},
            log_to_driver=False,
            logging_level="ERROR",
        )


def run_sweep(folder: Path, sweep: Sweep, workers: int | None) -> RunFlights:
    """Train and fly all runs of a sweep on the cluster of :func:`connect_ray`, and print why runs
    failed.

    :param folder: the sweep's, which all machines of the cluster see. What Ray Tune has begun in it
        is continued.
    :param workers: number of concurrent runs; None: as many as fit.
    :return: the flights of the finished runs.
    """
    from ray import tune

    folder = folder.absolute()
    configurations = checked_configurations(sweep)
    suite = sweep.evaluation.load()
    trainable = partial(train_run, folder, configurations, suite, os.getcwd())
    trainable = tune.with_resources(trainable, sweep.resources)
    # A sweep that was killed early has no state yet.
    if any(folder.glob("experiment_state-*")):
        tuner = tune.Tuner.restore(str(folder), trainable, resume_errored=True)
    else:
        tuner = tune.Tuner(
            trainable,
            param_space={
                "configuration": tune.grid_search([*configurations]),
                "seed": tune.grid_search(sorted(sweep.seed)),
            },
            tune_config=tune.TuneConfig(max_concurrent_trials=workers),
            run_config=tune.RunConfig(
                name=folder.name,
                storage_path=str(folder.parent),
                failure_config=tune.FailureConfig(max_failures=RETRIES),
            ),
        )
    flights = {}
    for result in tuner.fit():
        run = (result.config["configuration"], result.config["seed"])
        if result.error is not None:
            print(f"failed: {run_name(*run)}: {one_line(result.error)}", file=sys.stderr)
        # A run that was interrupted has none.
        elif "flights" in result.metrics:
            flights[run] = result.metrics["flights"]
    return flights


def run_name(configuration: str, seed: int) -> str:
    """Return the name of a run, which is that of its folder."""
    return f"{configuration}/seed_{seed}"


def train_run(
    folder: Path,
    configurations: dict[str, Configuration],
    suite: Suite,
    home: str,
    choice: StrMapping,
) -> StrDict:
    """Train a run in its folder, or continue it there, and fly its agent.

    :param home: the working directory, in which relative paths make sense.
    :param choice: the ``configuration``, by name, and the ``seed``.
    :return: ``flights``: the numbers of the agent's flights, by scenario and measure.
    :raises ConfigError: a machine that does not see the folder.
    """
    if not folder.is_dir():
        raise ConfigError(
            f"{folder}: not seen by {platform.node()}; a Ray cluster needs a shared disk"
        )
    os.chdir(home)
    # One core for each run, so that the weights are the same on any machine.
    torch.set_num_threads(1)
    use_cpus(1)
    place = folder / "runs" / run_name(**choice)
    place.mkdir(parents=True, exist_ok=True)
    with (place / "log.txt").open("a", buffering=1, encoding="utf-8") as log:
        report = partial(print, file=log)
        begun = next(place.glob(f"*/*/{STATUS_FILE}"), None)
        if begun is not None:
            trained = resume_pipeline(begun.parent, report)
        else:
            pipeline, options = configurations[choice["configuration"]].plan()
            options |= {"seed": choice["seed"], "log_folder": str(place)}
            trained = run_pipeline(pipeline, options, "pipeline", report)
    *_, last = trained.stages.values()
    model = load_model(last.agent)
    spec = ControllerSpec("agent", last.agent)
    flights = {}
    for scenario in suite.scenarios:
        flown = scenario.flown_by(spec.own)
        flights[scenario.name] = numbers(fly_scenario(model, flown, own=spec.observed))
    return {"flights": flights}
