"""Flights in space: a picture by matplotlib, and the same for Plotly, to be turned in the page."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from sb3_quad.base.arrays import FloatArray
from sb3_quad.evaluation.flightlog import Track
from sb3_quad.evaluation.scenarios.scenario import Scenario
from sb3_quad.report.plots import FORCE, GRID, Flown, Plot, legend, styled

TARGET, START = "#1a9a45", "#8a8f98"
MARKS: dict[str, Any] = {"diamond": {"marker": "D"}, "circle-open": {"marker": "o", "markerfacecolor": "none"}}
SHOWN_FLIGHTS = 4  # of a controller, of random episodes
PATH_POINTS = 150  # that a flight is drawn with, at most
ARROW, CROSS = 0.16, 0.012  # longest force arrow, half a cross: of the longest side of all flights
ARROWS = 5  # along a path on which a force lasts throughout
BRIEF = 10  # samples; a shorter push has one arrow


class Trace(NamedTuple):
    """A line through points, (n, 3), m, or marks at them; NaN leaves a gap.

    :param mark: a symbol of Plotly; empty for a line.
    :param text: shown where the mouse points.
    """

    name: str
    colour: str
    points: FloatArray
    mark: str = ""
    text: str = ""


@styled
def paths_plot(scenario: Scenario, flown: Sequence[Flown]) -> Plot:
    """Flights, their targets and the forces met, of controllers with sampled flights."""
    count = 1 if scenario.is_fixed else SHOWN_FLIGHTS
    shown = [(each, track) for each in flown for track in each.tracks[:count]]
    size = float(np.ptp(np.concatenate([track.position for _, track in shown]), axis=0).max())
    traces = [trace for each, track in shown for trace in _flight(each, track, CROSS * size)]
    forces = _forces([each.tracks[0] for each in flown], ARROW * size)
    targets = np.unique(np.round(np.concatenate([track.targets for _, track in shown]), 6), axis=0)
    traces.append(Trace("target", TARGET, targets, "diamond"))
    traces.append(Trace("start", START, shown[0][1].position[:1], "circle-open"))
    traces += forces
    box = _box(np.concatenate([trace.points for trace in traces]))
    what = "The first flight of each controller" if count == 1 else f"The first {count} flights of each controller"
    caption = f"{what}; a cross marks where one is lost." + (" Arrows: the external force." if forces else "")
    return Plot(f"{scenario.name}_paths", caption, _picture(traces, box), _space(traces, box))


def _flight(each: Flown, track: Track, cross: float) -> list[Trace]:
    """The path, and a cross of that size (m) where it ends too soon; of lines, since not every font has a cross."""
    chosen = np.unique([*range(0, len(track.times), -(-len(track.times) // PATH_POINTS)), len(track.times) - 1])
    traces = [Trace(each.label, each.colour, track.position[chosen])]
    if track.lost:
        strokes = [[end * x, end * y, end] for x, y in ((1, 1), (1, -1), (-1, 1), (-1, -1)) for end in (-1.0, 1.0, math.nan)]
        traces.append(Trace(each.label, each.colour, track.position[-1] + cross * np.array(strokes), text=track.lost))
    return traces


def _forces(tracks: Sequence[Track], length: float) -> list[Trace]:
    """Arrows of the forces met, the greatest of that length (m)."""
    found = [(track, k, track.wrench[k, :3]) for track in tracks for k in _pushed(track)]
    greatest = max((float(np.linalg.norm(force)) for _, _, force in found), default=1.0)
    traces = []
    for track, k, force in found:
        arrow, at = force * length / greatest, track.position[k]
        axis = np.eye(3)[np.argmin(np.abs(arrow))]
        across = axis - (axis @ arrow) / (arrow @ arrow) * arrow  # upright for a horizontal force
        across *= 0.1 * np.linalg.norm(arrow) / np.linalg.norm(across)
        tip, barb = at + arrow, at + 0.7 * arrow
        text = f"{np.linalg.norm(force):.3g} N at {track.times[k]:.2f} s"
        traces.append(Trace("force", FORCE, np.stack([at, tip, barb + across, tip, barb - across]), text=text))
    return traces


def _pushed(track: Track) -> list[int]:
    """Samples with a force to be shown: one of a short push, several along the way of one that lasts."""
    pushed = np.flatnonzero(track.wrench[:, :3].any(axis=1))
    chosen: list[int] = []
    for part in np.split(pushed, np.flatnonzero(np.diff(pushed) > 1) + 1):
        if part.size < BRIEF:
            chosen += part[:1].tolist()
            continue
        way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(track.position[part], axis=0), axis=1))])
        number = max(2, round(ARROWS * part.size / len(track.times)))
        chosen += part[np.searchsorted(way, np.linspace(0.0, way[-1], number))].tolist()
    return chosen


def _box(points: FloatArray) -> FloatArray:
    """Lower and upper corner, (2, 3), of a box around some points: with some room, no side much shorter than the longest."""
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    middle, half = 0.5 * (low + high), 0.53 * (high - low)
    half = np.maximum(half, max(0.3 * float(half.max()), 0.5))
    corner = middle - half
    if low[2] >= 0.0 and corner[2] < 0.0:
        corner[2] = -0.2
    return np.stack([corner, middle + half])


def _picture(traces: Sequence[Trace], box: FloatArray) -> Figure:
    figure = Figure(figsize=(6.4, 4.8), layout="constrained")
    axes: Any = figure.add_subplot(projection="3d")
    for trace in traces:
        style = {"linestyle": "none", "markersize": 5, **MARKS[trace.mark]} if trace.mark else {"linewidth": 1.3}
        axes.plot(*trace.points.T, color=trace.colour, label=trace.name, **style)
    size = np.ptp(box, axis=0)
    for name, low, high, side in zip("xyz", *box, size / size.max(), strict=True):
        axes.set(**{f"{name}label": f"{name} (m)", f"{name}lim": (low, high)})
        axes.locator_params(axis=name, nbins=max(3, round(8 * side)))
        axis = getattr(axes, f"{name}axis")
        axis.set_pane_color("none")
        axis.line.set_color(GRID)
    axes.set_box_aspect(size, zoom=0.9)
    axes.view_init(elev=18, azim=-55)
    legend(figure, axes)
    return figure


def _space(traces: Sequence[Trace], box: FloatArray) -> dict[str, Any]:
    """``data`` and ``layout`` of Plotly; the page adds the colours of text and grid, which may be light or dark."""
    data, seen = [], set()
    for trace in traces:
        points = {axis: [_number(x) for x in trace.points[:, k]] for k, axis in enumerate("xyz")}
        mode, style = ("markers", "marker") if trace.mark else ("lines", "line")
        shown = {"size": 6, "symbol": trace.mark} if trace.mark else {"width": 4}
        names = {"name": trace.name, "legendgroup": trace.name, "showlegend": trace.name not in seen}
        hover = {"hovertext": trace.text, "hoverinfo": "text+name"} if trace.text else {}
        data.append({"type": "scatter3d", "mode": mode, style: {"color": trace.colour, **shown}, **points, **names, **hover})
        seen.add(trace.name)
    axes: dict[str, Any] = {
        f"{name}axis": {"title": {"text": f"{name} (m)"}, "range": [low, high], "showbackground": False, "zeroline": False}
        for name, low, high in zip("xyz", *box.tolist(), strict=True)
    }
    size = np.ptp(box, axis=0)
    camera = {"eye": {"x": 1.45, "y": -1.95, "z": 0.68}, "center": {"x": 0, "y": 0, "z": -0.17}}
    ratio = dict(zip("xyz", (1.3 * size / size.max()).tolist(), strict=True))
    scene = {**axes, "aspectmode": "manual", "aspectratio": ratio, "camera": camera, "dragmode": "turntable"}
    below = {"orientation": "h", "x": 0, "y": 0, "xanchor": "left", "yanchor": "top"}  # above are Plotly's buttons
    return {"data": data, "layout": {"scene": scene, "margin": {"l": 0, "r": 0, "t": 30, "b": 0}, "legend": below}}


def _number(value: float) -> float | None:
    """Four digits of a number; None for NaN, for which JSON has none."""
    return float(f"{value:.4g}") if math.isfinite(value) else None
