"""Learning curves from run folders: success and reward over transitions and over wall-clock time (Figs. 4.3 and 4.4)."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from sb3_quad.base.errors import ConfigError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Curve:
    """The evaluations of one run, k of them.

    :param timesteps: transitions, (k,).
    :param seconds: of training, evaluations along the way included, (k,).
    :param success: share of successful episodes, (k,).
    :param reward: mean per episode, (k,).
    """

    timesteps: FloatArray
    seconds: FloatArray
    success: FloatArray
    reward: FloatArray


def read_curve(run: str | Path, task: str | None = None) -> Curve:
    """The curve of a run folder, from its ``evaluations.npz``.

    :param task: one of the run's ``eval_tasks``; None for its environment's own.
    :raises ConfigError: a folder without evaluations, or a damaged file.
    """
    path = Path(run) / ("evaluations.npz" if task is None else f"evaluations_{task}.npz")
    if not path.is_file():
        if task is not None:
            raise ConfigError(f"{path}: no such file; {task} is none of this run's eval_tasks")
        raise ConfigError(f"{path}: no such file; a run that was trained with --eval-episodes 0 has no curve")
    try:
        with np.load(path) as file:
            return Curve(
                np.asarray(file["timesteps"], dtype=np.float64),
                np.asarray(file["seconds"], dtype=np.float64),
                file["successes"].mean(axis=1),
                file["results"].mean(axis=1),
            )
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise ConfigError(f"{path}: cannot be read ({error})") from None


def plot_curves(groups: Mapping[str, Sequence[Curve]], lines: Mapping[str, tuple[float, float]], title: str = "") -> Figure:
    """Four panels: success and reward, each over transitions and over wall-clock time.

    :param groups: from the name of an agent to the curves of its seeds; the mean is drawn, with the seeds' range around it.
    :param lines: from a name to (success share, mean reward): drawn as horizontal lines, such as the expert's.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 6.5), layout="constrained")
    panels = figure.subplots(2, 2, sharex="col", sharey="row")
    for column, (axis, scale, label) in enumerate(
        (("timesteps", 1e6, "transitions in millions"), ("seconds", 60.0, "wall-clock time in minutes"))
    ):
        for row, (value, factor, name) in enumerate((("success", 100.0, "success in %"), ("reward", 1.0, "mean reward"))):
            panel = panels[row, column]
            for number, (group, curves) in enumerate(groups.items()):
                _draw(panel, curves, axis, scale, value, factor, f"C{number}", group)
            for number, (line, figures) in enumerate(lines.items()):
                style = ("--", ":", "-.")[number % 3]
                panel.axhline(figures[row] * factor, color="0.3", linestyle=style, linewidth=1.2, label=line)
            panel.grid(alpha=0.25)
            panel.spines[["top", "right"]].set_visible(False)
            if row == 1:
                panel.set_xlabel(label)
            if column == 0:
                panel.set_ylabel(name)
    panels[0, 0].legend(frameon=False, loc="lower right")
    figure.suptitle(title)
    return figure


def _draw(
    panel: Axes, curves: Sequence[Curve], axis: str, scale: float, value: str, factor: float, color: str, label: str
) -> None:
    ends = [getattr(curve, axis)[-1] for curve in curves]
    grid = np.linspace(max(getattr(curve, axis)[0] for curve in curves), min(ends), 200)
    rows = np.stack([np.interp(grid, getattr(curve, axis), getattr(curve, value)) for curve in curves]) * factor
    panel.plot(
        grid / scale, rows.mean(axis=0), color=color, label=f"{label} ({len(curves)} seeds)" if len(curves) > 1 else label
    )
    panel.fill_between(grid / scale, rows.min(axis=0), rows.max(axis=0), color=color, alpha=0.2, linewidth=0)
