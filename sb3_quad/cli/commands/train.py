"""``train``: one training run, and its agent beside the expert at the end; or a pipeline of several."""

import argparse
import time
from pathlib import Path
from typing import Any

import torch

from sb3_quad.algorithms.networks import share_out
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.imports import import_packages
from sb3_quad.base.seeds import seed_for
from sb3_quad.base.validate import validate
from sb3_quad.cli.arguments.train import DEFAULT_ALGO, DEFAULT_ENV, DEFAULT_PIPELINE
from sb3_quad.cli.compare import agent_and_expert, print_tables
from sb3_quad.cli.next_commands import print_next
from sb3_quad.cli.output import console, shows_progress
from sb3_quad.cli.parser import given
from sb3_quad.controllers.resolve import DEFAULT_EXPERT, resolve_expert
from sb3_quad.controllers.zips import load_model
from sb3_quad.training.config import TrainingConfig, load_config
from sb3_quad.training.job import TrainingJob, describe
from sb3_quad.training.pipeline import (
    REFERENCE,
    PipelineResult,
    is_pipeline,
    is_pipeline_run,
    load_pipeline,
    resume_pipeline,
    run_pipeline,
    with_reference,
    with_settings,
)
from sb3_quad.training.runs import open_run
from sb3_quad.training.trainer import TrainingResult, resume, train

KEPT_BY_RESUME = (
    *("algo", "env", "conf_file", "n_timesteps", "n_envs", "vec_env", "expert", "hyperparams", "env_kwargs"),
    *("eval_env_kwargs", "trained_agent", "log_folder", "seed"),
)
FRESH_EPISODES = 960  # in each table of a pipeline
THESIS_COLUMNS = ("expert", "IL-agent", "RL-agent", REFERENCE.name)


def run(options: argparse.Namespace) -> int:
    """Train, compare, tell where everything is. Returns the exit code."""
    if isinstance(options.seed, list):
        return _sweep(options)
    prepare(options)
    start = time.perf_counter()
    arguments = {**given(options, *TrainingJob.model_fields), "progress": shows_progress(options.progress)}
    if options.resume is not None:
        for name in [*given(options, *KEPT_BY_RESUME), *["reference"] * options.reference]:
            raise ConfigError(f"--resume keeps the run's own settings; leave --{name.replace('_', '-')} away")
        folder = Path(options.resume)
        if is_pipeline_run(folder):
            return _finish_stages(resume_pipeline(folder, **arguments), start)
        return _finish(resume(options.resume, **arguments))
    arguments["unique"] = options.uuid
    conf_file = options.conf_file or (DEFAULT_PIPELINE if options.algo is None and options.env is None else None)
    if conf_file is not None and is_pipeline(conf_file):
        for flag, value in (("-n", options.n_timesteps), ("-i", options.trained_agent)):
            if value is not None:
                own = f"a pipeline's stages have their own in {conf_file}"
                raise ConfigError(f"{flag} goes with a single run (--algo, --env); {own}")
        pipeline = with_settings(load_pipeline(conf_file), _changed_settings(options))
        pipeline = with_reference(pipeline) if options.reference else pipeline
        return _finish_stages(run_pipeline(pipeline, arguments, Path(conf_file).stem), start)
    if options.reference:
        raise ConfigError("--reference goes with a pipeline, such as train without --algo and --env")
    job = validate(TrainingJob, {"config": make_config(options), **arguments}, "command line")
    print(describe(job))
    return _finish(train(job))


def _sweep(options: argparse.Namespace) -> int:
    """Several seeds, one configuration. Returns the exit code."""
    from sb3_quad.cli.commands import sweep  # only where it is asked for
    from sb3_quad.sweep.spec import SweepSpec

    for name in ("resume", "reference", "uuid", "tensorboard_log", "num_threads", "verbose", "log_interval"):
        if getattr(options, name):
            raise ConfigError(f"--{name.replace('_', '-')} goes with one seed; several make a sweep, docs/sweeps.md")
    names = ("algo", "env", "conf_file", "trained_agent", "seed", "hyperparams", "n_timesteps", "n_envs", "vec_env", "expert")
    others = ("env_kwargs", "eval_env_kwargs", "device", "eval_freq", "eval_episodes", "n_eval_envs", "save_freq")
    data = {"name": "train", **given(options, *names, *others, "snapshot_every"), "gym_packages": options.gym_packages}
    spec = validate(SweepSpec, sweep.with_defaults(data), "command line")
    defaults = {"dry_run": False, "workers": None, "executor": "local", "address": None}
    options.log_folder = options.log_folder or "logs"
    return sweep.run_spec(argparse.Namespace(**{**vars(options), **defaults}), spec)


def prepare(options: argparse.Namespace) -> None:
    """Import further environments, set the number of threads.

    :raises ConfigError: a module that cannot be imported.
    """
    import_packages(options.gym_packages, "--gym-packages")
    if options.num_threads is None:
        share_out()
    else:
        torch.set_num_threads(options.num_threads)


def make_config(options: argparse.Namespace) -> TrainingConfig:
    """The settings that a command line describes."""
    algo, env_id = options.algo or DEFAULT_ALGO, options.env or DEFAULT_ENV
    return load_config(algo, env_id, options.conf_file, _changed_settings(options))


def _changed_settings(options: argparse.Namespace) -> dict[str, Any]:
    return {**(options.hyperparams or {}), **given(options, "n_timesteps", "n_envs", "vec_env", "expert", "env_kwargs")}


def _finish(result: TrainingResult) -> int:
    """Print the table of a single run's agent, tell where everything is. Returns the exit code."""
    if result.exit_code != 0:
        return result.exit_code
    told = f"trained in {result.seconds:.1f} s"
    if result.job.config.task is not None:
        start = time.perf_counter()
        console().print(agent_and_expert(result.job, result.model))
        told += f", flown for this table in {time.perf_counter() - start:.1f} s"
    print(told)
    print(f"saved in {result.run.path}: {', '.join(sorted(entry.name for entry in result.run.path.iterdir()))}")
    print_next(result.run)
    return 0


def _finish_stages(result: PipelineResult, start: float) -> int:
    """Print both tasks' tables, tell where everything is. Returns the exit code.

    :param start: when the pipeline began, s.
    """
    if result.exit_code != 0:
        return result.exit_code
    seconds, config = time.perf_counter() - start, result.job.config
    times = {name: entry.seconds for name, entry in result.stages.items()}
    controllers = {"expert": resolve_expert(config.expert or DEFAULT_EXPERT, result.job.flight_settings.vehicle)}
    controllers |= {name: load_model(entry.agent) for name, entry in result.stages.items()}
    how = result.job.flight_settings.in_any_task()
    print_tables(controllers, how, FRESH_EPISODES, seed_for("table", result.job.seed), THESIS_COLUMNS)
    print("; ".join(f"{name}: {value:.0f} s" for name, value in times.items()) + f"; in all: {seconds:.0f} s")
    for name, entry in result.stages.items():
        print(f"{name}: {entry.agent}")
    print(f"saved in {result.folder}")
    print_next(open_run([entry for name, entry in result.stages.items() if name != REFERENCE.name][-1].run))
    return 0
