"""Learning curves from run folders: success and reward over timesteps and over wall-clock time (Figs. 4.3 and 4.4)."""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from sb3_quad.base.arrays import FloatArray
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import read_arrays
from sb3_quad.drawing.labels import colours_of
from sb3_quad.report.plots import POINTS, band, legend, styled

NAMES = {"timesteps", "seconds", "successes", "results"}  # of the arrays in a file


class Curve(NamedTuple):
    """The evaluations of one run, k of them."""

    timesteps: FloatArray  # (k,)
    seconds: FloatArray  # of training, evaluations along the way included, (k,)
    success: FloatArray  # share of successful episodes, (k,)
    reward: FloatArray  # mean per episode, (k,)


def read_curve(run: str | Path, task: str | None = None) -> Curve:
    """The curve of a run folder, from its ``evaluations.npz``.

    :param task: one of the run's ``eval_tasks``; None for its environment's own.
    :raises ConfigError: a folder without evaluations, or a damaged file.
    """
    path = Path(run) / ("evaluations.npz" if task is None else f"evaluations_{task}.npz")
    if not path.is_file():
        reason = "a run that was trained with --eval-episodes 0 has no curve"
        raise ConfigError(f"{path}: no such file; " + (f"{task} is none of this run's eval_tasks" if task else reason))
    arrays = read_arrays(path)
    if missing := NAMES - arrays.keys():
        raise ConfigError(f"{path}: cannot be read ({', '.join(sorted(missing))}: no such array)")
    shapes = [arrays[name].shape for name in ("timesteps", "seconds", "successes", "results")]
    count = shapes[0][0] if shapes[0] else 0
    right = [len(each) for each in shapes] == [1, 1, 2, 2] and all(each[0] == count for each in shapes)
    if not (right and count and all(arrays[name].dtype.kind in "fiub" for name in NAMES)):
        raise ConfigError(f"{path}: cannot be read (timesteps, seconds, successes and results do not fit together)")
    timesteps, seconds = (np.asarray(arrays[name], dtype=np.float64) for name in ("timesteps", "seconds"))
    return Curve(timesteps, seconds, arrays["successes"].mean(axis=1), arrays["results"].mean(axis=1))


@styled
def plot_curves(groups: Mapping[str, Sequence[Curve]], lines: Mapping[str, tuple[float, float]], title: str = "") -> Figure:
    """Four panels: success and reward, each over timesteps and over wall-clock time; a marker at each evaluation.

    :param groups: from the name of an agent to the curves of its seeds; their mean is drawn, with their range around it.
    :param lines: from a name to (success share, mean reward): drawn as horizontal lines, such as the expert's.
    """
    figure = Figure(figsize=(11, 6.5), layout="constrained")
    panels = figure.subplots(2, 2, sharex="col", sharey="row")
    axes = (("timesteps", 1e6, "timesteps in millions"), ("seconds", 60.0, "wall-clock time in minutes"))
    colours = colours_of([*groups])
    values = (("success", 100.0, "success in %"), ("reward", 1.0, "mean reward"))
    for (row, (value, factor, name)), (column, (axis, scale, label)) in itertools.product(enumerate(values), enumerate(axes)):
        panel = panels[row, column]
        panel.set(xlabel=label, ylabel=name)
        panel.label_outer()
        for group, curves in groups.items():
            times = [getattr(curve, axis) for curve in curves]
            grid = np.clip(times[0], max(each[0] for each in times), min(each[-1] for each in times))  # that all runs have
            rows = [factor * np.interp(grid, getattr(curve, axis), getattr(curve, value)) for curve in curves]
            ends = np.stack([np.mean(rows, axis=0), np.min(rows, axis=0), np.max(rows, axis=0)])
            seeds = f" ({len(curves)} seeds)" if len(curves) > 1 else ""
            band(panel, colours[group], group + seeds, grid / scale, ends, **POINTS)
        for number, (line, heights) in enumerate(lines.items()):
            style = ("--", ":", "-.")[number % 3]
            panel.axhline(heights[row] * factor, color="0.3", linestyle=style, linewidth=1.2, label=line)
    legend(figure, panels[0, 0], side="lower")
    figure.suptitle(title)
    return figure
