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
from pathlib import Path
from typing import Any

from pydantic import NonNegativeInt, PositiveInt

from sb3_quad.base.errors import refuse_unknown
from sb3_quad.base.imports import require
from sb3_quad.base.process import StopSignals
from sb3_quad.cli.commands.train import CONF_FILE, SETTINGS_FLAGS, plan, prepare
from sb3_quad.cli.parser import Flags, given, seed
from sb3_quad.training.options import DEFAULT_ALGO

# Episodes per evaluation by --vec-env.
EPISODES = {"batch": 240, "dummy": 48, "subproc": 48}
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
    "--eval-episodes N": (PositiveInt, "episodes per evaluation (batch: 240, else 48)"),
}


def run(options: Namespace) -> int:
    """Search, report, write. Returns the exit code."""
    optuna = require("optuna", "tune", "a search")
    require("cmaes", "tune", "a search")
    from sb3_quad.base.validate import validate
    from sb3_quad.training.config import TrainingJob
    from sb3_quad.training.runs import claim_folder, file_name
    from sb3_quad.training.tune import make_objective, open_study, write_results

    # Processes that share a storage must not propose the same trials.
    sampler_seed = None if options.storage else options.seed
    refuse_unknown("sampler", [options.sampler], optuna.samplers.__all__)
    refuse_unknown("pruner", [options.pruner], optuna.pruners.__all__)
    sampler = getattr(optuna.samplers, options.sampler)(seed=sampler_seed)
    pruner = getattr(optuna.pruners, options.pruner)()
    prepare(options)
    # A search is for the settings of a single run.
    options.algo = options.algo or DEFAULT_ALGO
    stage = plan(options)
    config = stage.load()
    known = given(options, "device", "initial_policy", "n_eval_envs", "seed", "eval_episodes")
    data = {
        "config": config,
        "agent": stage.agent,
        "eval_episodes": EPISODES[config.vec_env],
        **known,
    }
    job = validate(TrainingJob, data, "command line")
    objective = make_objective(job, options.search_space, options.n_evaluations)
    name = options.study_name or f"{config.algo}_{config.env_id}"
    folder = claim_folder(Path(options.log_folder) / "tune" / config.algo, file_name(config.env_id))
    storage = options.storage or f"sqlite:///{folder}/study.db"
    study = open_study(name, storage, objective, sampler, pruner)
    objective.job = job.model_copy(update={"log_folder": str(folder)})
    print("results go to", folder)
    with StopSignals() as signals:

        def after_trial(study: Any, trial: Any) -> None:
            write_results(study, objective, folder)
            end = f"{trial.state.name.lower()}, value {trial.value}, {trial.params}"
            print(f"trial {trial.number}: {end}")
            if signals.received:
                study.stop()

        study.optimize(objective, options.n_trials, catch=(Exception,), callbacks=[after_trial])
        write_results(study, objective, folder)
    best = shlex.quote(f"{folder}/best.yml")
    print(f"to train: sb3-quad train --algo {config.algo} --env {config.env_id} --conf-file {best}")
    print(f"to continue: --storage {shlex.quote(storage)} --study-name {shlex.quote(name)}")
    return signals.exit_code
