"""What a search leaves: the best settings as YAML, all trials as CSV."""

import json
from pathlib import Path
from typing import Any

import yaml
from optuna.trial import FrozenTrial

from sb3_quad.base.files import write_csv, write_text
from sb3_quad.tuning.search import ERROR, INTERRUPTED, REWARD, RUN, SETTINGS, SUCCESS, Search
from sb3_quad.tuning.space import current

BEST, TRIALS = "best.yml", "trials.csv"
STATES = {"COMPLETE": "finished", "PRUNED": "pruned", "FAIL": "failed"}


def write_results(search: Search) -> None:
    """Write, or renew, the files of a search in its job's folder.

    :raises ConfigError: a folder that cannot be written, a full disk.
    """
    folder, best = Path(search.job.log_folder), search.best
    rows = list[dict[str, Any]]()
    head = [
        "number",
        "state",
        "value",
        SUCCESS,
        REWARD,
        "evaluations",
        "seconds",
        *search.space.dimensions,
        RUN,
        ERROR,
    ]
    for trial in search.trials():
        own = {
            "number": trial.number,
            "state": trial.state.name,
            "value": trial.value if trial.state.name == "COMPLETE" else None,
            "evaluations": len(trial.intermediate_values),
            "seconds": None if trial.duration is None else round(trial.duration.total_seconds(), 2),
        }
        error = (
            {ERROR: INTERRUPTED} if trial.state.name == "FAIL" else {}
        )  # of a process that was killed
        rows.append({**error, **trial.user_attrs, **varied(search, trial), **own})
    write_csv(folder / TRIALS, head, rows)
    if best is not None:
        head = [
            f"Found by sb3-quad tune: trial {best.number} of {len(search.trials())} that ended, study {search.name}.",
            f"{in_words(search, best)} over {search.job.eval_episodes} episodes, by which it was chosen;"
            f" seed {search.job.seed}.",
            train_command(search),
        ]
        settings = yaml.safe_dump({search.job.config.env_id: settings_of(best)}, sort_keys=False)
        write_text(folder / BEST, "".join(f"# {line}\n" for line in head) + settings)


def settings_of(trial: FrozenTrial) -> dict[str, Any]:
    """All settings of a trial, as YAML holds them; none if it failed before it had any."""
    return dict(json.loads(trial.user_attrs.get(SETTINGS, "{}")))


def varied(search: Search, trial: FrozenTrial) -> dict[str, Any]:
    """The settings of a trial that the search varies."""
    settings = settings_of(trial)
    return {
        name: current(search.job.config.algo, settings, name) if settings else None
        for name in search.space.dimensions
    }


def in_words(search: Search, trial: FrozenTrial) -> str:
    """How a trial's last evaluation was."""
    success, reward = trial.user_attrs[SUCCESS], trial.user_attrs[REWARD]
    rate = "" if search.job.config.task is None else f"success {100 * success:.1f} %, "
    return f"{rate}mean reward {reward:.2f}"


def trial_line(search: Search, trial: FrozenTrial) -> str:
    """One line that says how a trial ended."""
    if trial.state.name == "FAIL":
        how = f"failed: {trial.user_attrs.get(ERROR, INTERRUPTED)}"
    else:
        how = f"{STATES[trial.state.name]}, {in_words(search, trial)}"
    mark = (
        " (best so far)" if search.best is not None and search.best.number == trial.number else ""
    )
    values = " ".join(f"{name}:{value}" for name, value in varied(search, trial).items())
    return f"trial {trial.number} {how}{mark} ({values})"


def count_trials(search: Search) -> str:
    """How many trials of the study ended, by how they did."""
    counts = {word: len(search.trials(state)) for state, word in STATES.items()}
    return ", ".join(f"{count} {word}" for word, count in counts.items() if count) or "no trial yet"


def train_command(search: Search) -> str:
    """What trains with the best settings, as the trials were."""
    config, file = search.job.config, Path(search.job.log_folder, BEST)
    start = f" -i {search.job.trained_agent}" if search.job.trained_agent else ""
    return f"sb3-quad train --algo {config.algo} --env {config.env_id} --conf-file {file}{start}"
