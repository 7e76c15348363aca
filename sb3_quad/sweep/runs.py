"""The runs of a sweep: every configuration of its grid and list with every seed, each checked."""

import copy
import itertools
import re
from collections.abc import Iterator
from pathlib import Path

from sb3_quad.agents.pretrained import agent_path
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.literals import put_key
from sb3_quad.base.types import StrDict, StrMapping
from sb3_quad.base.validate import Frozen, validate
from sb3_quad.envs.vehicles.vehicle import first_vehicle
from sb3_quad.evaluation.scenarios.load import load_suite
from sb3_quad.evaluation.scenarios.scenario import Suite
from sb3_quad.sweep.spec import Configuration, SweepSpec
from sb3_quad.training.options import RunOptions, SettingsOptions, all_changes
from sb3_quad.training.pipeline import Pipeline, Stage, plan_training, stage_jobs

NAMED_ALONE = ("algo", "env", "conf_file", "vehicle", "expert")  # keys whose value says enough
LONGEST = 80  # characters of a name


class Run(Frozen):
    """One training of a sweep: all that a worker needs, with the contents of settings files."""

    name: str
    """configuration/seed_k: its folder under runs/"""
    configuration: str
    seed: int
    job: StrDict
    """arguments of TrainingJob, less config, seed and log_folder"""
    stages: list[Stage]
    """stages of its pipeline, with all their settings; a single run is a pipeline of one stage"""


def make_runs(spec: SweepSpec) -> list[Run]:
    """Return the runs of a sweep, the seeds of a configuration one after another.

    :raises ConfigError: an empty grid, an unknown key, a setting that does not fit its algorithm,
        two runs with the same name.
    """
    # Every configuration is checked before the first run starts.
    runs = {}
    for label, data in _cells(spec):
        where = f"configuration {label!r}"
        configuration = validate(Configuration, data, where)
        name = re.sub(r"[^A-Za-z0-9_.=,+-]+", "-", label).strip("-.,")[:LONGEST] or "run"
        try:
            job, stages = _stages(configuration)
        except ConfigError as error:
            raise ConfigError(f"{where}: {error}") from None
        for seed in spec.seed:
            path = f"{name}/seed_{seed}"
            if path in runs:
                raise ConfigError(
                    f"two runs are called {path!r}; "
                    "give configurations names, or values and seeds that differ"
                )
            runs[path] = Run(name=path, configuration=name, seed=seed, job=job, stages=stages)
    return [*runs.values()]


def suite_of(spec: SweepSpec) -> Suite | None:
    """Return the scenarios that the agents of a sweep fly; None: fresh episodes of both tasks."""
    evaluation = spec.evaluation
    if evaluation.suite is not None:
        return load_suite(evaluation.suite).with_changes(
            evaluation.scenario, evaluation.episodes, evaluation.seed
        )
    if evaluation.scenario:
        raise ConfigError("evaluation: scenario goes with a suite")
    return None


def _cells(spec: SweepSpec) -> Iterator[tuple[str, StrDict]]:
    """Yield each configuration: the keys in which it differs, in words, and all its keys."""
    for key, values in spec.grid.items():
        if not isinstance(values, list) or not values:
            raise ConfigError(f"grid: {key}: must be a list of at least one value, not {values!r}")
    # Without a list there is one configuration, that of the shared keys.
    for own in spec.configurations or ({},):
        for values in itertools.product(*spec.grid.values()):
            cell = dict(zip(spec.grid, values, strict=True))
            data = spec.given(Configuration)
            # The entries of mappings are merged, such as those of env_kwargs.
            for key, value in [*own.items(), *cell.items()]:
                if isinstance(value, dict) and isinstance(data.get(key), dict):
                    value = data[key] | value
                put_key(data, key, copy.deepcopy(value), f"configuration: {key}")
            # A named configuration keeps its name in each cell of the grid.
            label = [str(own.get("name") or _in_words(own)), _in_words(cell)]
            # If nothing differs, the file or the algorithm says what is trained.
            alone = data.get("conf_file") or data.get("algo") or "run"
            yield ",".join(filter(None, label)) or str(alone), data


def _stages(configuration: Configuration) -> tuple[StrDict, list[Stage]]:
    """Return the job of a configuration's runs and their stages, with all settings."""
    job = configuration.given(RunOptions)
    # The agent that the training starts from, as a path that workers find.
    if configuration.initial_policy is not None:
        job["initial_policy"] = agent_path(configuration.initial_policy)
        if not Path(job["initial_policy"]).is_file():
            raise ConfigError(f"initial_policy {configuration.initial_policy}: no such file")
    changes = all_changes(configuration.hyperparams, configuration.given(SettingsOptions))
    if configuration.vehicle is not None:
        if "vehicle" in changes.get("env_kwargs", {}):
            raise ConfigError(
                f"vehicle {configuration.vehicle}: env_kwargs have one, too; remove one"
            )
        put_key(changes, "env_kwargs.vehicle", configuration.vehicle, "vehicle")
    plan = plan_training(configuration.given(Configuration), changes)
    # A single run is a pipeline of one stage.
    pipeline = Pipeline(stages=[plan]) if isinstance(plan, Stage) else plan
    # Resolve all settings now, so that later changes of files do not matter.
    stages = []
    for stage, planned in zip(pipeline.stages, stage_jobs(pipeline, job), strict=True):
        if planned.config.task is not None:
            first_vehicle(planned.flight_settings.vehicle)  # refuses an unknown one
        planned.config.make_expert()
        stages.append(
            stage.model_copy(update={"conf_file": None, "settings": planned.config.settings})
        )
    return job, stages


def _in_words(varied: StrMapping) -> str:
    """Return the keys in which a configuration differs as words: ``pid,learning_rate=0.001``."""
    words = []
    for key, value in varied.items():
        word = str(value)
        if key not in NAMED_ALONE:
            word = f"{key.rpartition('.')[2]}={word}"
        words.append(word)
    return ",".join(words)
