"""``tune``: a search for an algorithm's hyperparameters."""

from __future__ import annotations

import argparse
from contextlib import suppress
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

from sb3_quad.base.errors import ConfigError, SB3QuadError
from sb3_quad.cli.arguments import pairs, whole
from sb3_quad.cli.compare import agent_and_expert
from sb3_quad.cli.output import console, make_table, progress_bar
from sb3_quad.cli.settings import add_settings, make_config, make_seed, prepare, say

if TYPE_CHECKING:
    from optuna.trial import FrozenTrial
    from rich.table import Table

    from sb3_quad.tuning.search import Search

HELP = "Search for hyperparameters: trains with one choice after the other; writes the best as a settings file."
EXAMPLES = """examples:
  sb3-quad tune --algo dagger -n 250000 --n-trials 30               around zoo_configs/dagger.yml
  sb3-quad tune --algo ppo_bc --env QuadStateRecovery-v0 -i logs/dagger/QuadTargetTracking-v0_1/best_model.zip -n 3e6
  sb3-quad tune --algo ppo --env QuadStateRecovery-v0 --sampler random --pruner none --seed 1
  sb3-quad tune --algo dagger --storage logs/my_study.log           again, or in another terminal: goes on with that study
  sb3-quad tune --algo dagger --storage sqlite:///study.db --study-name noise_free --env-kwargs noise:0
  sb3-quad tune --algo dagger --search-space my_space.yml --hyperparams n_epochs:4
  sb3-quad train --algo dagger --env QuadTargetTracking-v0 --conf-file logs/tune/dagger/QuadTargetTracking-v0_1/best.yml

The first trial has the settings as they are. Ctrl-C keeps what is finished. Needs pip install 'sb3_quad[tune]'.
"""
JOURNAL = "study.log"
EPISODES = {"batch": 240, "dummy": 48, "subproc": 48}
STATES = {"COMPLETE": "finished", "PRUNED": "pruned", "FAIL": "failed"}
SHOWN = 5  # trials in the table


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The flags of rl-zoo's ``train.py --optimize-hyperparameters``, with their meanings."""
    add_settings(parser)
    add = parser.add_argument
    add("--n-trials", type=whole, default=500, metavar="N", help="trials of this process (500); 0: only write the results")
    add("--max-total-trials", type=whole, metavar="N", help="trials of the whole study, failed ones not counted (no limit)")
    add("--sampler", default="tpe", metavar="NAME", help="proposes the trials: tpe (default), random or cmaes")
    add("--pruner", default="median", metavar="NAME", help="cuts poor trials short: median (default), halving or none")
    add("--n-startup-trials", type=whole, default=10, metavar="N", help="random trials, before sampler and pruner begin (10)")
    add("--n-evaluations", type=whole, default=10, metavar="N", help="evaluations of a trial, for the pruner (10)")
    add("--storage", metavar="WHERE", help="journal file, or URL of a database (study.log in the new folder)")
    add("--study-name", metavar="NAME", help="name of the study in the storage (ALGO_ENV)")
    add("--search-space", metavar="FILE", help="YAML file that says what is varied (that of the package for the algorithm)")
    add("-f", "--log-folder", default="logs", metavar="DIR", help="the results go to DIR/tune/ALGO/ENV_N (logs)")
    add("--seed", type=int, help="of the trainings and the sampler (0); negative: a random one")
    add("--eval-episodes", type=whole, metavar="N", help="episodes of an evaluation (batch: 240, else 48)")
    add("--n-eval-envs", type=whole, metavar="N", help="environments to evaluate in (batch: one per episode; else 1)")
    add("-P", "--progress", action=argparse.BooleanOptionalAction, help="progress bar (in a terminal: yes)")
    add("--device", default="cpu", help="cpu (default), cuda or auto")
    add("--num-threads", type=whole, metavar="N", help="threads of PyTorch (its own choice)")


def run(options: argparse.Namespace) -> int:
    """Search, report, write. Returns the exit code."""
    if options.n_trials < 0 or (options.max_total_trials is not None and options.max_total_trials < 1):
        raise ConfigError("--n-trials must be at least 0, --max-total-trials at least 1")
    from sb3_quad.base.signals import StopSignals
    from sb3_quad.tuning.results import write_results

    prepare(options)
    with StopSignals() as signals:
        search, folder = _make_search(options)
        say(f"study {search.name} in {search.storage}: {_count(search)}; results go to {folder}")
        with progress_bar(options.progress) as show:
            done = count()
            show(next(done), options.n_trials, "trials")

            def after_each(trial: FrozenTrial) -> None:
                write_results(search, folder)
                say(_line(search, trial))
                show(next(done), options.n_trials, "trials")

            try:
                search.run(options.n_trials, options.max_total_trials, signals, after_each)
            finally:
                write_results(search, folder)
    _print_results(search, folder)
    return signals.exit_code


