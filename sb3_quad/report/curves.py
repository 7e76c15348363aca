"""Plots of learning curves: success, reward and losses over timesteps and wall-clock time (Figs.
4.3 and 4.4).
"""

from collections.abc import Mapping, Sequence
from itertools import chain, cycle

import pandas as pd
from matplotlib.figure import Figure

from sb3_quad.base.errors import ConfigError
from sb3_quad.evaluation.learning_curves import Curve
from sb3_quad.evaluation.tables import colours_of
from sb3_quad.report.plots import POINTS, band, legend, styled

# By measure: the label of its axis and the factor of its values.
LABELS = {
    "success": ("success in %", 100.0),
    "survival": ("survival in %", 100.0),
    "reward": ("mean reward", 1.0),
    "bc_loss": ("cloning loss", 1.0),
}
# On longer curves markers would hide the line.
MOST_MARKERS = 60
# The columns of panels: an array of a curve, its unit and the axis's label.
COLUMNS = (
    ("timesteps", 1e6, "timesteps in millions"),
    ("seconds", 60.0, "wall-clock time in minutes"),
)


@styled
def plot_curves(
    groups: Mapping[str, Sequence[Curve]],
    lines: Mapping[str, Mapping[str, float]],
    title: str = "",
    show: Sequence[str] = (),
) -> Figure:
    """Draw two panels for each of ``show``, over timesteps and over wall-clock time.

    Each evaluation has a marker, unless there are too many to tell apart.

    :param groups: the curves of an agent's seeds, by its name; their mean is drawn, with their
        range around it.
    :param lines: horizontal lines, such as the expert's: heights by panel, by name; shares for
        success and survival.
    :param show: the panels: success, survival, reward and losses, which take a row for each loss
        that a curve has; by default success, if the runs have it, and reward.
    :raises ConfigError: a panel that no curve has values for.
    """
    measures = _measures([*chain.from_iterable(groups.values())], show)
    figure = Figure(figsize=(11, 1.2 + 2.65 * len(measures)), layout="constrained")
    panels = figure.subplots(len(measures), 2, sharex="col", sharey="row", squeeze=False)
    colours = colours_of([*groups])
    for row, measure in enumerate(measures):
        label, factor = LABELS.get(measure, (measure.replace("_", " "), 1.0))
        for panel, (axis, unit, axis_label) in zip(panels[row], COLUMNS, strict=True):
            panel.set(xlabel=axis_label, ylabel=label)
            panel.label_outer()
            # The seeds of an agent are one line with a band.
            for name, runs in groups.items():
                points = _mean_and_range(runs, axis, measure) * factor
                seeds = f" ({len(runs)} seeds)" if len(runs) > 1 else ""
                if len(points):
                    points.index /= unit
                    style = POINTS if len(points) <= MOST_MARKERS else {}
                    band(panel, colours[name], name + seeds, points, **style)
            for dashes, (name, heights) in zip(cycle(("--", ":", "-.")), lines.items()):
                if measure in heights:
                    panel.axhline(
                        heights[measure] * factor, color="0.3", ls=dashes, linewidth=1.2, label=name
                    )
    # A title of the figure would overlap the legend.
    panels[0, 0].set_title(title, loc="left")
    legend(figure)
    return figure


def _measures(curves: Sequence[Curve], show: Sequence[str]) -> list[str]:
    """The measures that get a row of panels."""
    # Runs of different algorithms have different losses: all of them are shown.
    tables = [pd.DataFrame(dict(curve.measures)) for curve in curves]
    present = pd.concat(tables).dropna(axis="columns", how="all")
    losses = [*present.filter(regex="loss$")]
    if not show:
        show = ["success", "reward"] if "success" in present else ["reward"]
    measures: list[str] = []
    for name in show:
        chosen = losses if name == "losses" else [name]
        if not chosen or not {*chosen} <= {*present.columns}:
            raise ConfigError(f"{name}: the runs' evaluations hold none")
        measures += chosen
    return measures


def _mean_and_range(runs: Sequence[Curve], axis: str, measure: str) -> pd.DataFrame:
    """The mean, the lowest and the highest value of the runs, at the times of their evaluations.

    A run is interpolated between its evaluations. There is no line where a run has no values.
    """
    lines = [pd.Series(curve.values(measure), getattr(curve, axis)).dropna() for curve in runs]
    table = (
        pd.concat(lines, axis="columns")
        .sort_index()
        .interpolate("index", limit_area="inside")
        .dropna()
    )
    # pandas cannot aggregate an empty table: a run has no values, or no two runs overlap.
    if table.empty:
        return table
    return table.agg(["mean", "min", "max"], axis="columns")
