"""Flights in space, to be turned in the page."""

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from sb3_quad.base.arrays import FloatArray
from sb3_quad.evaluation.flightlog import Track
from sb3_quad.evaluation.scenarios.scenario import Scenario
from sb3_quad.report.plots import Space
from sb3_quad.report.scenario_plots import FORCE, ControllerFlights

TARGET, START = "#1a9a45", "#8a8f98"
SHOWN_FLIGHTS = 4  # of a controller, of random episodes
PATH_POINTS = 150  # that a flight is drawn with, at most
LINE = 0.16  # length of a force's line, of the longest side of all flights
FORCES = 5  # shown of one that lasts throughout a flight


def paths_plot(scenario: Scenario, flights: Sequence[ControllerFlights]) -> Space:
    """Flights, their targets and the forces met, of controllers with recorded flights."""
    count = 1 if scenario.is_fixed else SHOWN_FLIGHTS
    shown = [(each, track) for each in flights for track in each.tracks[:count]]
    size = float(np.ptp(np.concatenate([track.position for _, track in shown]), axis=0).max())
    data: list[dict[str, Any]] = []
    for each, track in shown:
        chosen = np.unique([*range(0, len(track.times), -(-len(track.times) // PATH_POINTS)), len(track.times) - 1])
        data.append(_trace(each.label, each.colour, track.position[chosen], data))
        if track.lost:
            data.append(_trace(each.label, each.colour, track.position[-1:], data, "x", track.lost))
    targets = np.unique(np.round(np.concatenate([track.targets for _, track in shown]), 6), axis=0)
    data.append(_trace("target", TARGET, targets, data, "diamond"))
    data.append(_trace("start", START, shown[0][1].position[:1], data, "circle-open"))
    for track, sample in ((each.tracks[0], sample) for each in flights for sample in _pushed(each.tracks[0])):
        force, start = track.wrench[sample, :3], track.position[sample]
        newtons = float(np.linalg.norm(force))
        text = f"{newtons:.3g} N at {track.times[sample]:.2f} s"
        ends = np.stack([start, start + LINE * size / newtons * force])
        data.append(_trace("force", FORCE, ends, data, text=text))
    what = "The first flight of each controller" if count == 1 else f"The first {count} flights of each controller"
    caption = f"{what}; a cross marks where one is lost. Red: the external force, if there is one."
    return Space(f"{scenario.name}_paths", caption, {"data": data, "layout": _layout(data)})


def _trace(
    name: str, colour: str, points: FloatArray, others: Sequence[Mapping[str, Any]], symbol: str = "", text: str = ""
) -> dict[str, Any]:
    """A line through points, (n, 3), m, or marks at them; in the legend if none of the others has its name.

    :param symbol: of the marks; empty: a line.
    :param text: shown where the mouse points.
    """
    look = {"marker": {"color": colour, "size": 5, "symbol": symbol}} if symbol else {"line": {"color": colour, "width": 4}}
    names = {"name": escape(name), "legendgroup": name, "showlegend": escape(name) not in {each["name"] for each in others}}
    hover = {"hovertext": text, "hoverinfo": "text+name"} if text else {}
    axes = dict(zip("xyz", points.round(3).T.tolist(), strict=True))
    return {"type": "scatter3d", "mode": "markers" if symbol else "lines", **look, **names, **hover, **axes}


def _pushed(track: Track) -> list[int]:
    """Samples with a force to be shown: the first of each push, and further ones along the way of one that lasts."""
    acts = np.asarray(track.wrench[:, :3].any(axis=1))
    begins = acts & ~np.roll(acts, 1)
    begins[:: -(-len(acts) // FORCES)] = True
    return np.flatnonzero(acts & begins).tolist()


def _layout(data: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Plotly's layout: a cube around everything, so that all scales are equal."""
    points = np.concatenate([np.array([trace[name] for name in "xyz"], dtype=np.float64) for trace in data], axis=1)
    low, high = points.min(axis=1), points.max(axis=1)
    half = max(0.53 * float((high - low).max()), 0.5)
    scene: dict[str, Any] = {"aspectmode": "cube"}
    for name, middle in zip("xyz", (0.5 * (low + high)).tolist(), strict=True):
        ends = [middle - half, middle + half]
        scene[f"{name}axis"] = {"title": {"text": f"{name} (m)"}, "range": ends, "showbackground": False, "zeroline": False}
    legend = {"orientation": "h", "x": 0, "y": 0, "yanchor": "top"}  # Plotly's buttons are at the top
    return {"scene": scene, "margin": {"l": 0, "r": 0, "t": 30, "b": 0}, "legend": legend}
