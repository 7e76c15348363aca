"""From a sweep to its runs: every configuration that its grid and list stand for, by every seed, each checked."""

import itertools
import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import Field

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.validate import Frozen, validate
from sb3_quad.controllers.pretrained import agent_path
from sb3_quad.evaluation.scenarios.load import load_suite
from sb3_quad.evaluation.scenarios.scenario import Suite
from sb3_quad.sweep.spec import MAX_RUNS, Configuration, SweepSpec
from sb3_quad.training.config import load_config
from sb3_quad.training.job import TrainingJob
from sb3_quad.training.pipeline import Pipeline, is_pipeline, load_pipeline, stage_jobs, with_settings
from sb3_quad.vehicles.vehicle import first_vehicle

NAMED_ALONE = ("algo", "env", "conf_file", "vehicle", "expert")  # whose value says enough
SETTINGS = ("n_timesteps", "n_envs", "vec_env", "expert", "env_kwargs")  # as commands/train puts them over a file's
LONGEST = 80  # characters of a name


class Run(Frozen):
    """One training of a sweep: all that a worker needs, with what settings files say in it."""

    name: str = Field(description="configuration/seed_k: its folder under runs/")
    configuration: str
    seed: int
    job: dict[str, Any] = Field(description="arguments of TrainingJob, less config, seed and log_folder")
    algo: str = ""
    env: str = ""
    settings: dict[str, Any] = Field(default={}, description="of a single run")
    pipeline: Pipeline | None = None
    stem: str = Field(default="", description="of a pipeline's settings file, which names its folder")
    gym_packages: tuple[str, ...] = ()


def expand(spec: SweepSpec) -> list[Run]:
    """The runs of a sweep, the seeds of a configuration one after another.

    :raises ConfigError: an empty grid, an unknown key, a setting that does not fit its algorithm, two configurations that
        are called alike, too many runs.
    """
    cells = _cells(spec)
    if len(cells) * len(spec.seed) > MAX_RUNS:
        raise ConfigError(f"the sweep has {len(cells) * len(spec.seed):,} runs, at most {MAX_RUNS:,} are allowed")
    runs: list[Run] = []
    names: dict[str, Configuration] = {}
    for varied, data in cells:
        configuration = validate(Configuration, data, f"configuration {_name(varied)!r}" if varied else "sweep")
        name = _file_name(configuration.name or _name(varied) or _plain_name(configuration))
        if name in names:
            raise ConfigError(f"two configurations are called {name!r}; give them names, or values that differ")
        names[name] = configuration
        try:
            runs += [_run(configuration, name, seed, spec.gym_packages) for seed in spec.seed]
        except ConfigError as error:
            raise ConfigError(f"configuration {name!r}: {error}") from None
    return runs


def suite_of(spec: SweepSpec) -> Suite | None:
    """The scenarios that the agents of a sweep fly; None: fresh episodes of both tasks."""
    asked = spec.evaluation
    if asked.suite is None:
        if asked.scenario:
            raise ConfigError("evaluation: scenario goes with a suite")
        return None
    return load_suite(asked.suite).with_changes(asked.scenario, asked.episodes, asked.seed)


def _cells(spec: SweepSpec) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """For each configuration, what tells it apart and all its keys."""
    for key, values in spec.grid.items():
        if not isinstance(values, list) or not values:
            raise ConfigError(f"grid: {key}: must be a list of at least one value, not {values!r}")
        if len({json.dumps(value, sort_keys=True, default=str) for value in values}) < len(values):
            raise ConfigError(f"grid: {key}: a value is there twice")
    count = math.prod(len(values) for values in spec.grid.values()) * max(1, len(spec.configurations))
    if count > MAX_RUNS:
        raise ConfigError(f"grid: has {count:,} combinations, at most {MAX_RUNS:,} are allowed")
    found = []
    for own in spec.configurations or ({},):
        for values in itertools.product(*spec.grid.values()):
            cell = dict(zip(spec.grid, values, strict=True))
            data = _merged(spec.shared, own)
            for key, value in cell.items():
                data = _put(data, key, value)
            if own.get("name") and cell:
                data["name"] = f"{own['name']},{_name(cell)}"
            found.append(({**own, **cell}, data))
    return found


