"""Train an agent. Without arguments: DAgger, then PPO with cloning, in random worlds, from an
expert that is told the truth.

examples:
  sb3-quad train                                          both stages in random worlds, in the batched environment
  sb3-quad train --thesis                                 the thesis's method: both stages from its PID expert, in minutes
  sb3-quad train --conf-file nominal/two_stage.yml        both stages for one vehicle in still air
  sb3-quad train --conf-file thesis/two_stage.yml         the thesis's recipe as it prints it; hours
  sb3-quad train --algo dagger --vec-env subproc --n-envs 8   imitation on PyBullet, a process per environment
  sb3-quad train --seed 1 -P -tb logs/tb                  another seed, progress bar, TensorBoard
  sb3-quad train --conf-file thesis/dagger.yml            Table A.4 as the thesis prints it
  sb3-quad train --hyperparams n_steps:500 learning_rate:lin_5e-4 "policy_kwargs:dict(net_arch=[32, 32])"
  sb3-quad train --env-kwargs noise:0 "task_kwargs:dict(target_distance=15)"
  sb3-quad train --algo ppo_bc --env QuadStateRecovery-v0 -i thesis-imitation      stage two from an agent
  sb3-quad train --resume logs/dagger/QuadTargetTracking-v0_1
  sb3-quad train --env Pendulum-v1 --conf-file my.yml --expert teacher.zip
"""

import argparse
import time
from pathlib import Path
from typing import Any

from sb3_quad.base.errors import ConfigError
from sb3_quad.cli.parser import PAIRS, Parser, add_common, add_fields, given, positive, seed
from sb3_quad.controllers.pretrained import agent_path
from sb3_quad.training.options import JobOptions, SettingsOptions

DEFAULT_PIPELINE, THESIS = "two_stage.yml", "thesis.yml"
DEFAULT_ALGO, DEFAULT_ENV = "dagger", "QuadTargetTracking-v0"
KEPT_BY_RESUME = (
    *(
        "algo",
        "env",
        "conf_file",
        "hyperparams",
        "eval_env_kwargs",
        "trained_agent",
        "log_folder",
        "seed",
    ),
    *SettingsOptions.model_fields,
)


def add_settings(parser: Parser) -> None:
    """Add the flags for what is trained, which ``tune`` has as well."""
    add = parser.add_argument
    add("--algo", help=f"algorithm: dagger, ppo_bc, sac_bc, ppo, sac or td3 ({DEFAULT_ALGO})")
    add(
        "--env",
        help=f"environment id ({DEFAULT_ENV}); any id that Gymnasium knows, with --vec-env dummy or subproc",
    )
    file = "settings: a YAML file, or one of the package, such as thesis/dagger.yml (ALGO.yml: still air, PID expert)"
    add("-conf", "--conf-file", metavar="FILE", help=file)
    add_fields(parser, SettingsOptions)
    add("-params", "--hyperparams", help="settings to change, such as n_steps:500", **PAIRS)
    add_fields(
        parser,
        JobOptions,
        "eval_env_kwargs",
        "trained_agent",
        "n_eval_envs",
        "device",
        trained_agent={"type": agent_path},
    )
    add(
        "--num-threads",
        type=positive,
        metavar="N",
        help="threads (the cores; one where PyTorch computes)",
    )
    add(
        "--gym-packages",
        nargs="+",
        default=[],
        metavar="MODULE",
        help="modules that register further environments",
    )
    add_common(parser, "trust", "progress")


