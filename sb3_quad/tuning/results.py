"""What a search leaves: the best settings as YAML, all trials as CSV."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from sb3_quad.base.files import write_text
from sb3_quad.tuning.search import ERROR, REWARD, RUN, SETTINGS, SUCCESS, Search
from sb3_quad.tuning.space import current

if TYPE_CHECKING:
    from optuna.trial import FrozenTrial

BEST, TRIALS = "best.yml", "trials.csv"


def write_results(search: Search, folder: Path) -> None:
    """Write, or renew, the files of a search in its folder.

    :raises ConfigError: a folder that cannot be written, a full disk.
    """
    write_text(folder / TRIALS, trials_csv(search))
    if search.best is not None:
        write_text(folder / BEST, best_yaml(search, search.best, folder / BEST))


def settings_of(trial: FrozenTrial) -> dict[str, Any]:
    """All settings of a trial, as YAML holds them; none if it failed before it had any."""
    return dict(json.loads(trial.user_attrs.get(SETTINGS, "{}")))


def varied(search: Search, trial: FrozenTrial) -> dict[str, Any]:
    """The settings of a trial that the search varies."""
    settings = settings_of(trial)
    return {name: current(search.job.config.algo, settings, name) if settings else None for name in search.space.dimensions}


def in_words(search: Search, trial: FrozenTrial) -> str:
    """How a trial's last evaluation was."""
    success, reward = trial.user_attrs[SUCCESS], trial.user_attrs[REWARD]
    rate = "" if search.job.config.task is None else f"success {100 * success:.1f} %, "
    return f"{rate}mean reward {reward:.2f}"


def best_yaml(search: Search, best: FrozenTrial, path: Path) -> str:
    """A trial's settings as ``train --conf-file`` takes them."""
    how, episodes = in_words(search, best), search.job.eval_episodes
    lines = [
        f"# Found by sb3-quad tune: trial {best.number} of {len(search.trials())} that ended, study {search.options.name}.",
        f"# {how} over {episodes} episodes, by which it was chosen; seed {search.job.seed}.",
        f"# {train_command(search, path)}",
    ]
    return "\n".join(lines) + "\n" + yaml.safe_dump({search.job.config.env_id: settings_of(best)}, sort_keys=False)


def train_command(search: Search, path: Path) -> str:
    """What trains with the settings of a file, as the trials were."""
    config = search.job.config
    start = f" -i {search.job.trained_agent}" if search.job.trained_agent else ""
    return f"sb3-quad train --algo {config.algo} --env {config.env_id} --conf-file {path}{start}"


def trials_csv(search: Search) -> str:
    """All trials that ended, a line each."""
    names = list(search.space.dimensions)
    head = ["number", "state", "value", SUCCESS, REWARD, "evaluations", "seconds", *names, RUN, ERROR]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(head)
    for trial in search.trials():
        attrs, values = trial.user_attrs, varied(search, trial)
        seconds = round(trial.duration.total_seconds(), 2) if trial.duration is not None else None
        figures = [trial.value if trial.state.name == "COMPLETE" else None, attrs.get(SUCCESS), attrs.get(REWARD)]
        counts = [len(trial.intermediate_values), seconds]
        writer.writerow(
            [trial.number, trial.state.name, *figures, *counts, *values.values(), attrs.get(RUN), attrs.get(ERROR)]
        )
    return text.getvalue()
