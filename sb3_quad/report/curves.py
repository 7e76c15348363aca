"""Pictures of learning curves: success, reward and losses over timesteps and wall-clock time (Figs.
4.3 and 4.4).
"""

import itertools
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from sb3_quad.base.arrays import FloatArray
from sb3_quad.base.colours import colours_of
from sb3_quad.base.errors import ConfigError
from sb3_quad.evaluation.learning_curves import Curve
from sb3_quad.report.plots import POINTS, band, legend, styled

SUCCESS, SURVIVAL, REWARD, LOSSES = "success", "survival", "reward", "losses"
_LABELS = {
    SUCCESS: "success in %",
    SURVIVAL: "survival in %",
    REWARD: "mean reward",
    "bc_loss": "cloning loss",
}


@styled
def plot_curves(
    groups: Mapping[str, Sequence[Curve]],
    lines: Mapping[str, Mapping[str, float]],
    title: str = "",
    show: Sequence[str] = (),
) -> Figure:
    """Two panels, over timesteps and over wall-clock time, for each of ``show``; a marker at each
    evaluation.

    :param groups: from the name of an agent to the curves of its seeds; their mean is drawn, with
        their range around it.
    :param lines: from a name to heights by panel, shares for success and survival: horizontal
        lines, such as the expert's.
    :param show: of success, survival, reward and losses, which take a row for each that a curve
        has; success, if there is some, and reward by default.
    :raises ConfigError: a panel that no curve has values for.
    """
    curves = [curve for group in groups.values() for curve in group]
    show = show or (
        [REWARD] if all(curve.success is None for curve in curves) else [SUCCESS, REWARD]
    )
    losses = [*dict.fromkeys(name for curve in curves for name in curve.losses)]
    names = [row for each in show for row in (losses if each == LOSSES else [each])]
    for name in names or show:
        if name == LOSSES or all(np.isnan(curve.values(name)).all() for curve in curves):
            raise ConfigError(f"{name}: the runs' evaluations hold none")
    figure = Figure(figsize=(11, 1.2 + 2.65 * len(names)), layout="constrained")
    panels = figure.subplots(len(names), 2, sharex="col", sharey="row", squeeze=False)
    axes = (
        ("timesteps", 1e6, "timesteps in millions"),
        ("seconds", 60.0, "wall-clock time in minutes"),
    )
    colours = colours_of([*groups])
    for (row, value), (column, (axis, scale, label)) in itertools.product(
        enumerate(names), enumerate(axes)
    ):
        panel, factor = panels[row, column], 100.0 if value in (SUCCESS, SURVIVAL) else 1.0
        panel.set(xlabel=label, ylabel=_LABELS.get(value, value.replace("_", " ")))
        panel.label_outer()
        for group, runs in groups.items():
            times, heights = zip(
                *(_known(getattr(curve, axis), curve.values(value)) for curve in runs), strict=True
            )
            if not all(map(len, times)):
                continue
            grid = np.clip(
                times[0], max(each[0] for each in times), min(each[-1] for each in times)
            )  # that all runs have
            rows = [factor * np.interp(grid, *known) for known in zip(times, heights, strict=True)]
            ends = np.stack([np.mean(rows, axis=0), np.min(rows, axis=0), np.max(rows, axis=0)])
            seeds = f" ({len(runs)} seeds)" if len(runs) > 1 else ""
            band(panel, colours[group], group + seeds, grid / scale, ends, **POINTS)
        for number, (line, at) in enumerate(lines.items()):
            if value in at:
                style = ("--", ":", "-.")[number % 3]
                panel.axhline(
                    at[value] * factor, color="0.3", linestyle=style, linewidth=1.2, label=line
                )
    panels[0, 0].set_title(title, loc="left")  # a suptitle would lie on the legend
    legend(figure)
    return figure


def _known(times: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    known = np.isfinite(values)
    return times[known], values[known]