def add_arguments(parser: Parser) -> None:
    """Add the flags of rl-zoo's ``train.py``, with their meanings."""
    add_settings(parser)
    add = parser.add_argument
    add("--thesis", action="store_true", help=f"the thesis's method: --conf-file {THESIS}")
    add(
        "--seed",
        type=seed,
        metavar="N",
        help="seed (0); negative: a random one, recorded in args.yml",
    )
    add_fields(
        parser,
        JobOptions,
        "log_folder",
        "uuid",
        "eval_freq",
        "eval_episodes",
        "save_freq",
        "snapshot_every",
    )
    add_fields(
        parser,
        JobOptions,
        "log_interval",
        "tensorboard_log",
        "verbose",
        "track",
        "wandb_project_name",
    )
    add_fields(
        parser,
        JobOptions,
        "wandb_entity",
        "wandb_group",
        "wandb_tags",
        wandb_tags={"nargs": "+", "type": str},
    )
    add(
        "--resume",
        metavar="RUN_FOLDER",
        help="continue an interrupted or killed run with all its settings",
    )


def run(options: argparse.Namespace) -> int:
    """Train, compare, print where everything is. Returns the exit code."""
    from sb3_quad.base.validate import validate
    from sb3_quad.cli.closing import close_pipeline, close_run
    from sb3_quad.cli.output import shows_progress
    from sb3_quad.training import pipeline as stages
    from sb3_quad.training.config import TrainingJob, describe
    from sb3_quad.training.trainer import resume, train

    if options.thesis and (options.conf_file or options.resume):
        raise ConfigError(
            f"--thesis is --conf-file {THESIS}; it goes with neither --conf-file nor --resume"
        )
    options.conf_file = THESIS if options.thesis else options.conf_file
    prepare(options)
    start = time.perf_counter()
    arguments = {
        **given(options, *JobOptions.model_fields),
        "progress": shows_progress(options.progress),
    }
    if options.resume is not None:
        for name in given(options, *KEPT_BY_RESUME):
            raise ConfigError(
                f"--resume keeps the run's own settings; leave --{name.replace('_', '-')} away"
            )
        if stages.is_pipeline_run(Path(options.resume)):
            finished = stages.resume_pipeline(Path(options.resume), **arguments)
            return close_pipeline(finished, time.perf_counter() - start)
        return close_run(resume(options.resume, **arguments))
    conf_file = options.conf_file or (
        DEFAULT_PIPELINE if options.algo is None and options.env is None else None
    )
    if conf_file is not None and stages.is_pipeline(conf_file):
        for name in given(options, "algo", "env", "n_timesteps", "trained_agent"):
            own = f"a pipeline's stages have their own in {conf_file}"
            raise ConfigError(
                f"--{name.replace('_', '-')} goes with a single run (--algo, --env); {own}"
            )
        pipeline = stages.with_settings(stages.load_pipeline(conf_file), changed_settings(options))
        finished = stages.run_pipeline(pipeline, arguments, Path(conf_file).stem)
        return close_pipeline(finished, time.perf_counter() - start)
    job = validate(TrainingJob, {"config": make_config(options), **arguments}, "command line")
    print(describe(job))
    return close_run(train(job))


def prepare(options: argparse.Namespace) -> None:
    """Import further environments, set the number of threads.

    :raises ConfigError: a module that cannot be imported.
    """
    import torch

    from sb3_quad.algorithms.networks.perceptron import use_one_torch_thread
    from sb3_quad.base.imports import import_packages

    import_packages(options.gym_packages, "--gym-packages")
    if options.num_threads is None:
        use_one_torch_thread()
    else:
        torch.set_num_threads(options.num_threads)


def make_config(options: argparse.Namespace) -> Any:
    """The :class:`~sb3_quad.training.config.TrainingConfig` that a command line describes."""
    from sb3_quad.training.config import load_config
    from sb3_quad.training.successor import as_agent

    asked, changes = (
        (options.algo or DEFAULT_ALGO, options.env or DEFAULT_ENV, options.conf_file),
        changed_settings(options),
    )
    config = load_config(*asked, changes)
    if options.trained_agent is None or options.conf_file is not None:
        return config
    return load_config(*asked, as_agent(options.trained_agent, config, changes))


def changed_settings(options: argparse.Namespace) -> dict[str, Any]:
    """What a command line puts over a settings file."""
    return {**(options.hyperparams or {}), **given(options, *SettingsOptions.model_fields)}
