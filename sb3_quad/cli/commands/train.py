"""``train``: one training run, and its agent beside the expert at the end."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.validate import validate
from sb3_quad.cli.arguments.train import DEFAULT_PIPELINE
from sb3_quad.cli.commands.stages import resume_stages, run_stages
from sb3_quad.cli.compare import agent_and_expert
from sb3_quad.cli.output import console, print_line, shows_progress
from sb3_quad.cli.parser import pairs
from sb3_quad.cli.settings import make_config, make_overrides, make_seed, prepare
from sb3_quad.training.job import TrainingJob, describe
from sb3_quad.training.pipeline import is_pipeline, is_pipeline_run
from sb3_quad.training.trainer import TrainingResult, resume, train


def run(options: argparse.Namespace) -> int:
    """Train, compare, tell where everything is. Returns the exit code."""
    prepare(options)
    if options.resume is not None:
        folder = Path(options.resume)
        changes = _changes(options)
        if is_pipeline_run(folder):
            return resume_stages(folder, changes, options.reference, print_line)
        result = resume(options.resume, print_line, **changes)
    else:
        conf_file = options.conf_file or (DEFAULT_PIPELINE if options.algo is None and options.env is None else None)
        if conf_file is not None and is_pipeline(conf_file):
            return run_stages(options, conf_file, make_overrides(options), job_arguments(options), print_line)
        if options.reference:
            raise ConfigError("--reference goes with a pipeline, such as train without --algo and --env")
        job = make_job(options)
        print_line(describe(job))
        result = train(job, print_line)
    if result.exit_code == 0:
        _finish(result)
    return result.exit_code


def make_job(options: argparse.Namespace) -> TrainingJob:
    """The job that a command line describes."""
    return validate(TrainingJob, {"config": make_config(options), **job_arguments(options)}, "command line")


def job_arguments(options: argparse.Namespace) -> dict[str, Any]:
    """The arguments of a job that a command line gives, beside its settings."""
    names = ("log_folder", "device", "trained_agent", "eval_freq", "eval_episodes", "n_eval_envs", "save_freq")
    given = {name: getattr(options, name) for name in (*names, "log_interval", "tensorboard_log", "verbose")}
    given["eval_env_kwargs"] = pairs(options.eval_env_kwargs, "--eval-env-kwargs") or None
    given |= {"seed": make_seed(options), "unique": options.uuid, "progress": shows_progress(options.progress)}
    return {name: value for name, value in given.items() if value is not None}


def _changes(options: argparse.Namespace) -> dict[str, Any]:
    """What a command line changes of a job that is resumed."""
    kept = ("algo", "env", "conf_file", "n_timesteps", "n_envs", "vec_env", "expert", "hyperparams", "env_kwargs")
    for name in (*kept, "eval_env_kwargs", "trained_agent", "log_folder", "seed"):
        if getattr(options, name) is not None:
            raise ConfigError(f"--resume keeps the run's own settings; leave --{name.replace('_', '-')} away")
    names = ("device", "eval_freq", "eval_episodes", "n_eval_envs", "save_freq", "log_interval", "verbose")
    changes = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    return {**changes, "progress": shows_progress(options.progress)}


def _finish(result: TrainingResult) -> None:
    config = result.job.config
    if config.task is not None:
        start = time.perf_counter()
        console().print(agent_and_expert(result.job, result.model))
        print_line(f"trained in {result.seconds:.1f} s, flown for this table in {time.perf_counter() - start:.1f} s")
    else:
        print_line(f"trained in {result.seconds:.1f} s")
    print_line(f"saved in {result.run.path}: {', '.join(sorted(entry.name for entry in result.run.path.iterdir()))}")
