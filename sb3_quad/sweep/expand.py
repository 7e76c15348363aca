"""From a sweep to its runs: every configuration that its grid and list stand for, by every seed,
each checked.
"""

import copy
import itertools
import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import Field

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.literals import put_key
from sb3_quad.base.validate import Frozen, validate
from sb3_quad.controllers.pretrained import agent_path
from sb3_quad.evaluation.scenarios.load import load_suite
from sb3_quad.evaluation.scenarios.scenario import Suite
from sb3_quad.sweep.spec import MAX_RUNS, Configuration, SweepSpec
from sb3_quad.training.options import RunOptions, SettingsOptions
from sb3_quad.training.pipeline import (
    Pipeline,
    Stage,
    is_pipeline,
    load_pipeline,
    stage_jobs,
    with_settings,
)
from sb3_quad.vehicles.vehicle import first_vehicle

NAMED_ALONE = ("algo", "env", "conf_file", "vehicle", "expert")  # whose value says enough
LONGEST = 80  # characters of a name


class Run(Frozen):
    """One training of a sweep: all that a worker needs, with what settings files say in it."""

    name: str = Field(description="configuration/seed_k: its folder under runs/")
    configuration: str
    seed: int
    job: dict[str, Any] = Field(
        description="arguments of TrainingJob, less config, seed and log_folder"
    )
    stages: tuple[Stage, ...] = Field(
        description="of its pipeline, with all their settings; a single run is one of one stage"
    )
    gym_packages: tuple[str, ...] = ()

    @property
    def identity(self) -> dict[str, Any]:
        """Which run it is: what its record begins with."""
        return self.model_dump(include={"name", "configuration", "seed"})


def expand(spec: SweepSpec) -> list[Run]:
    """The runs of a sweep, the seeds of a configuration one after another.

    :raises ConfigError: an empty grid, an unknown key, a setting that does not fit its algorithm,
        two configurations that are called alike, too many runs.
    """
    runs: dict[str, list[Run]] = {}
    for varied, data in _cells(spec):
        configuration = validate(
            Configuration, data, f"configuration {_name(varied)!r}" if varied else "sweep"
        )
        file = (
            Path(configuration.conf_file).with_suffix("").as_posix()
            if configuration.conf_file
            else ""
        )
        called = (
            configuration.name
            or _name(varied)
            or "-".join(filter(None, [configuration.algo, file]))
        )
        name = re.sub(r"[^A-Za-z0-9_.=,+-]+", "-", called).strip("-.,")[:LONGEST] or "run"
        if name in runs:
            raise ConfigError(
                f"two configurations are called {name!r}; give them names, or values that differ"
            )
        try:
            run = _run(configuration, name, spec.gym_packages)
        except ConfigError as error:
            raise ConfigError(f"configuration {name!r}: {error}") from None
        runs[name] = [
            run.model_copy(update={"name": f"{name}/seed_{seed}", "seed": seed})
            for seed in spec.seed
        ]
    return [*itertools.chain.from_iterable(runs.values())]


def suite_of(spec: SweepSpec) -> Suite | None:
    """The scenarios that the agents of a sweep fly; None: fresh episodes of both tasks."""
    asked = spec.evaluation
    if asked.suite is not None:
        return load_suite(asked.suite).with_changes(asked.scenario, asked.episodes, asked.seed)
    if asked.scenario:
        raise ConfigError("evaluation: scenario goes with a suite")
    return None


def _cells(spec: SweepSpec) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """For each configuration, what tells it apart and all its keys."""
    for key, values in spec.grid.items():
        if not isinstance(values, list) or not values:
            raise ConfigError(f"grid: {key}: must be a list of at least one value, not {values!r}")
    count = (
        math.prod(map(len, spec.grid.values())) * max(1, len(spec.configurations)) * len(spec.seed)
    )
    if count > MAX_RUNS:
        raise ConfigError(f"the sweep has {count:,} runs, at most {MAX_RUNS:,} are allowed")
    found = []
    for own in spec.configurations or ({},):
        for values in itertools.product(*spec.grid.values()):
            cell = dict(zip(spec.grid, values, strict=True))
            data = copy.deepcopy(_merged(spec.given, own))
            data.pop("name", None)
            for key, value in cell.items():
                if data.get(outer := key.partition(".")[0]) is None:
                    data.pop(outer, None)  # null in the file
                put_key(data, key, value, f"grid: {key}")
            if own.get("name"):
                data["name"] = ",".join(filter(None, [str(own["name"]), _name(cell)]))
            found.append(({**own, **cell}, data))
    return found


def _merged(shared: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    both = {**shared, **own}
    for key, value in own.items():
        if isinstance(value, Mapping) and isinstance(shared.get(key), Mapping):
            both[key] = {**shared[key], **value}
    return both


def _run(configuration: Configuration, name: str, gym_packages: tuple[str, ...]) -> Run:
    """The run of a configuration, with no seed of its own yet."""
    given = configuration.given
    if configuration.vehicle is not None:
        given["env_kwargs"] = {**(configuration.env_kwargs or {}), "vehicle": configuration.vehicle}
    changes = {
        **configuration.hyperparams,
        **{key: given[key] for key in SettingsOptions.model_fields if key in given},
    }
    if "trained_agent" in given:
        named, given["trained_agent"] = given["trained_agent"], agent_path(given["trained_agent"])
        if not Path(given["trained_agent"]).is_file():
            raise ConfigError(f"trained_agent {named}: no such file")
    job = {key: given[key] for key in RunOptions.model_fields if key in given}
    file = configuration.conf_file
    if file is not None and is_pipeline(file):
        for key in ("algo", "env", "n_timesteps", "trained_agent"):
            if key in given:
                raise ConfigError(
                    f"{key} goes with a single run; the stages of a pipeline have their own in {file}"
                )
        pipeline = with_settings(load_pipeline(file), changes)
    else:
        algo, env = configuration.algo, configuration.env
        if algo is None or env is None:
            missing = "algo" if algo is None else "env"
            raise ConfigError(
                f"{missing} is missing; give algo and env, or a conf_file with the stages of a pipeline"
            )
        pipeline = Pipeline(
            stages=(Stage(name=algo, algo=algo, env=env, conf_file=file, settings=changes),)
        )
    stages = []
    for stage, planned in zip(pipeline.stages, stage_jobs(pipeline, job), strict=True):
        if planned.config.task is not None:
            first_vehicle(planned.flight_settings.vehicle)
        stages.append(
            stage.model_copy(update={"conf_file": None, "settings": planned.config.settings})
        )
    return Run(
        name=name,
        configuration=name,
        seed=0,
        job=job,
        stages=tuple(stages),
        gym_packages=gym_packages,
    )


def _name(varied: Mapping[str, Any]) -> str:
    """What tells a configuration apart, in words: ``pid,learning_rate=0.001``."""
    parts = []
    for key, value in varied.items():
        text = value if isinstance(value, str) else json.dumps(value, default=str)
        parts.append(Path(text).with_suffix("").as_posix() if key == "conf_file" else text)
        if key not in NAMED_ALONE:
            parts[-1] = f"{key.rpartition('.')[2]}={parts[-1]}"
    return ",".join(parts)
