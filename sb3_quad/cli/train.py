"""``train``: one training run, and its agent beside the expert at the end."""

from __future__ import annotations

import argparse
import importlib
import random
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_quad.cli.arguments import pairs, whole
from sb3_quad.cli.output import console
from sb3_quad.cli.stages import THESIS_VEHICLE, is_pipeline_run, resume_stages, run_stages
from sb3_quad.errors import ConfigError
from sb3_quad.pretrained_policies import agent_path

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
FRESH_EPISODES = 240
DEFAULT_PIPELINE = "geometric/two_stage.yml"
DEFAULT_ALGO, DEFAULT_ENV = "dagger", "QuadTargetTracking-v0"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The flags of rl-zoo's ``train.py``, with their meanings."""
    add = parser.add_argument
    add("--algo", help=f"algorithm: dagger, ppo_bc or ppo ({DEFAULT_ALGO})")
    add("--env", help=f"environment id ({DEFAULT_ENV}); any id that Gymnasium knows, with --vec-env dummy or subproc")
    add("-conf", "--conf-file", metavar="FILE", help="settings: a YAML file, or one of the package, such as thesis/dagger.yml")
    add("-n", "--n-timesteps", type=whole, metavar="N", help="transitions to train on")
    add("--n-envs", type=whole, metavar="N", help="environments side by side")
    add("--vec-env", metavar="KIND", help="batch (compiled), dummy (PyBullet, one process) or subproc (one process each)")
    add("--expert", metavar="SPEC", help="pid, geometric, path/to/model.zip or package.module:factory")
    add("-params", "--hyperparams", nargs="+", metavar="K:V", help="settings to change, such as n_steps:500")
    add("--env-kwargs", nargs="+", metavar="K:V", help="keywords of the environment, such as noise:0")
    add("--eval-env-kwargs", nargs="+", metavar="K:V", help="the same, for the evaluation's environments only")
    add("--gym-packages", nargs="+", default=[], metavar="MODULE", help="modules that register further environments")
    add(
        "-i",
        "--trained-agent",
        metavar="ZIP",
        help="agent to start from: an SB3 on-policy zip, or a name such as itm-recovery",
    )
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
    for package in options.gym_packages:
        try:
            importlib.import_module(package)
        except ImportError as error:
            raise ConfigError(f"--gym-packages {package}: cannot be imported ({error})") from None
    if options.num_threads is not None:
        _set_threads(options.num_threads)
    if options.resume is not None:
        folder = Path(options.resume)
        changes = _changes(options)
        if is_pipeline_run(folder):
            return resume_stages(folder, changes, options.reference, _say)
        from sb3_quad.training.trainer import resume

        result = resume(options.resume, _say, **changes)
    else:
        from sb3_quad.training.job import describe
        from sb3_quad.training.pipeline import is_pipeline

        conf_file = options.conf_file or (DEFAULT_PIPELINE if options.algo is None and options.env is None else None)
        if conf_file is not None and is_pipeline(conf_file):
            return run_stages(options, conf_file, make_overrides(options), job_arguments(options), _say)
        if options.reference:
            raise ConfigError("--reference goes with a pipeline, such as train without --algo and --env")
        job = make_job(options)
        from sb3_quad.training.trainer import train

        _say(describe(job))
        result = train(job, _say)
    if result.exit_code == 0:
        _finish(result)
    return result.exit_code


def make_job(options: argparse.Namespace) -> TrainingJob:
    """The job that a command line describes."""
    from sb3_quad.training.config import load_config
    from sb3_quad.training.job import TrainingJob

    config = load_config(options.algo or DEFAULT_ALGO, options.env or DEFAULT_ENV, options.conf_file, make_overrides(options))
    return TrainingJob(config, **job_arguments(options))


def make_overrides(options: argparse.Namespace) -> dict[str, Any]:
    """The settings that a command line changes."""
    overrides = pairs(options.hyperparams, "--hyperparams")
    for name in ("n_timesteps", "n_envs", "vec_env", "expert"):
        if getattr(options, name) is not None:
            overrides[name] = getattr(options, name)
    if options.env_kwargs is not None:
        overrides["env_kwargs"] = pairs(options.env_kwargs, "--env-kwargs")
    return overrides


