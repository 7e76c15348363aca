"""``train``: one training run, and its agent beside the expert at the end; or a pipeline of several."""

from __future__ import annotations

import argparse
import importlib
import random
import time
from pathlib import Path
from typing import Any

import torch

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.validate import validate
from sb3_quad.cli.arguments.train import DEFAULT_ALGO, DEFAULT_ENV, DEFAULT_PIPELINE
from sb3_quad.cli.commands.stages import finish_stages
from sb3_quad.cli.compare import agent_and_expert
from sb3_quad.cli.output import console, print_line, shows_progress
from sb3_quad.cli.parser import given, pairs
from sb3_quad.settings.config import TrainingConfig, load_config
from sb3_quad.training.job import TrainingJob, describe
from sb3_quad.training.pipeline import (
    PipelineResult,
    is_pipeline,
    is_pipeline_run,
    load_pipeline,
    resume_pipeline,
    run_pipeline,
    with_settings,
)
from sb3_quad.training.trainer import resume, train

KEPT_BY_RESUME = (
    *("algo", "env", "conf_file", "n_timesteps", "n_envs", "vec_env", "expert", "hyperparams", "env_kwargs"),
    *("eval_env_kwargs", "trained_agent", "log_folder", "seed"),
)


def run(options: argparse.Namespace) -> int:
    """Train, compare, tell where everything is. Returns the exit code."""
    prepare(options)
    start = time.perf_counter()
    if options.resume is not None:
        changes = _changes(options)
        for name in given(options, *KEPT_BY_RESUME):
            raise ConfigError(f"--resume keeps the run's own settings; leave --{name.replace('_', '-')} away")
        if is_pipeline_run(Path(options.resume)):
            return finish_stages(resume_pipeline(Path(options.resume), print_line, **changes), options.reference, start)
        result = resume(options.resume, print_line, **changes)
    else:
        conf_file = options.conf_file or (DEFAULT_PIPELINE if options.algo is None and options.env is None else None)
        if conf_file is not None and is_pipeline(conf_file):
            return finish_stages(_train_stages(options, conf_file), options.reference, start)
        if options.reference:
            raise ConfigError("--reference goes with a pipeline, such as train without --algo and --env")
        job = validate(TrainingJob, {"config": make_config(options), **_job_arguments(options)}, "command line")
        print_line(describe(job))
        result = train(job, print_line)
    if result.exit_code != 0:
        return result.exit_code
    told = f"trained in {result.seconds:.1f} s"
    if result.job.config.task is not None:
        start = time.perf_counter()
        console().print(agent_and_expert(result.job, result.model))
        told += f", flown for this table in {time.perf_counter() - start:.1f} s"
    print_line(told)
    print_line(f"saved in {result.run.path}: {', '.join(sorted(entry.name for entry in result.run.path.iterdir()))}")
    return 0


def _train_stages(options: argparse.Namespace, conf_file: str) -> PipelineResult:
    for flag, value in (("-n", options.n_timesteps), ("-i", options.trained_agent)):
        if value is not None:
            own = f"a pipeline's stages have their own in {conf_file}"
            raise ConfigError(f"{flag} goes with a single run (--algo, --env); {own}")
    pipeline = with_settings(load_pipeline(conf_file), _overrides(options))
    return run_pipeline(pipeline, _job_arguments(options), Path(conf_file).stem, print_line)


def prepare(options: argparse.Namespace) -> None:
    """Import further environments, set the number of threads.

    :raises ConfigError: a module that cannot be imported, a number below one.
    """
    for package in options.gym_packages:
        try:
            importlib.import_module(package)
        except ImportError as error:
            raise ConfigError(f"--gym-packages {package}: cannot be imported ({error})") from None
    if options.num_threads is not None:
        if options.num_threads < 1:
            raise ConfigError(f"--num-threads {options.num_threads}: must be at least 1")
        torch.set_num_threads(options.num_threads)


def make_config(options: argparse.Namespace) -> TrainingConfig:
    """The settings that a command line describes."""
    return load_config(options.algo or DEFAULT_ALGO, options.env or DEFAULT_ENV, options.conf_file, _overrides(options))


def _overrides(options: argparse.Namespace) -> dict[str, Any]:
    """The settings that a command line changes."""
    changes = pairs(options.hyperparams, "--hyperparams") | given(options, "n_timesteps", "n_envs", "vec_env", "expert")
    if options.env_kwargs is not None:
        changes["env_kwargs"] = pairs(options.env_kwargs, "--env-kwargs")
    return changes


def make_seed(options: argparse.Namespace) -> int:
    """The seed that is asked for: 0 by default, a random one for a negative one."""
    if options.seed is None:
        return 0
    return options.seed if options.seed >= 0 else random.SystemRandom().randrange(2**31)


def _job_arguments(options: argparse.Namespace) -> dict[str, Any]:
    """The arguments of a job that a command line gives, beside its settings."""
    arguments = given(options, "log_folder", "trained_agent", "tensorboard_log") | _changes(options)
    if options.eval_env_kwargs:
        arguments["eval_env_kwargs"] = pairs(options.eval_env_kwargs, "--eval-env-kwargs")
    return {**arguments, "seed": make_seed(options), "unique": options.uuid}


def _changes(options: argparse.Namespace) -> dict[str, Any]:
    """Those that a run can be resumed with."""
    names = ("device", "eval_freq", "eval_episodes", "n_eval_envs", "save_freq", "log_interval", "verbose")
    return {**given(options, *names), "progress": shows_progress(options.progress)}
