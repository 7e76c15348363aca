r"""Search for hyperparameters, and write the best ones as a settings file.

Each trial trains an agent with other settings. The first one uses the settings
unchanged.

examples:
  # around the settings in zoo_configs/dagger.yml
  sb3-quad tune --algo dagger -n 250000 --n-trials 30
  # from a trained agent
  sb3-quad tune --algo ppo_bc --env QuadStateRecovery-v0 \
    -i logs/dagger/QuadTargetTracking-v0_1/best_model.zip -n 3e6
  # random search without a pruner
  sb3-quad tune --algo ppo --env QuadStateRecovery-v0 --sampler random \
    --pruner none --seed 1
  # the same command again, or in another terminal, continues the study
  sb3-quad tune --algo dagger --storage logs/my_study.log
  sb3-quad tune --algo dagger --storage sqlite:///study.db \
    --study-name noise_free --env-kwargs noise:0
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
from contextlib import suppress
from pathlib import Path
from typing import Any

from sb3_quad.base.errors import SB3QuadError
from sb3_quad.base.process import StopSignals
from sb3_quad.cli.commands.train import CONF_FILE, SETTINGS_FLAGS, plan, prepare
from sb3_quad.cli.parser import Flags, given, natural, positive, seed
from sb3_quad.training.options import DEFAULT_ALGO

JOURNAL = "study.log"
# Episodes per evaluation by --vec-env.
EPISODES = {"batch": 240, "dummy": 48, "subproc": 48}


# Those of rl-zoo's ``train.py --optimize-hyperparameters``, with their meanings.
FLAGS: Flags = {
    **CONF_FILE,
    **SETTINGS_FLAGS,
    "--n-trials N": (natural, 500, "trials of this process; 0 only writes the results (500)"),
    "--max-total-trials N": (
        positive,
        "trials of the whole study, without failed ones (no limit)",
    ),
    "--sampler NAME": (
        str,
        "tpe",
        "method that proposes trials: tpe (default), random or cmaes",
    ),
    "--pruner NAME": (
        str,
        "median",
        "method that stops poor trials early: median (default), halving or none",
    ),
    "--n-startup-trials N": (natural, 10, "random trials before sampler and pruner start (10)"),
    "--n-evaluations N": (positive, 10, "evaluations per trial, for the pruner (10)"),
    "--storage WHERE": "journal file, or URL of a database (study.log in the new folder)",
    "--study-name NAME": "name of the study in the storage (ALGO_ENV)",
    "--search-space FILE": "YAML file of settings to vary (the package's file for the algorithm)",
    "-f --log-folder DIR": (str, "logs", "results go to DIR/tune/ALGO/ENV_N (logs)"),
    "--seed N": (seed, "seed of trainings and sampler, negative for a random one (0)"),
    "--eval-episodes N": (positive, "episodes per evaluation (batch: 240, else 48)"),
}


def run(options: Namespace) -> int:
    """Search, report, write. Returns the exit code."""
    from sb3_quad.cli.output import progress_bar
    from sb3_quad.tuning.results import trial_line, write_results

    prepare(options)
    with StopSignals() as signals:
        search = _make_search(options)
        print("results go to", search.job.log_folder)
        write_results(search)
        with progress_bar(options.progress) as show:
            for number in range(options.n_trials):
                show(number, options.n_trials, "trials")
                if signals.received:
                    break
                trial = search.try_one(options.max_total_trials)
                if trial is None:
                    break
                write_results(search)
                print(trial_line(search, trial))
    _print_results(search)
    return signals.exit_code


def _make_search(options: Namespace) -> Any:
    """Return the :class:`~sb3_quad.tuning.search.Search` of a command line, with a new folder for
    its results.
    """
    from sb3_quad.base.validate import validate
    from sb3_quad.training.config import TrainingJob
    from sb3_quad.training.runs import claim_folder, file_name
    from sb3_quad.tuning.search import Search
    from sb3_quad.tuning.space import load_space

    # A search is for the settings of a single run.
    options.algo = options.algo or DEFAULT_ALGO
    stage = plan(options)
    config = stage.load()
    space = load_space(config, options.search_space)
    job = validate(
        TrainingJob,
        {
            "config": config,
            "agent": stage.agent,
            "eval_episodes": EPISODES[config.vec_env],
            **given(options, "device", "initial_policy", "n_eval_envs", "seed", "eval_episodes"),
        },
        "command line",
    )
    folder = claim_folder(Path(options.log_folder) / "tune" / config.algo, file_name(config.env_id))
    try:
        return Search(
            job.model_copy(update={"log_folder": str(folder)}),
            space,
            options.study_name or f"{config.algo}_{config.env_id}",
            options.storage or folder / JOURNAL,
            options.sampler,
            options.pruner,
            options.n_startup_trials,
            options.n_evaluations,
        )
    except SB3QuadError:
        with suppress(OSError):
            folder.rmdir()
        raise


def _print_results(search: Any) -> None:
    """Print the best trial, its agent on fresh episodes, and where everything is."""
    from sb3_quad.agents.zips import load_model
    from sb3_quad.cli.closing import print_agent
    from sb3_quad.training.runs import open_run
    from sb3_quad.tuning.results import train_command, trial_line
    from sb3_quad.tuning.search import RUN

    best = search.best
    if best is not None:
        print("the best:", trial_line(search, best))
        run = Path(best.user_attrs[RUN])
        # A process on another machine may have trained it.
        if search.job.config.task and run.is_dir():
            job = search.job.model_copy(update={"config": search.config(best)})
            model = open_run(run).model
            print_agent(job, load_model(model))
            print("agent:", model)
        print("to train:", train_command(search))
    print(
        f"saved in {search.job.log_folder}; to continue, run the same command with "
        f"--storage {shlex.quote(str(search.storage))} --study-name {shlex.quote(search.name)}"
    )
