"""Figures of a report as matplotlib draws them: for papers and slides, as PNG and SVG."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_quad.report.figures import BarFigure, Figure, HeatFigure, LineFigure, PathFigure
from sb3_quad.report.interactive import FORCE, MARKER, NEUTRAL

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Picture

DPI = 150
STYLE: Any = {
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 9,
    "legend.frameon": False,
}
STYLE |= {
    "legend.frameon": False,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "grid.linewidth": 0.6,
    "svg.fonttype": "none",
    "svg.hashsalt": "sb3_quad",
}


def files(figure: Figure) -> dict[str, bytes]:
    """A figure's files, by their names."""
    import matplotlib

    with matplotlib.rc_context(STYLE):
        picture = draw(figure)
        contents = {}
        for suffix in ("png", "svg"):
            buffer = io.BytesIO()
            metadata = {"Date": None} if suffix == "svg" else None  # the same figures, the same file
            picture.savefig(buffer, format=suffix, dpi=DPI, metadata=metadata, bbox_inches="tight")
            contents[f"{figure.name}.{suffix}"] = buffer.getvalue()
            picture.set_layout_engine("none")  # what is arranged stays so
    return contents


def draw(figure: Figure) -> Picture:
    """A figure as matplotlib's."""
    match figure:
        case LineFigure():
            return _lines(figure)
        case BarFigure():
            return _bars(figure)
        case HeatFigure():
            return _heat(figure)
        case PathFigure():
            return _paths(figure)


def _picture(width: float, height: float) -> Picture:
    from matplotlib.figure import Figure as New

    return New(figsize=(width, height), layout="constrained")


def _legend(axes: Axes, picture: Picture, first: Sequence[str] = ()) -> None:
    """Each name once, those of ``first`` before others."""
    handles, names = axes.get_legend_handles_labels()
    found = dict(zip(names, handles, strict=True))
    order = [*first, *(name for name in found if name not in first)]
    picture.legend(
        [found[name] for name in order],
        order,
        loc="outside upper left",
        ncols=min(len(order), 4 if sum(map(len, order)) < 90 else 3),
    )


def _lines(figure: LineFigure) -> Picture:
    picture = _picture(6.4, 3.4)
    axes = picture.subplots()
    for line in figure.lines:
        style: dict[str, Any] = {
            "color": line.colour,
            "linewidth": 0.6 if line.faint else 1.6,
            "alpha": 0.45 if line.faint else 1,
        }
        marker = "o" if figure.marks and not line.faint else None
        axes.plot(line.x, line.y, label=None if line.faint else line.name, marker=marker, markersize=3.5, **style)
        if line.low is not None and line.high is not None:
            axes.fill_between(line.x, line.low, line.high, color=line.colour, alpha=0.16, linewidth=0)
    for begin, end, text in figure.spans:
        axes.axvspan(begin, end, color=FORCE, alpha=0.13)
        axes.annotate(
            text, (begin, 1.0), xycoords=("data", "axes fraction"), xytext=(2, -2), textcoords="offset points", va="top"
        )
    if figure.log_x:
        axes.set_xscale("log")
    axes.set_xlabel(figure.x_label)
    axes.set_ylabel(figure.y_label)
    if figure.y_range is None:
        axes.set_ylim(bottom=0.0)
    else:
        axes.set_ylim(figure.y_range)
    _legend(axes, picture)
    return picture


def _bars(figure: BarFigure) -> Picture:
    picture = _picture(6.8, 3.4)
    axes = picture.subplots()
    places = np.arange(len(figure.categories))
    breadth = 0.75 / max(len(figure.groups), 1)
    for number, group in enumerate(figure.groups):
        middle = places + (number - 0.5 * (len(figure.groups) - 1)) * breadth
        spread = np.stack([group.values - group.low, group.high - group.values])
        axes.bar(middle, group.values, 0.92 * breadth, color=group.colour, label=group.name)
        axes.errorbar(middle, group.values, yerr=np.maximum(spread, 0.0), fmt="none", ecolor="0.35", elinewidth=0.9, capsize=2)
    for (name, values), marker in zip(figure.references, "DosX" * len(figure.references), strict=False):
        axes.plot(places, values, marker, markerfacecolor="none", color="0.25", markersize=6, label=name)
    axes.set_xticks(places, figure.categories)
    axes.set_xlabel(figure.x_label)
    axes.set_ylabel(figure.y_label)
    axes.grid(axis="x", visible=False)
    _legend(axes, picture, [group.name for group in figure.groups])
    return picture


def _heat(figure: HeatFigure) -> Picture:
    rows = list(dict.fromkeys(panel.row for panel in figure.panels))
    columns = list(dict.fromkeys(panel.column for panel in figure.panels))
    picture = _picture(1.4 + 2.2 * len(columns), 0.5 + 1.7 * len(rows))
    grid = picture.subplots(len(rows), len(columns), sharex=True, sharey=True, squeeze=False)
    image = None
    for panel in figure.panels:
        axes = grid[rows.index(panel.row), columns.index(panel.column)]
        image = axes.imshow(panel.values, origin="lower", aspect="auto", vmin=0, vmax=100, cmap="viridis")
        axes.set_title(panel.row + (f", {panel.column}" if panel.column else ""), loc="left", color=figure.colours[panel.row])
        axes.set_xticks(range(len(figure.x_values)), figure.x_values)
        axes.set_yticks(range(len(figure.y_values)), figure.y_values)
        axes.grid(visible=False)
        for (y, x), value in np.ndenumerate(panel.values):
            if np.isfinite(value):
                axes.text(x, y, f"{value:.0f}", ha="center", va="center", fontsize=7, color="black" if value > 60 else "white")
    for axes in grid[-1]:
        axes.set_xlabel(figure.x_label)
    for axes in grid[:, 0]:
        axes.set_ylabel(figure.y_label)
    if image is not None:
        picture.colorbar(image, ax=grid.ravel().tolist(), label=figure.value_label, shrink=0.9)
    return picture


def _paths(figure: PathFigure) -> Picture:
    picture = _picture(6.4, 5.2)
    axes: Any = picture.add_subplot(projection="3d")
    for path in figure.paths:
        axes.plot(*path.points.T, color=path.colour, linewidth=1.3, label=path.name if path.first else None)
        if path.lost:
            axes.plot(*path.points[-1:].T, marker="x", color=path.colour, markersize=6, linestyle="none")
    axes.plot(*figure.targets.T, marker="D", color=MARKER, markersize=5, linestyle="none", label="target")
    axes.plot(*figure.start[:, None], marker="o", markerfacecolor="none", color=NEUTRAL, linestyle="none", label="start")
    for number, arrow in enumerate(figure.arrows):
        shown = {"label": "force"} if number == 0 else {}
        axes.quiver(*arrow.at, *arrow.vector, color=FORCE, linewidth=1.4, arrow_length_ratio=0.3, **shown)
    axes.set(xlabel="x (m)", ylabel="y (m)", zlabel="z (m)")
    axes.set_aspect("equal", adjustable="datalim")
    axes.view_init(elev=18, azim=-55)
    _legend(axes, picture)
    return picture
