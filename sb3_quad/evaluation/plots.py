"""Plots of flights, in one style."""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
from matplotlib.figure import Figure

from sb3_quad.base.files import write_bytes
from sb3_quad.base.types import StrDict
from sb3_quad.evaluation.flightlog import Track

# Inches of a panel
WIDTH = 5.0
HEIGHT = 3.3
DPI = 150
SHOWN_FLIGHTS = 4  # of a controller, from above and from the side
TARGET = "#1a9a45"
STYLE = matplotlib.rc_params_from_file(
    Path(__file__).with_name("plots.mplstyle"), use_default_template=False
)
styled = matplotlib.rc_context(STYLE)

Colours = Mapping[str, str]  # #rrggbb by the controllers' labels
Flights = Mapping[str, Sequence[Track]]  # likewise


@styled
def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure; the ending of its name says as what.

    :raises ConfigError: a folder that cannot be written, a full disk.
    """
    buffer = io.BytesIO()
    figure.savefig(buffer, format=path.suffix[1:], dpi=DPI, bbox_inches="tight")
    write_bytes(path, buffer.getvalue())


@styled
def paths_plot(flights: Flights, colours: Colours) -> Figure:
    """Draw the first flights of each controller from above and from the side, with their targets.

    A cross marks where a flight is lost.
    """
    figure = Figure(figsize=(2 * WIDTH, HEIGHT), layout="constrained")
    for axes, (i, j) in zip(figure.subplots(1, 2), ((0, 1), (0, 2)), strict=True):
        axes.set(xlabel=f"{'xyz'[i]} (m)", ylabel=f"{'xyz'[j]} (m)", aspect="equal")
        axes.set_adjustable("datalim")
        for label, tracks in flights.items():
            for track in tracks[:SHOWN_FLIGHTS]:
                path = track.position[:, [i, j]]
                axes.plot(*path.T, color=colours[label], label=label, linewidth=1.8)
                # A target that rests is a point, one that moves is a line.
                axes.plot(*track.targets[:, [i, j]].T, ".-", color=TARGET, label="target", zorder=1)
                if track.lost:
                    axes.plot(*path[-1], "X", color=colours[label], markersize=9)
    legend(figure)
    return figure


def legend(figure: Figure) -> None:
    """Write every name in the figure once, above its axes."""
    handles: StrDict = {}
    for axes in figure.axes:
        drawn, names = axes.get_legend_handles_labels()
        handles.update(zip(names, drawn, strict=True))
    figure.legend([*handles.values()], [*handles], loc="outside upper left", ncols=2)
