"""``tune``: a search for an algorithm's hyperparameters."""

import argparse
import sys
from collections.abc import Callable
from contextlib import suppress
from itertools import count
from pathlib import Path

from optuna.trial import FrozenTrial

from sb3_quad.base.errors import ConfigError, SB3QuadError, TrainingError, WorkerDied
from sb3_quad.base.signals import StopSignals
from sb3_quad.base.validate import validate
from sb3_quad.cli.commands.train import make_config, prepare
from sb3_quad.cli.compare import agent_and_expert
from sb3_quad.cli.output import console, progress_bar
from sb3_quad.cli.parser import given
from sb3_quad.controllers.zips import load_model
from sb3_quad.evaluation.tables import text_table
from sb3_quad.executors import start_executor
from sb3_quad.training.config import build_config
from sb3_quad.training.job import TrainingJob
from sb3_quad.training.runs import claim_folder, file_name, open_run
from sb3_quad.tuning.results import BEST, PLOT, TRIALS, in_words, settings_of, train_command, varied, write_plot, write_results
from sb3_quad.tuning.search import ERROR, HOPELESS, REWARD, RUN, SUCCESS, Search, train_trial
from sb3_quad.tuning.space import load_space

JOURNAL = "study.log"
EPISODES = {"batch": 240, "dummy": 48, "subproc": 48}
STATES = {"COMPLETE": "finished", "PRUNED": "pruned", "FAIL": "failed"}
SHOWN = 5  # trials in the table


def run(options: argparse.Namespace) -> int:
    """Search, report, write. Returns the exit code."""
    prepare(options)
    with StopSignals() as signals:
        search = _make_search(options)
        print(f"study {search.name} in {search.storage}: {_count(search)}; results go to {search.job.log_folder}")
        with progress_bar(options.progress) as show:
            done = count()
            show(next(done), options.n_trials, "trials")

            def after_each(trial: FrozenTrial) -> None:
                write_results(search)
                print(_line(search, trial))
                show(next(done), options.n_trials, "trials")

            try:
                if options.workers > 1 or options.executor != "local":
                    _share(options, search, signals, after_each)
                else:
                    search.run(options.n_trials, options.max_total_trials, signals, after_each)
            finally:
                write_results(search)
    _print_results(search)
    return signals.exit_code


def _share(
    options: argparse.Namespace, search: Search, signals: StopSignals, after_each: Callable[[FrozenTrial], None]
) -> None:
    """Have workers train the trials, each of which opens the study.

    :raises TrainingError: the first trials of all have failed.
    """
    if options.address is not None and options.storage is None:
        raise ConfigError("--address: workers elsewhere need a study that they see; name one with --storage")
    study = options.sampler, options.pruner, options.n_startup_trials, options.n_evaluations
    storage = str(search.storage) if "://" in str(search.storage) else str(Path(str(search.storage)).absolute())
    shared = search.job.model_copy(update={"log_folder": str(Path(search.job.log_folder).absolute())})
    ended, failures, stopped = 0, 0, False
    with start_executor(options.executor, options.workers, options.address) as executor:
        for _ in range(options.n_trials):
            executor.submit(train_trial, shared, search.space, search.name, storage, study, options.max_total_trials)
        while executor.pending:
            for task in executor.wait(1.0):
                try:
                    number = task.result()
                except WorkerDied as error:
                    print(f"a trial is lost, and tried again by whoever goes on: {error}", file=sys.stderr)
                    continue
                if number is None:
                    continue
                trial = search.study.get_trials(deepcopy=False)[number]
                after_each(trial)
                ended, failures = ended + 1, failures + (trial.state.name == "FAIL")
                if failures == ended == HOPELESS and not stopped:
                    raise TrainingError(f"the first {HOPELESS} trials failed, the last with: {trial.user_attrs[ERROR]}")
            if signals.received is not None and not stopped:
                stopped = True
                executor.cancel()


def _make_search(options: argparse.Namespace) -> Search:
    """The search that a command line describes; the folder of its results is new."""
    config = make_config(options)
    if options.eval_env_kwargs is not None:  # into the settings, so that the best ones have it too
        evaluation = {**config.eval_env_kwargs, **options.eval_env_kwargs}
        config = build_config(config.algo, config.env_id, {**config.settings, "eval_env_kwargs": evaluation})
    space = load_space(config.algo, config.settings, options.search_space)
    episodes = EPISODES[config.vec_env] if options.eval_episodes is None else options.eval_episodes
    arguments = given(options, "device", "trained_agent", "n_eval_envs", "seed")
    job = validate(TrainingJob, {**arguments, "config": config, "eval_episodes": episodes}, "command line")
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


def _line(search: Search, trial: FrozenTrial) -> str:
    seconds = trial.duration.total_seconds() if trial.duration is not None else 0.0
    values = " ".join(f"{name}:{value}" for name, value in varied(search, trial).items())
    if trial.state.name == "FAIL":
        return f"trial {trial.number} failed: {trial.user_attrs[ERROR]} ({values})"
    pruned = f"pruned after {len(trial.intermediate_values)} evaluations, " if trial.state.name == "PRUNED" else ""
    mark = " (best so far)" if search.best is not None and search.best.number == trial.number else ""
    return f"trial {trial.number}: {pruned}{in_words(search, trial)}, {seconds:.1f} s{mark} ({values})"


def _print_results(search: Search) -> None:
    """The best trials, the best agent on fresh episodes, and where everything is."""
    if search.best is not None:
        write_plot(search)
        _print_best(search, search.best)
    written = [TRIALS] if search.best is None else [TRIALS, BEST, PLOT]
    print(f"{_count(search)}; saved in {search.job.log_folder}: {', '.join(written)}")
    print(f"to go on, the same command with --storage {search.storage} --study-name {search.name}")
    if search.best is not None:
        print(f"to train: {train_command(search)}")


def _print_best(search: Search, best: FrozenTrial) -> None:
    """The best trials, and the best agent on episodes by which nothing was chosen, where its run folder is at hand."""
    known, path = search.job.config, Path(best.user_attrs[RUN])
    trials = sorted(search.trials("COMPLETE"), key=lambda trial: -(trial.value or 0.0))[:SHOWN]
    rows = [("mean reward", *(f"{trial.user_attrs[REWARD]:.3f}" for trial in trials))]
    if known.task is not None:
        rows.insert(0, ("success", *(f"{100 * trial.user_attrs[SUCCESS]:.2f} %" for trial in trials)))
    rows += [(name, *(str(varied(search, trial)[name]) for trial in trials)) for name in search.space.dimensions]
    console().print(text_table(f"the best of {_count(search)}", ("trial", *(str(trial.number) for trial in trials)), rows))
    if known.task is not None and path.is_dir():
        run, config = open_run(path), build_config(known.algo, known.env_id, settings_of(best))
        console().print(agent_and_expert(search.job.model_copy(update={"config": config}), load_model(run.model)))
        print(f"agent: {run.model}")


def _count(search: Search) -> str:
    counts = {word: len(search.trials(state)) for state, word in STATES.items()}
    return ", ".join(f"{count} {word}" for word, count in counts.items() if count) or "no trial yet"
