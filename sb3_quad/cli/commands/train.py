r"""Train an agent: DAgger, then the model's gradient, unless you name others.

Without arguments, both stages train with domain randomization, the first one by
a privileged expert.

examples:
  # both stages with domain randomization
  sb3-quad train
  # the thesis's method: both stages from its PID expert, in minutes
  sb3-quad train --thesis
  # both stages for one undisturbed vehicle
  sb3-quad train --conf-file nominal/two_stage.yml
  # the recipe as the thesis prints it; takes hours
  sb3-quad train --conf-file thesis/two_stage.yml
  # Table A.4 as the thesis prints it
  sb3-quad train --conf-file thesis/dagger.yml
  # imitation on PyBullet, with a process for each environment
  sb3-quad train --algo dagger --vec-env subproc --n-envs 8
  # another seed, a progress bar, TensorBoard
  sb3-quad train --seed 1 -P -tb logs/tb
  # other hyperparameters and environment keywords
  sb3-quad train --hyperparams n_steps:500 learning_rate:lin_5e-4 \
    "policy_kwargs:dict(net_arch=[32, 32])"
  sb3-quad train --env-kwargs noise:0 "task_kwargs:dict(target_distance=15)"
  # a minute of the model's gradient, from an agent for any quadcopter to yours
  sb3-quad train -i any-quadcopter --algo apg --env-kwargs vehicle:mine.yaml
  # the RL stage alone, from an imitation agent
  sb3-quad train --algo ppo_bc --env QuadStateRecovery-v0 -i thesis-imitation
  # continue an interrupted run
  sb3-quad train --resume logs/dagger/QuadTargetTracking-v0_1
  # another environment, with an agent as its expert
  sb3-quad train --env Pendulum-v1 --conf-file my.yml --expert teacher.zip
"""

from argparse import Namespace
from pathlib import Path
from typing import Any

from pydantic import PositiveInt

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.types import StrDict
from sb3_quad.cli.parser import (
    PAIRS,
    PROGRESS,
    SEVERAL,
    SWITCH,
    TRUST,
    Flags,
    field_flags,
    given,
    seed,
)
from sb3_quad.training.options import (
    DEFAULT_ALGO,
    DEFAULT_ENV,
    DEFAULT_PIPELINE,
    KEPT_BY_STAGES,
    JobOptions,
    SettingsOptions,
    all_changes,
)

THESIS = "thesis.yml"
# A resumed run has its own values of these.
KEPT_BY_RESUME = (
    "algo",
    "env",
    "hyperparams",
    "initial_policy",
    "log_folder",
    "seed",
    *SettingsOptions.model_fields,
)


# What is trained; tune has these as well.
CONF_FILE: Flags = {
    "-conf --conf-file FILE": (
        "settings: a YAML file, or one of the package, such as thesis/dagger.yml "
        "(ALGO.yml: undisturbed, PID expert)"
    ),
}
SETTINGS_FLAGS: Flags = {
    "--algo": (f"algorithm of a single run: {DEFAULT_ALGO} (default), ppo_bc, apg or ppo"),
    "--env": (
        f"environment id ({DEFAULT_ENV}); "
        "any id that Gymnasium knows, with --vec-env dummy or subproc"
    ),
    "-params --hyperparams": (PAIRS, "settings to change, such as n_steps:500"),
    "--num-threads N": (PositiveInt, "threads (the cores; one where PyTorch computes)"),
    "--gym-packages MODULE": (SEVERAL, [], "modules that register further environments"),
    **TRUST,
    **PROGRESS,
    **field_flags(SettingsOptions),
    **field_flags(JobOptions, "initial_policy", "n_eval_envs", "device"),
}
# The flags of rl-zoo's ``train.py``, with their meanings.
FLAGS: Flags = {
    "settings": {
        **CONF_FILE,
        "--thesis": (
            SWITCH,
            f"the thesis's method: --conf-file {THESIS}",
        ),
        "--resume RUN_FOLDER": "continue an interrupted or killed run with all its settings",
    },
    **SETTINGS_FLAGS,
    **field_flags(JobOptions),
    # These replace what the fields say.
    "--seed N": (seed, "seed (0); negative: a random one, recorded in args.yml"),
    **PROGRESS,
}


def run(options: Namespace) -> int:
    """Train, compare, print where everything is. Returns the exit code."""
    from sb3_quad.cli.closing import close_pipeline, close_run
    from sb3_quad.cli.output import shows_progress
    from sb3_quad.training.trainer import TrainingResult

    job = given(options, *JobOptions.model_fields)
    job["progress"] = shows_progress(options.progress)
    if options.resume is not None:
        for name in given(options, *KEPT_BY_RESUME):
            flag = name.replace("_", "-")
            raise ConfigError(f"--resume keeps the settings of what it resumes; remove --{flag}")
    prepare(options)
    result = _begin(options, job) if options.resume is None else _resume(options.resume, job)
    if isinstance(result, TrainingResult):
        return close_run(result)
    return close_pipeline(result)


def _resume(folder: str, job: StrDict) -> Any:
    """Continue a run or a pipeline, and return its result."""
    from sb3_quad.training.pipeline import STATUS_FILE, resume_pipeline
    from sb3_quad.training.trainer import resume

    if Path(folder, STATUS_FILE).is_file():
        return resume_pipeline(Path(folder), **job)
    return resume(folder, **job)


def _begin(options: Namespace, job: StrDict) -> Any:
    """Train a new run or a new pipeline, and return its result."""
    from sb3_quad.training.config import SETTINGS, describe
    from sb3_quad.training.pipeline import Stage, run_pipeline
    from sb3_quad.training.trainer import train

    if options.thesis:
        options.conf_file = SETTINGS.packaged(THESIS)
    stages = plan(options)
    if isinstance(stages, Stage):
        single = stages.job(job)
        print(describe(single))
        return train(single)
    return run_pipeline(stages, job, Path(options.conf_file or DEFAULT_PIPELINE).stem)


def prepare(options: Namespace) -> None:
    """Import further environments, set the number of threads.

    :raises ConfigError: a module that cannot be imported.
    """
    import torch

    from sb3_quad.base.imports import import_name
    from sb3_quad.fast.perceptron import use_one_torch_thread

    # Environments must be registered before the settings are checked.
    for module in options.gym_packages:
        import_name(module, "--gym-packages")
    if options.num_threads is None:
        use_one_torch_thread()
    else:
        torch.set_num_threads(options.num_threads)


def plan(options: Namespace) -> Any:
    """Return the :class:`~sb3_quad.training.pipeline.Pipeline` of a command line, or the only
    :class:`~sb3_quad.training.pipeline.Stage` of a single run.
    """
    from sb3_quad.training.pipeline import plan_training

    return plan_training(
        given(options, "conf_file", *KEPT_BY_STAGES),
        all_changes(options.hyperparams or {}, given(options, *SettingsOptions.model_fields)),
    )
