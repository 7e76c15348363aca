"""A search as a picture: how its trials went, and each setting against what came of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_quad.tuning.dimensions import Choice, Interval
from sb3_quad.tuning.search import REWARD, SUCCESS, Search

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from optuna.trial import FrozenTrial

COLUMNS = 4
FINISHED: dict[str, Any] = {"color": "C0"}
CUT: dict[str, Any] = {"color": "0.6", "marker": "x", "linewidth": 1.0}


def draw_search(search: Search) -> Figure:
    """History of the trials, then a panel per setting; pruned trials are grey crosses, the best trial is ringed.

    Success is drawn, or the mean reward once half of the finished trials succeed equally often and best.
    """
    from matplotlib.figure import Figure

    done, cut = search.trials("COMPLETE"), [trial for trial in search.trials("PRUNED") if REWARD in trial.user_attrs]
    key, label, factor = _quantity(search, done)
    rows = math.ceil((len(search.space.dimensions) + 1) / COLUMNS)
    picture = Figure(figsize=(3.1 * COLUMNS, 2.6 * rows), layout="constrained")
    panels = picture.subplots(rows, COLUMNS, squeeze=False, sharey=True).ravel()
    heights = [_heights(group, key, factor) for group in (done, cut)]
    best = None if search.best is None else (search.best, search.best.user_attrs[key] * factor)
    _history(panels[0], [done, cut], heights, best)
    for panel, (name, dimension) in zip(panels[1:], search.space.dimensions.items(), strict=False):
        _slice(panel, name, dimension, [done, cut], heights, best)
    for number, panel in enumerate(panels):
        panel.set_visible(number <= len(search.space.dimensions))
        panel.spines[["top", "right"]].set_visible(False)
        panel.grid(alpha=0.25)
        if number % COLUMNS == 0:
            panel.set_ylabel(label)
    return picture


def _quantity(search: Search, done: Sequence[FrozenTrial]) -> tuple[str, str, float]:
    successes = [trial.user_attrs[SUCCESS] for trial in done]
    equals = successes.count(max(successes, default=0.0))
    if search.job.config.task is None or 2 * equals > len(successes):
        return REWARD, "mean reward", 1.0
    return SUCCESS, "success in %", 100.0


def _heights(trials: Sequence[FrozenTrial], key: str, factor: float) -> list[float]:
    return [trial.user_attrs[key] * factor for trial in trials]


def _history(panel: Axes, groups: Any, heights: Any, best: tuple[FrozenTrial, float] | None) -> None:
    for trials, values, style, label in zip(groups, heights, (FINISHED, CUT), ("finished", "pruned"), strict=True):
        panel.scatter([trial.number for trial in trials], values, s=16, label=label, **style)
    if heights[0]:
        panel.step(
            [trial.number for trial in groups[0]], np.maximum.accumulate(heights[0]), where="post", color="C0", alpha=0.5
        )
    if best is not None:
        _ring(panel, best[0].number, best[1])
    panel.set_xlabel("trial")
    panel.legend(frameon=False, fontsize="small")


def _slice(
    panel: Axes, name: str, dimension: Interval | Choice, groups: Any, heights: Any, best: tuple[FrozenTrial, float] | None
) -> None:
    choices: list[str] = []
    if isinstance(dimension, Choice):
        choices = [str(value) for value in dimension.values]
        panel.set_xticks(range(len(choices)), choices, fontsize="small")
        panel.set_xlim(-0.5, len(choices) - 0.5)
    else:
        low, high = dimension.low, dimension.high
        middle = math.sqrt(low * high) if dimension.log else (low + high) / 2
        panel.set_xscale("log" if dimension.log else "linear")
        panel.set_xticks([low, middle, high], [f"{float(f'{value:.2g}'):g}" for value in (low, middle, high)])
        panel.minorticks_off()
        ends = np.array([np.log(low), np.log(high)]) if dimension.log else np.array([low, high])
        ends += 0.06 * (ends[1] - ends[0]) * np.array([-1.0, 1.0])
        panel.set_xlim(*(np.exp(ends) if dimension.log else ends))

    def place(trial: FrozenTrial) -> float:
        value = trial.params[name]
        return float(choices.index(str(value))) if choices else float(value)

    for trials, values, style in zip(groups, heights, (FINISHED, CUT), strict=True):
        panel.scatter([place(trial) for trial in trials], values, s=16, **style)
    if best is not None:
        _ring(panel, place(best[0]), best[1])
    panel.set_xlabel(name)


def _ring(panel: Axes, x: float, y: float) -> None:
    panel.scatter([x], [y], s=90, facecolors="none", edgecolors="C3", linewidths=1.5)