def _make_search(options: argparse.Namespace) -> tuple[Search, Path]:
    """The search that a command line describes, and the folder of its results, which is new."""
    from sb3_quad.settings.config import build_config
    from sb3_quad.training.job import TrainingJob
    from sb3_quad.training.runs import claim_folder, file_name
    from sb3_quad.tuning.search import Search
    from sb3_quad.tuning.space import load_space

    config = make_config(options)
    if options.eval_env_kwargs is not None:  # into the settings, so that the best ones have it too
        given = {**config.eval_env_kwargs, **pairs(options.eval_env_kwargs, "--eval-env-kwargs")}
        config = build_config(config.algo, config.env_id, {**config.settings, "eval_env_kwargs": given})
    space = load_space(config.algo, config.settings, options.search_space)
    job = TrainingJob(
        config,
        seed=make_seed(options),
        device=options.device,
        trained_agent=options.trained_agent,
        eval_episodes=EPISODES[config.vec_env] if options.eval_episodes is None else options.eval_episodes,
        n_eval_envs=options.n_eval_envs,
    )
    folder = claim_folder(Path(options.log_folder) / "tune" / config.algo, file_name(config.env_id))
    name = options.study_name or f"{config.algo}_{config.env_id}"
    study = options.sampler, options.pruner, options.n_startup_trials, options.n_evaluations
    try:
        return Search(replace(job, log_folder=str(folder)), space, name, options.storage or folder / JOURNAL, *study), folder
    except SB3QuadError:
        with suppress(OSError):
            folder.rmdir()
        raise


def _line(search: Search, trial: FrozenTrial) -> str:
    from sb3_quad.tuning.results import in_words, varied
    from sb3_quad.tuning.search import ERROR

    seconds = trial.duration.total_seconds() if trial.duration is not None else 0.0
    values = " ".join(f"{name}:{value}" for name, value in varied(search, trial).items())
    if trial.state.name == "FAIL":
        return f"trial {trial.number} failed: {trial.user_attrs[ERROR]} ({values})"
    pruned = f"pruned after {len(trial.intermediate_values)} evaluations, " if trial.state.name == "PRUNED" else ""
    mark = " (best so far)" if search.best is not None and search.best.number == trial.number else ""
    return f"trial {trial.number}: {pruned}{in_words(search, trial)}, {seconds:.1f} s{mark} ({values})"


def _print_results(search: Search, folder: Path) -> None:
    """The best trials, the best agent on fresh episodes, and where everything is."""
    from sb3_quad.tuning.results import BEST, PLOT, TRIALS, train_command, write_plot

    best = search.best
    if best is not None:
        write_plot(search, folder / PLOT)
        console().print(_best_trials(search))
        _fly(search, best)
    written = [TRIALS] if best is None else [TRIALS, BEST, PLOT]
    say(f"{_count(search)}; saved in {folder}: {', '.join(written)}")
    say(f"to go on, the same command with --storage {search.storage} --study-name {search.name}")
    if best is not None:
        say(f"to train: {train_command(search, folder / BEST)}")


def _fly(search: Search, best: FrozenTrial) -> None:
    """The best agent on episodes by which nothing was chosen, where its run folder is at hand."""
    from sb3_quad.experts.models import load_model
    from sb3_quad.settings.config import build_config
    from sb3_quad.training.runs import open_run
    from sb3_quad.tuning.results import settings_of
    from sb3_quad.tuning.search import RUN

    path, known = Path(best.user_attrs[RUN]), search.job.config
    if known.task is None or not path.is_dir():
        return
    run = open_run(path)
    config = build_config(known.algo, known.env_id, settings_of(best))
    console().print(agent_and_expert(replace(search.job, config=config), load_model(run.model)))
    say(f"agent: {run.model}")


def _best_trials(search: Search) -> Table:
    from sb3_quad.tuning.results import varied
    from sb3_quad.tuning.search import REWARD, SUCCESS

    best = sorted(search.trials("COMPLETE"), key=lambda trial: -(trial.value or 0.0))[:SHOWN]
    table = make_table(f"the best of {_count(search)}", "trial", *(str(trial.number) for trial in best))
    if search.job.config.task is not None:
        table.add_row("success", *(f"{100 * trial.user_attrs[SUCCESS]:.2f} %" for trial in best))
    table.add_row("mean reward", *(f"{trial.user_attrs[REWARD]:.3f}" for trial in best), end_section=True)
    for name in search.space.dimensions:
        table.add_row(name, *(str(varied(search, trial)[name]) for trial in best))
    return table


def _count(search: Search) -> str:
    counts = {word: len(search.trials(state)) for state, word in STATES.items()}
    return ", ".join(f"{count} {word}" for word, count in counts.items() if count) or "no trial yet"