def _merged(shared: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    both = {**shared, **own}
    for key, value in own.items():
        if isinstance(value, Mapping) and isinstance(shared.get(key), Mapping):
            both[key] = {**shared[key], **value}
    return both


def _put(data: Mapping[str, Any], key: str, value: Any) -> dict[str, Any]:
    first, dot, rest = key.partition(".")
    if not dot:
        return {**data, key: value}
    inner = data.get(first) or {}
    if not isinstance(inner, Mapping):
        raise ConfigError(f"grid: {key}: {first} holds no keys here")
    return {**data, first: _put(inner, rest, value)}


def _run(configuration: Configuration, name: str, seed: int, gym_packages: tuple[str, ...]) -> Run:
    given = configuration.model_dump(exclude_none=True)
    if configuration.vehicle is not None:
        given["env_kwargs"] = {**configuration.env_kwargs, "vehicle": configuration.vehicle}
    if not given["env_kwargs"]:
        del given["env_kwargs"]
    changes = {**configuration.hyperparams, **{key: given[key] for key in SETTINGS if key in given}}
    if configuration.trained_agent is not None:
        given["trained_agent"] = agent_path(configuration.trained_agent)
        if not Path(given["trained_agent"]).is_file():
            raise ConfigError(f"trained_agent {configuration.trained_agent}: no such file")
    job = {key: given[key] for key in TrainingJob.model_fields if key in given}
    common: dict[str, Any] = {"name": f"{name}/seed_{seed}", "configuration": name, "seed": seed, "gym_packages": gym_packages}
    file = configuration.conf_file
    if file is not None and is_pipeline(file):
        for key in ("algo", "env", "n_timesteps", "trained_agent"):
            if key in given:
                raise ConfigError(f"{key} goes with a single run; the stages of a pipeline have their own in {file}")
        pipeline = with_settings(load_pipeline(file), changes)
        for stage in stage_jobs(pipeline, {**job, "seed": seed}):
            _check_vehicle(stage)
        return Run(**common, job=job, pipeline=pipeline, stem=Path(file).stem)
    if configuration.algo is None or configuration.env is None:
        missing = "algo" if configuration.algo is None else "env"
        raise ConfigError(f"{missing} is missing; give algo and env, or a conf_file with the stages of a pipeline")
    config = load_config(configuration.algo, configuration.env, file, changes)
    _check_vehicle(validate(TrainingJob, {**job, "seed": seed, "config": config}, "its settings"))
    return Run(**common, job=job, algo=config.algo, env=config.env_id, settings=config.settings)


def _check_vehicle(job: TrainingJob) -> None:
    """:raises ConfigError: keywords of the environment that do not fit, a vehicle that cannot be loaded."""
    if job.config.task is not None:
        first_vehicle(job.flight_settings.vehicle)


def _plain_name(configuration: Configuration) -> str:
    file = Path(configuration.conf_file).with_suffix("").as_posix() if configuration.conf_file else ""
    return "-".join(filter(None, [configuration.algo or "", file])) or "run"


def _name(varied: Mapping[str, Any]) -> str:
    parts = []
    for key, value in varied.items():
        text = _word(value)
        parts.append(Path(text).with_suffix("").as_posix() if key == "conf_file" else text)
        if key not in NAMED_ALONE:
            parts[-1] = f"{key.rpartition('.')[2]}={parts[-1]}"
    return ",".join(parts)


def _word(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:g}"
    return value if isinstance(value, str) else json.dumps(value, default=str)


def _file_name(text: str) -> str:
    """A name as a folder's."""
    name = re.sub(r"[^A-Za-z0-9_.=,+-]+", "-", text).strip("-.,") or "run"
    return name[:LONGEST]
