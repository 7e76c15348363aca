r"""Search for hyperparameters by Optuna; the best become a settings file.

Each trial trains an agent with other settings. The first one uses the settings
unchanged.

examples:
  # around the settings in zoo_configs/dagger.yml
  sb3-quad tune --algo dagger -n 250000 --n-trials 30
  # from a trained agent
  sb3-quad tune --algo ppo_bc --env QuadStateRecovery-v0 \
    -i logs/dagger/QuadTargetTracking-v0_1/best_model.zip -n 3e6
  # random search without a pruner
  sb3-quad tune --algo ppo --env QuadStateRecovery-v0 \
    --sampler RandomSampler --pruner NopPruner --seed 1
  # the same command again, or in another terminal, continues the study
  sb3-quad tune --algo dagger --storage sqlite:///study.db
  # your own search space
  sb3-quad tune --algo dagger --search-space my_space.yml \
    --hyperparams n_epochs:4
  # train with the best settings
  sb3-quad train --algo dagger --env QuadTargetTracking-v0 \
    --conf-file logs/tune/dagger/QuadTargetTracking-v0_1/best.yml

Ctrl-C keeps the finished trials. Needs Optuna: pip install '.[tune]' from a
clone.
"""

import shlex
from argparse import Namespace
from functools import partial
from pathlib import Path

from pydantic import NonNegativeInt, PositiveInt

from sb3_quad.base.errors import ConfigError, raised_as
from sb3_quad.base.imports import require
from sb3_quad.cli.commands.train import CONF_FILE, SETTINGS_FLAGS, plan, prepare
from sb3_quad.cli.parser import Flags, given, seed
from sb3_quad.training.options import DEFAULT_ALGO

FLAGS: Flags = {
    **CONF_FILE,
    **SETTINGS_FLAGS,
    "--n-trials N": (
        NonNegativeInt,
        500,
        "trials of this process; 0: only the results (500)",
    ),
    "--sampler NAME": (str, "TPESampler", "Optuna's class that proposes trials (TPESampler)"),
    "--pruner NAME": (
        str,
        "MedianPruner",
        "Optuna's class that stops poor trials early (MedianPruner); NopPruner: none",
    ),
    "--n-evaluations N": (PositiveInt, 10, "evaluations per trial, for the pruner (10)"),
    "--storage WHERE": "URL of a database, or a journal file (study.db in the new folder)",
    "--study-name NAME": "name of the study in the storage (ALGO_ENV)",
    "--search-space FILE": "YAML file of settings to vary (the package's file for the algorithm)",
    "-f --log-folder DIR": (str, "logs", "results go to DIR/tune/ALGO/ENV_N (logs)"),
    "--seed N": (seed, 0, "seed of trainings and sampler, negative for a random one (0)"),
    "--eval-episodes N": (PositiveInt, 240, "episodes per evaluation (240)"),
}


def run(options: Namespace) -> int:
    """Search, report, write. Returns the exit code."""
    optuna = require("optuna", "tune", "a search")
    from sb3_quad.training.runs import claim_folder, file_name
    from sb3_quad.training.tune import (
        load_space,
        open_study,
        train_trial,
        write_results,
    )

    with raised_as(
        ConfigError, f"--sampler {options.sampler} --pruner {options.pruner}: cannot be used"
    ):
        # Processes that share a storage must not propose the same trials.
        sampler_seed = None if options.storage else options.seed
        sampler = getattr(optuna.samplers, options.sampler)(seed=sampler_seed)
        pruner = getattr(optuna.pruners, options.pruner)()
    prepare(options)
    # A search is for the settings of a single run.
    options.algo = options.algo or DEFAULT_ALGO
    stage = plan(options)
    job = stage.job(
        given(options, "device", "initial_policy", "n_eval_envs", "seed", "eval_episodes")
    )
    config = job.config
    space = load_space(options.search_space, config)
    name = options.study_name or f"{config.algo}_{config.env_id}"
    folder = claim_folder(Path(options.log_folder) / "tune" / config.algo, file_name(config.env_id))
    storage = options.storage or f"sqlite:///{folder}/study.db"
    study = open_study(name, storage, sampler=sampler, pruner=pruner)
    print(f"results go to {folder}; to continue:", end=" ")
    print(f"--storage {shlex.quote(storage)} --study-name {shlex.quote(name)}")
    objective = partial(
        train_trial,
        job=job.model_copy(update={"log_folder": str(folder)}),
        space=space,
        n_evaluations=options.n_evaluations,
    )
    try:
        study.optimize(objective, options.n_trials, catch=(Exception,))
    finally:
        write_results(study, config.env_id, folder)
    return 0
