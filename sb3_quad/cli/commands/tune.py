"""Search for hyperparameters: train with one choice after another, and write the best as a settings
file.

examples:
  sb3-quad tune --algo dagger -n 250000 --n-trials 30               around zoo_configs/dagger.yml
  sb3-quad tune --algo ppo_bc --env QuadStateRecovery-v0 -i logs/dagger/QuadTargetTracking-v0_1/best_model.zip -n 3e6
  sb3-quad tune --algo ppo --env QuadStateRecovery-v0 --sampler random --pruner none --seed 1
  sb3-quad tune --algo dagger --storage logs/my_study.log           again or in another terminal: continues that study
  sb3-quad tune --algo dagger --storage sqlite:///study.db --study-name noise_free --env-kwargs noise:0
  sb3-quad tune --algo dagger --search-space my_space.yml --hyperparams n_epochs:4
  sb3-quad train --algo dagger --env QuadTargetTracking-v0 --conf-file logs/tune/dagger/QuadTargetTracking-v0_1/best.yml

The first trial uses the settings unchanged. Ctrl-C keeps the finished trials. Needs: pip install
'.[tune]' from a clone.
"""

import argparse
from contextlib import suppress
from pathlib import Path
from typing import Any

from sb3_quad.base.errors import SB3QuadError
from sb3_quad.base.signals import StopSignals
from sb3_quad.cli.commands.train import add_settings, make_config, prepare
from sb3_quad.cli.parser import Parser, given, natural, positive, seed, whole

JOURNAL = "study.log"
EPISODES = {"batch": 240, "dummy": 48, "subproc": 48}


def add_arguments(parser: Parser) -> None:
    """Add the flags of rl-zoo's ``train.py --optimize-hyperparameters``, with their meanings."""
    add_settings(parser)
    add = parser.add_argument
    add(
        "--n-trials",
        type=natural,
        default=500,
        metavar="N",
        help="trials of this process (500); 0: only write results",
    )
    add(
        "--max-total-trials",
        type=positive,
        metavar="N",
        help="trials of the whole study, failed ones excluded (no limit)",
    )
    add(
        "--sampler",
        default="tpe",
        metavar="NAME",
        help="proposes the trials: tpe (default), random or cmaes",
    )
    add(
        "--pruner",
        default="median",
        metavar="NAME",
        help="cuts poor trials short: median (default), halving or none",
    )
    add(
        "--n-startup-trials",
        type=whole,
        default=10,
        metavar="N",
        help="random trials before sampler and pruner start (10)",
    )
    add(
        "--n-evaluations",
        type=whole,
        default=10,
        metavar="N",
        help="evaluations per trial, for the pruner (10)",
    )
    add(
        "--storage",
        metavar="WHERE",
        help="journal file, or URL of a database (study.log in the new folder)",
    )
    add("--study-name", metavar="NAME", help="name of the study in the storage (ALGO_ENV)")
    add(
        "--search-space",
        metavar="FILE",
        help="YAML file of what is varied (the package's, for the algorithm)",
    )
    add(
        "-f",
        "--log-folder",
        default="logs",
        metavar="DIR",
        help="results go to DIR/tune/ALGO/ENV_N (logs)",
    )
    add(
        "--seed",
        type=seed,
        metavar="N",
        help="seed of trainings and sampler (0); negative: a random one",
    )
    add(
        "--eval-episodes",
        type=whole,
        metavar="N",
        help="episodes per evaluation (batch: 240, else 48)",
    )


def run(options: argparse.Namespace) -> int:
    """Search, report, write. Returns the exit code."""
    from sb3_quad.cli.output import progress_bar
    from sb3_quad.tuning.results import count_trials, trial_line, write_results

    prepare(options)
    with StopSignals() as signals:
        search = _make_search(options)
        print(
            f"study {search.name} in {search.storage}: {count_trials(search)}; results go to {search.job.log_folder}"
        )
        ended = list[Any]()
        with progress_bar(options.progress) as show:
            try:
                show(0, options.n_trials, "trials")
                while len(ended) < options.n_trials and signals.received is None:
                    trial = search.try_one(options.max_total_trials)
                    if trial is None:
                        break
                    ended.append(trial)
                    write_results(search)
                    print(trial_line(search, trial))
                    show(len(ended), options.n_trials, "trials")
            finally:
                write_results(search)
    _print_results(search)
    return signals.exit_code


def _make_search(options: argparse.Namespace) -> Any:
    """The :class:`~sb3_quad.tuning.search.Search` that a command line describes; the folder of its
    results is new.
    """
    from sb3_quad.base.validate import validate
    from sb3_quad.training.config import TrainingJob, build_config
    from sb3_quad.training.runs import claim_folder, file_name
    from sb3_quad.tuning.search import Search
    from sb3_quad.tuning.space import load_space

    config = make_config(options)
    if options.eval_env_kwargs is not None:  # into the settings, so that the best ones have it too
        evaluation = {**config.eval_env_kwargs, **options.eval_env_kwargs}
        config = build_config(
            config.algo, config.env_id, {**config.settings, "eval_env_kwargs": evaluation}
        )
    space = load_space(config.algo, config.settings, options.search_space)
    episodes = EPISODES[config.vec_env] if options.eval_episodes is None else options.eval_episodes
    arguments = given(options, "device", "trained_agent", "n_eval_envs", "seed")
    job = validate(
        TrainingJob, {**arguments, "config": config, "eval_episodes": episodes}, "command line"
    )
    folder = claim_folder(Path(options.log_folder) / "tune" / config.algo, file_name(config.env_id))
    name = options.study_name or f"{config.algo}_{config.env_id}"
    study = options.sampler, options.pruner, options.n_startup_trials, options.n_evaluations
    try:
        job = job.model_copy(update={"log_folder": str(folder)})
        return Search(job, space, name, options.storage or folder / JOURNAL, *study)
    except SB3QuadError:
        with suppress(OSError):
            folder.rmdir()
        raise


def _print_results(search: Any) -> None:
    """Print the best trial, its agent on episodes by which nothing was chosen, and where everything
    is.
    """
    from sb3_quad.cli.closing import agent_and_expert
    from sb3_quad.cli.output import console
    from sb3_quad.controllers.zips import load_model
    from sb3_quad.training.config import build_config
    from sb3_quad.training.runs import open_run
    from sb3_quad.tuning.results import count_trials, settings_of, train_command, trial_line
    from sb3_quad.tuning.search import RUN

    known, best = search.job.config, search.best
    if best is not None:
        print(f"the best: {trial_line(search, best)}")
        path = Path(best.user_attrs[RUN])
        if known.task is not None and path.is_dir():  # a process elsewhere may have trained it
            run, config = open_run(path), build_config(known.algo, known.env_id, settings_of(best))
            console().print(
                agent_and_expert(
                    search.job.model_copy(update={"config": config}), load_model(run.model)
                )
            )
            print(f"agent: {run.model}")
        print(f"to train: {train_command(search)}")
    print(f"{count_trials(search)}; saved in {search.job.log_folder}")
    print(f"to go on, the same command with --storage {search.storage} --study-name {search.name}")
