"""Plots of learning curves: success, reward and losses over timesteps and wall-clock time (Figs.
4.3 and 4.4).
"""

from collections.abc import Mapping, Sequence
from itertools import cycle

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sb3_quad.base.arrays import FloatArray
from sb3_quad.base.colours import colours_of
from sb3_quad.base.errors import ConfigError
from sb3_quad.evaluation.learning_curves import Curve
from sb3_quad.report.plots import POINTS, band, legend, styled

# By measure: the label of its axis and the factor of its values.
LABELS = {
    "success": ("success in %", 100.0),
    "survival": ("survival in %", 100.0),
    "reward": ("mean reward", 1.0),
    "bc_loss": ("cloning loss", 1.0),
}
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

    A marker stands at each evaluation.

    :param groups: from the name of an agent to the curves of its seeds; their mean is drawn, with
        their range around it.
    :param lines: from a name to heights by panel, shares for success and survival: horizontal
        lines, such as the expert's.
    :param show: of success, survival, reward and losses, which take a row for each that a curve
        has; success, if the runs have it, and reward by default.
    :raises ConfigError: a panel that no curve has values for.
    """
    curves = [curve for group in groups.values() for curve in group]
    measures = _measures(curves, show)
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
                points = _mean_and_range(runs, axis, measure)
                if points is not None:
                    seeds = f" ({len(runs)} seeds)" if len(runs) > 1 else ""
                    times, ends = points
                    band(panel, colours[name], name + seeds, times / unit, factor * ends, **POINTS)
            _horizontal_lines(panel, measure, factor, lines)
    # A title of the figure would lie on the legend.
    panels[0, 0].set_title(title, loc="left")
    legend(figure)
    return figure


def _measures(curves: Sequence[Curve], show: Sequence[str]) -> list[str]:
    """The measures that get a row of panels."""
    present: dict[str, None] = {}
    for curve in curves:
        for name, values in curve.measures.items():
            if not np.isnan(values).all():
                present[name] = None
    losses = [name for name in present if name.endswith("loss")]
    if not show:
        show = ["success", "reward"] if "success" in present else ["reward"]
    measures = []
    # Runs of different algorithms have different losses: all of them are shown.
    for name in show:
        measures += losses if name == "losses" else [name]
        if name not in present and not (name == "losses" and losses):
            raise ConfigError(f"{name}: the runs' evaluations hold none")
    return measures


def _mean_and_range(
    runs: Sequence[Curve], axis: str, measure: str
) -> tuple[FloatArray, FloatArray] | None:
    """Times of the first run, (k,), and the runs' mean, least and greatest value there, (3, k).

    None if a run has no value.
    """
    known = []
    for curve in runs:
        values = curve.values(measure)
        finite = np.isfinite(values)
        if not finite.any():
            return None
        known.append((getattr(curve, axis)[finite], values[finite]))
    # Where all runs have values; between its evaluations a run is interpolated.
    first = max(times[0] for times, _ in known)
    last = min(times[-1] for times, _ in known)
    grid = np.clip(known[0][0], first, last)
    heights = [np.interp(grid, times, values) for times, values in known]
    return grid, np.stack(
        [np.mean(heights, axis=0), np.min(heights, axis=0), np.max(heights, axis=0)]
    )


def _horizontal_lines(
    panel: Axes, measure: str, factor: float, lines: Mapping[str, Mapping[str, float]]
) -> None:
    for style, (name, heights) in zip(cycle(("--", ":", "-.")), lines.items(), strict=False):
        if measure in heights:
            height = heights[measure] * factor
            panel.axhline(height, color="0.3", linestyle=style, linewidth=1.2, label=name)
