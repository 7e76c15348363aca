"""The files of a search: the best settings as YAML, all trials as CSV."""

import shlex
from pathlib import Path

import yaml
from optuna.trial import FrozenTrial, TrialState

from sb3_quad.base.files import write_text
from sb3_quad.base.types import StrDict
from sb3_quad.tuning.search import ERROR, INTERRUPTED, RATE, REWARD, RUN, STATES, Search

BEST = "best.yml"
TRIALS = "trials.csv"


def write_results(search: Search) -> None:
    """Write the files of a search in its job's folder, or update them.

    :raises ConfigError: a folder that cannot be written, a full disk.
    """
    # Imported here because --help needs no tables.
    import pandas as pd

    folder = Path(search.job.log_folder)
    # The table is written after each trial, so that an interruption loses none.
    rate = f"{search.job.config.best_by}_rate"
    columns = ["number", "state", "value", rate, REWARD, "evaluations", "seconds"]
    columns += [*search.space.dimensions, RUN, ERROR]
    rows = []
    for trial in search.trials():
        row: StrDict = {
            **trial.user_attrs,
            rate: trial.user_attrs.get(RATE),
            **search.space.values(trial.params),
            "number": trial.number,
            "state": trial.state.name,
            "evaluations": len(trial.intermediate_values),
        }
        if trial.duration is not None:
            row["seconds"] = round(trial.duration.total_seconds(), 2)
        if trial.state == TrialState.COMPLETE:
            row["value"] = trial.value
        if trial.state == TrialState.FAIL:
            # A process that was killed could not write down why its trial ended.
            row.setdefault(ERROR, INTERRUPTED)
        rows.append(row)
    # A cell is empty where its row lacks the key. Keys without a column are ignored.
    table = pd.DataFrame(rows, columns=columns, dtype=object)
    write_text(folder / TRIALS, table.to_csv(index=False))
    best = search.best
    if best is None:
        return
    config = search.config(best)
    settings = yaml.safe_dump({config.env_id: config.settings}, sort_keys=False)
    # The best settings say where they come from, in comments that train skips.
    origin = f"# {trial_line(search, best)} of study {search.name}\n# {train_command(search)}\n"
    write_text(folder / BEST, origin + settings)


def train_command(search: Search) -> str:
    """Return the command that trains with the best settings, as the trials did."""
    config = search.job.config
    command = (
        f"sb3-quad train --algo {config.algo} --env {config.env_id} "
        f"--conf-file {shlex.quote(str(Path(search.job.log_folder, BEST)))}"
    )
    if search.job.initial_policy:
        command += f" -i {shlex.quote(search.job.initial_policy)}"
    return command


def trial_line(search: Search, trial: FrozenTrial) -> str:
    """One line about the end of a trial, with the metrics of its last evaluation."""
    known = trial.user_attrs
    end = STATES[trial.state]
    if trial.state == TrialState.FAIL:
        end += f": {known[ERROR]}"
    else:
        if search.job.config.task is not None:
            end += f", {search.job.config.best_by} {100 * known[RATE]:.1f} %"
        end += f", mean reward {known[REWARD]:.2f}"
    values = " ".join(
        f"{name}:{value}" for name, value in search.space.values(trial.params).items()
    )
    return f"trial {trial.number} {end} ({values})"
