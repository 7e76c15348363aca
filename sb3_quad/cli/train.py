"""``train``: one training run, and its agent beside the expert at the end."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_quad.base.errors import ConfigError
from sb3_quad.cli.arguments import pairs, whole
from sb3_quad.cli.compare import agent_and_expert
from sb3_quad.cli.output import console
from sb3_quad.cli.settings import add_settings, make_config, make_overrides, make_seed, prepare, say, shows_progress
from sb3_quad.cli.stages import is_pipeline_run, resume_stages, run_stages

if TYPE_CHECKING:
    from sb3_quad.training.job import TrainingJob
    from sb3_quad.training.trainer import TrainingResult

HELP = "Train an agent. Without arguments: two stages, DAgger from the geometric expert, then PPO with cloning."
EXAMPLES = """examples:
  sb3-quad train                                          both stages, on the batched environment
  sb3-quad train --conf-file two_stage.yml                both stages from the PID expert, as in the thesis
  sb3-quad train --reference                              and PPO alone on the same budget, in the same table
  sb3-quad train --algo dagger                            stage one alone
  sb3-quad train --algo dagger --vec-env subproc --n-envs 8   the same on PyBullet, one process each
  sb3-quad train --seed 1 -P -tb logs/tb                  another seed, progress bar, TensorBoard
  sb3-quad train --conf-file thesis/dagger.yml            Table A.4 as the thesis prints it
  sb3-quad train --hyperparams n_steps:500 learning_rate:lin_5e-4 "policy_kwargs:dict(net_arch=[32, 32])"
  sb3-quad train --env-kwargs noise:0 "task_kwargs:dict(target_distance=15)"
  sb3-quad train --algo ppo_bc --env QuadStateRecovery-v0 -i logs/dagger/QuadStateRecovery-v0_1/trimmed_model.zip
  sb3-quad train --resume logs/dagger/QuadTargetTracking-v0_1
  sb3-quad train --env Pendulum-v1 --conf-file my.yml --expert teacher.zip
"""
DEFAULT_PIPELINE = "geometric/two_stage.yml"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The flags of rl-zoo's ``train.py``, with their meanings."""
    add_settings(parser)
    add = parser.add_argument
    add("--reference", action="store_true", help="with a pipeline: also train PPO alone on the same budget, for comparison")
    add("--resume", metavar="RUN_FOLDER", help="go on with an interrupted run; all its settings are kept")
    add("-f", "--log-folder", metavar="DIR", help="where run folders go (logs)")
    add("-uuid", "--uuid", action="store_true", help="add a UUID to the run folder's name")
    add("--seed", type=int, help="seed (0); negative: a random one, noted in args.yml")
    add("--eval-freq", type=whole, metavar="N", help="transitions between evaluations (250000); below 1: one at the end")
    add("--eval-episodes", type=whole, metavar="N", help="episodes of an evaluation (48); 0: no evaluations")
    add("--n-eval-envs", type=whole, metavar="N", help="environments to evaluate in (batch: one per episode; else 1)")
    add("--save-freq", type=whole, metavar="N", help="transitions between checkpoints (none)")
    add("--log-interval", type=whole, metavar="N", help="rollouts between two tables of --verbose 1 (1)")
    add("-tb", "--tensorboard-log", metavar="DIR", help="folder for TensorBoard")
    add("-P", "--progress", action=argparse.BooleanOptionalAction, help="progress bar (in a terminal: yes)")
    add("--device", help="cpu (default), cuda or auto")
    add("--num-threads", type=whole, metavar="N", help="threads of PyTorch (its own choice)")
    add("--verbose", type=int, choices=(0, 1, 2), help="1: SB3's tables, 2: debugging (0)")


def run(options: argparse.Namespace) -> int:
    """Train, compare, tell where everything is. Returns the exit code."""
    prepare(options)
    if options.resume is not None:
        folder = Path(options.resume)
        changes = _changes(options)
        if is_pipeline_run(folder):
            return resume_stages(folder, changes, options.reference, say)
        from sb3_quad.training.trainer import resume

        result = resume(options.resume, say, **changes)
    else:
        from sb3_quad.training.job import describe
        from sb3_quad.training.pipeline import is_pipeline

        conf_file = options.conf_file or (DEFAULT_PIPELINE if options.algo is None and options.env is None else None)
        if conf_file is not None and is_pipeline(conf_file):
            return run_stages(options, conf_file, make_overrides(options), job_arguments(options), say)
        if options.reference:
            raise ConfigError("--reference goes with a pipeline, such as train without --algo and --env")
        job = make_job(options)
        from sb3_quad.training.trainer import train

        say(describe(job))
        result = train(job, say)
    if result.exit_code == 0:
        _finish(result)
    return result.exit_code


def make_job(options: argparse.Namespace) -> TrainingJob:
    """The job that a command line describes."""
    from sb3_quad.training.job import TrainingJob

    return TrainingJob(make_config(options), **job_arguments(options))


def job_arguments(options: argparse.Namespace) -> dict[str, Any]:
    """The arguments of a job that a command line gives, beside its settings."""
    names = ("log_folder", "device", "trained_agent", "eval_freq", "eval_episodes", "n_eval_envs", "save_freq")
    given = {name: getattr(options, name) for name in (*names, "log_interval", "tensorboard_log", "verbose")}
    given["eval_env_kwargs"] = pairs(options.eval_env_kwargs, "--eval-env-kwargs") or None
    given |= {"seed": make_seed(options), "unique": options.uuid, "progress": shows_progress(options)}
    return {name: value for name, value in given.items() if value is not None}


def _changes(options: argparse.Namespace) -> dict[str, Any]:
    """What a command line changes of a job that is resumed."""
    kept = ("algo", "env", "conf_file", "n_timesteps", "n_envs", "vec_env", "expert", "hyperparams", "env_kwargs")
    for name in (*kept, "eval_env_kwargs", "trained_agent", "log_folder", "seed"):
        if getattr(options, name) is not None:
            raise ConfigError(f"--resume keeps the run's own settings; leave --{name.replace('_', '-')} away")
    names = ("device", "eval_freq", "eval_episodes", "n_eval_envs", "save_freq", "log_interval", "verbose")
    changes = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    return {**changes, "progress": shows_progress(options)}


def _finish(result: TrainingResult) -> None:
    config = result.job.config
    if config.task is not None:
        start = time.perf_counter()
        console().print(agent_and_expert(result.job, result.model))
        say(f"trained in {result.seconds:.1f} s, flown for this table in {time.perf_counter() - start:.1f} s")
    else:
        say(f"trained in {result.seconds:.1f} s")
    say(f"saved in {result.run.path}: {', '.join(sorted(entry.name for entry in result.run.path.iterdir()))}")