def job_arguments(options: argparse.Namespace) -> dict[str, Any]:
    """The arguments of a job that a command line gives, beside its settings."""
    seed = 0 if options.seed is None else options.seed if options.seed >= 0 else random.SystemRandom().randrange(2**31)
    names = ("log_folder", "device", "trained_agent", "eval_freq", "eval_episodes", "n_eval_envs", "save_freq")
    given = {name: getattr(options, name) for name in (*names, "log_interval", "tensorboard_log", "verbose")}
    if options.trained_agent is not None:
        given["trained_agent"] = agent_path(options.trained_agent)
    given["eval_env_kwargs"] = pairs(options.eval_env_kwargs, "--eval-env-kwargs") or None
    given |= {"seed": seed, "unique": options.uuid, "progress": _progress(options)}
    return {name: value for name, value in given.items() if value is not None}


def _changes(options: argparse.Namespace) -> dict[str, Any]:
    """What a command line changes of a job that is resumed."""
    kept = ("algo", "env", "conf_file", "n_timesteps", "n_envs", "vec_env", "expert", "hyperparams", "env_kwargs")
    for name in (*kept, "eval_env_kwargs", "trained_agent", "log_folder", "seed"):
        if getattr(options, name) is not None:
            raise ConfigError(f"--resume keeps the run's own settings; leave --{name.replace('_', '-')} away")
    names = ("device", "eval_freq", "eval_episodes", "n_eval_envs", "save_freq", "log_interval", "verbose")
    changes = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    return {**changes, "progress": _progress(options)}


def _finish(result: TrainingResult) -> None:
    config = result.job.config
    if config.task is not None:
        start = time.perf_counter()
        table = _compare(result)
        console().print(table)
        _say(f"trained in {result.seconds:.1f} s, flown for this table in {time.perf_counter() - start:.1f} s")
    else:
        _say(f"trained in {result.seconds:.1f} s")
    _say(f"saved in {result.run.path}: {', '.join(sorted(entry.name for entry in result.run.path.iterdir()))}")


def _compare(result: TrainingResult) -> Any:
    """The table of agent and expert over the same fresh episodes."""
    from sb3_quad.evaluation.summary import fly_all
    from sb3_quad.evaluation.tables import TASK_SCENARIOS, comparison
    from sb3_quad.experts.resolve import resolve_expert
    from sb3_quad.scenarios.load import load_suite
    from sb3_quad.training.trainer import FRESH_SEED, for_evaluation

    config = for_evaluation(result.job)
    given = config.env_kwargs
    keywords: dict[str, Any] = {key: given[key] for key in ("vehicle", "noise", "task_kwargs") if key in given}
    if "max_episode_steps" in given:
        keywords["max_steps"] = given["max_episode_steps"]
    expert = resolve_expert(config.expert or "pid", keywords.get("vehicle", "itm"))
    pilots = {"agent": result.model, "expert": expert}
    columns = fly_all(pilots, config.task, FRESH_EPISODES, result.job.seed + FRESH_SEED, **keywords)
    agent = "IL-agent" if config.algo == "dagger" else "RL-agent"
    scenario = load_suite("thesis").scenario(TASK_SCENARIOS[str(config.task)])
    title = f"{config.task}: {FRESH_EPISODES} fresh episodes, the same for both"
    beside = (agent, "expert") if keywords.get("vehicle", THESIS_VEHICLE) == THESIS_VEHICLE else ()
    return comparison(title, columns, scenario, beside)


def _progress(options: argparse.Namespace) -> bool:
    return sys.stderr.isatty() if options.progress is None else bool(options.progress)


def _set_threads(number: int) -> None:
    import torch

    if number < 1:
        raise ConfigError(f"--num-threads {number}: must be at least 1")
    torch.set_num_threads(number)


def _say(line: str) -> None:
    print(line, flush=True)
