"""What a search leaves: the best settings as YAML, all trials as CSV and as a plot."""

import csv
import io
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from matplotlib.figure import Figure
from optuna.trial import FrozenTrial

from sb3_quad.base.files import write_bytes, write_text
from sb3_quad.report.plots import legend, picture, styled
from sb3_quad.tuning.search import ERROR, REWARD, RUN, SETTINGS, SUCCESS, Search
from sb3_quad.tuning.space import Choice, Interval, current

BEST, TRIALS, PLOT = "best.yml", "trials.csv", "trials.png"
COLUMNS = 4  # panels of the plot side by side
STYLES: dict[str, dict[str, Any]] = {
    "finished": {"s": 16, "color": "C0"},
    "pruned": {"s": 16, "color": "0.6", "marker": "x", "linewidth": 1.0},
    "best": {"s": 90, "facecolors": "none", "edgecolors": "C3", "linewidths": 1.5},
}


def write_results(search: Search) -> None:
    """Write, or renew, the files of a search in its job's folder, less the plot.

    :raises ConfigError: a folder that cannot be written, a full disk.
    """
    folder, best = Path(search.job.log_folder), search.best
    text = io.StringIO()
    head = ["number", "state", "value", SUCCESS, REWARD, "evaluations", "seconds", *search.space.dimensions, RUN, ERROR]
    writer = csv.DictWriter(text, head, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for trial in search.trials():
        own = {
            "number": trial.number,
            "state": trial.state.name,
            "value": trial.value if trial.state.name == "COMPLETE" else None,
            "evaluations": len(trial.intermediate_values),
            "seconds": None if trial.duration is None else round(trial.duration.total_seconds(), 2),
        }
        writer.writerow({**trial.user_attrs, **varied(search, trial), **own})
    write_text(folder / TRIALS, text.getvalue())
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
    return {name: current(search.job.config.algo, settings, name) if settings else None for name in search.space.dimensions}


def in_words(search: Search, trial: FrozenTrial) -> str:
    """How a trial's last evaluation was."""
    success, reward = trial.user_attrs[SUCCESS], trial.user_attrs[REWARD]
    rate = "" if search.job.config.task is None else f"success {100 * success:.1f} %, "
    return f"{rate}mean reward {reward:.2f}"


def train_command(search: Search) -> str:
    """What trains with the best settings, as the trials were."""
    config, file = search.job.config, Path(search.job.log_folder, BEST)
    start = f" -i {search.job.trained_agent}" if search.job.trained_agent else ""
    return f"sb3-quad train --algo {config.algo} --env {config.env_id} --conf-file {file}{start}"


@styled
def write_plot(search: Search) -> None:
    """Plot the history of the trials, and each setting against what came of it, as PNG.

    Pruned trials are grey crosses, the best one is ringed. The vertical axis is the success, or the mean reward once half of
    the finished trials succeed equally often and best.

    :raises ConfigError: a folder that cannot be written, a full disk.
    """
    groups = {"finished": search.trials("COMPLETE"), "pruned": search.trials("PRUNED")}
    groups["best"] = [] if search.best is None else [search.best]
    successes = [trial.user_attrs[SUCCESS] for trial in groups["finished"]]
    equals = successes.count(max(successes, default=0.0))
    by_reward = search.job.config.task is None or 2 * equals > len(successes)
    key, label, factor = (REWARD, "mean reward", 1) if by_reward else (SUCCESS, "success in %", 100)
    heights = {group: [factor * trial.user_attrs[key] for trial in trials] for group, trials in groups.items()}

    names = ["trial", *search.space.dimensions]
    rows = math.ceil(len(names) / COLUMNS)
    figure = Figure(figsize=(3.1 * COLUMNS, 2.6 * rows), layout="constrained")
    panels = figure.subplots(rows, COLUMNS, squeeze=False, sharey=True)
    for panel in panels.ravel()[len(names) :]:
        panel.set_visible(False)
    for panel, name in zip(panels.ravel(), names, strict=False):
        dimension = search.space.dimensions.get(name)
        for group, trials in groups.items():
            values = [trial.params.get(name, trial.number) for trial in trials]
            places = [str(value) for value in values] if isinstance(dimension, Choice) else values
            panel.scatter(places, heights[group], label=group, **STYLES[group])
        if isinstance(dimension, Interval) and dimension.log:
            ticks = dimension.low, math.sqrt(dimension.low * dimension.high), dimension.high
            panel.set_xscale("log")
            panel.set_xticks(ticks, [f"{float(f'{tick:.2g}'):g}" for tick in ticks])
            panel.minorticks_off()
        elif not isinstance(dimension, Choice):
            whole, (low, high) = dimension is None or dimension.whole, panel.get_xlim()
            if whole:
                panel.set_xlim(min(low, high - 1.0), max(high, low + 1.0))  # so that there are whole numbers to be ticks
            panel.locator_params(axis="x", integer=whole, min_n_ticks=1)
        panel.set_xlabel(name)
    first = panels[0, 0]
    numbers = [trial.number for trial in groups["finished"]]
    first.step(numbers, np.maximum.accumulate(heights["finished"]), where="post", color="C0", alpha=0.5)
    legend(figure, first)
    for panel in panels[:, 0]:
        panel.set_ylabel(label)
    write_bytes(Path(search.job.log_folder, PLOT), picture(figure, "png", dpi=110))
