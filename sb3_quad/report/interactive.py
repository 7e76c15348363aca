"""Figures of a report as Plotly draws them in a browser: plain dictionaries of its ``data`` and ``layout``.

Text, grid and background colours are left to the page, which knows whether it is light or dark; in ``data`` they are called
``@ink`` and ``@paper``.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sb3_quad.report.figures import BarFigure, Figure, FloatArray, HeatFigure, HeatPanel, Line, LineFigure, Path, PathFigure

MARKER, FORCE, NEUTRAL = "#1a9a45", "#db1a24", "#8a8f98"
BAND_OPACITY = 0.16
PANEL_HEIGHT, HEAT_PANEL_HEIGHT, PATH_HEIGHT = 380, 190, 560  # pixels
DIGITS = 4
CROSS = 0.012  # half the size of a cross, of the longest side of what is drawn


def draw(figure: Figure) -> dict[str, Any]:
    """``data``, ``layout`` and ``height`` (pixels) of a figure, ready for JSON."""
    match figure:
        case LineFigure():
            return _lines(figure)
        case BarFigure():
            return _bars(figure)
        case HeatFigure():
            return _heat(figure)
        case PathFigure():
            return _paths(figure)


def _numbers(values: FloatArray) -> list[float | None]:
    """Numbers for JSON: a few digits, None for NaN."""
    return [float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None for value in np.asarray(values).ravel().tolist()]


def _layout(**more: Any) -> dict[str, Any]:
    legend = {"orientation": "h", "x": 0, "y": 1.02, "xanchor": "left", "yanchor": "bottom"}
    return {"margin": {"l": 64, "r": 16, "t": 40, "b": 52}, "legend": legend, "hovermode": "closest", **more}


def _axis(label: str, **more: Any) -> dict[str, Any]:
    return {"title": {"text": label, "standoff": 8}, "zeroline": False, "automargin": True, **more}


def _lines(figure: LineFigure) -> dict[str, Any]:
    data: list[dict[str, Any]] = []
    for line in figure.lines:
        if line.low is not None and line.high is not None:
            data += _band(line)
        trace = {
            "type": "scatter",
            "mode": "lines+markers" if figure.marks and not line.faint else "lines",
            "name": line.name,
            "legendgroup": line.name,
            "showlegend": not line.faint,
            "x": _numbers(line.x),
            "y": _numbers(line.y),
            "line": {"color": line.colour, "width": 1 if line.faint else 2.2},
            "opacity": 0.45 if line.faint else 1,
        }
        data.append({**trace, "hoverinfo": "skip"} if line.faint else trace)
    shapes = [
        {
            "type": "rect",
            "xref": "x",
            "yref": "paper",
            "x0": begin,
            "x1": end,
            "y0": 0,
            "y1": 1,
            "layer": "below",
            "fillcolor": FORCE,
            "opacity": 0.13,
            "line": {"color": FORCE, "width": 1},
            "label": {"text": text, "textposition": "top left", "font": {"size": 12}},
        }
        for begin, end, text in figure.spans
    ]
    x_axis = _axis(figure.x_label, **({"type": "log"} if figure.log_x else {}))
    y_axis = _axis(figure.y_label, **({"range": list(figure.y_range)} if figure.y_range else {"rangemode": "tozero"}))
    return {"data": data, "layout": _layout(xaxis=x_axis, yaxis=y_axis, shapes=shapes), "height": PANEL_HEIGHT}


def _band(line: Line) -> list[dict[str, Any]]:
    assert line.low is not None and line.high is not None
    shared: dict[str, Any] = {"type": "scatter", "mode": "lines", "hoverinfo": "skip"}
    shared |= {"line": {"width": 0, "color": line.colour}}
    shared |= {"legendgroup": line.name, "showlegend": False, "x": _numbers(line.x)}
    fill = {"fill": "tonexty", "fillcolor": _with_opacity(line.colour, BAND_OPACITY)}
    return [{**shared, "y": _numbers(line.low)}, {**shared, "y": _numbers(line.high), **fill}]


def _with_opacity(colour: str, opacity: float) -> str:
    red, green, blue = (int(colour[place : place + 2], 16) for place in (1, 3, 5))
    return f"rgba({red},{green},{blue},{opacity})"


def _bars(figure: BarFigure) -> dict[str, Any]:
    data: list[dict[str, Any]] = []
    for group in figure.groups:
        above, below = group.high - group.values, group.values - group.low
        data.append(
            {
                "type": "bar",
                "name": group.name,
                "x": list(figure.categories),
                "y": _numbers(group.values),
                "customdata": list(group.notes),
                "marker": {"color": group.colour},
                "error_y": {"type": "data", "symmetric": False, "array": _numbers(above), "arrayminus": _numbers(below)}
                | {"thickness": 1.2, "width": 3, "color": "@ink"},
                "hovertemplate": "%{fullData.name}: %{y}" + (" %{customdata}" if group.notes else "") + "<extra></extra>",
            }
        )
    symbols = ("diamond", "circle", "square", "triangle-up")
    for number, (name, values) in enumerate(figure.references):
        marker = {
            "symbol": symbols[number % len(symbols)],
            "size": 9,
            "color": "@paper",
            "line": {"width": 2, "color": "@ink"},
        }
        shared = {"type": "scatter", "mode": "markers", "name": name, "x": list(figure.categories)}
        data.append({**shared, "y": _numbers(values), "marker": marker})
    axes = {"xaxis": _axis(figure.x_label, type="category"), "yaxis": _axis(figure.y_label, rangemode="tozero")}
    return {
        "data": data,
        "layout": _layout(**axes, barmode="group", bargap=max(0.25, 0.7 - 0.1 * len(figure.categories)), bargroupgap=0.06),
        "height": PANEL_HEIGHT,
    }


def _heat(figure: HeatFigure) -> dict[str, Any]:
    rows = list(dict.fromkeys(panel.row for panel in figure.panels))
    columns = list(dict.fromkeys(panel.column for panel in figure.panels))
    wide, high = 1.0 / len(columns), 1.0 / len(rows)
    data, annotations, axes = [], [], {}
    for panel in figure.panels:
        row, column = rows.index(panel.row), columns.index(panel.column)
        number = row * len(columns) + column + 1
        suffix = "" if number == 1 else str(number)
        left, top = column * wide, 1.0 - row * high
        domain = [left + 0.02 * wide, left + 0.98 * wide], [top - 0.86 * high, top - 0.1 * high]
        last, first = row == len(rows) - 1, column == 0
        axes[f"xaxis{suffix}"] = _axis(figure.x_label if last else "", domain=domain[0], anchor=f"y{suffix}", type="category")
        axes[f"yaxis{suffix}"] = _axis(figure.y_label if first else "", domain=domain[1], anchor=f"x{suffix}", type="category")
        axes[f"xaxis{suffix}"] |= {"showticklabels": last, "showgrid": False}
        axes[f"yaxis{suffix}"] |= {"showticklabels": first, "showgrid": False}
        data.append(_heat_trace(figure, panel, suffix, number == 1))
        heading = panel.row + (f", {panel.column}" if panel.column else "")
        place = {"xref": "paper", "yref": "paper", "x": domain[0][0], "y": domain[1][1], "showarrow": False}
        annotations.append({**place, "text": heading, "xanchor": "left", "yanchor": "bottom", "font": {"size": 12}})
    layout = _layout(**axes, annotations=annotations, margin={"l": 72, "r": 8, "t": 16, "b": 60})
    return {"data": data, "layout": layout, "height": 90 + HEAT_PANEL_HEIGHT * len(rows)}


def _heat_trace(figure: HeatFigure, panel: HeatPanel, suffix: str, bar: bool) -> dict[str, Any]:
    values = [_numbers(row) for row in panel.values]
    return {
        "type": "heatmap",
        "z": values,
        "x": list(figure.x_values),
        "y": list(figure.y_values),
        "xaxis": f"x{suffix}",
        "yaxis": f"y{suffix}",
        "zmin": 0,
        "zmax": 100,
        "colorscale": "Viridis",
        "xgap": 1,
        "ygap": 1,
        "texttemplate": "%{z:.0f}",
        "showscale": bar,
        "colorbar": {"title": {"text": figure.value_label, "side": "right"}, "thickness": 12, "outlinewidth": 0},
        "hovertemplate": f"{figure.x_label} %{{x}}<br>{figure.y_label} %{{y}}<br>{figure.value_label} %{{z}}<extra></extra>",
    }


def _paths(figure: PathFigure) -> dict[str, Any]:
    low, high = _bounds(figure)
    size = np.maximum(np.array(high) - low, 1e-3)
    data = [trace for path in figure.paths for trace in _path(path, CROSS * float(size.max()))]
    targets = {"type": "scatter3d", "mode": "markers", "name": "target", **_xyz(figure.targets)}
    data.append({**targets, "marker": {"size": 6, "color": MARKER, "symbol": "diamond"}})
    start = {"type": "scatter3d", "mode": "markers", "name": "start", **_xyz(figure.start[None])}
    data.append({**start, "marker": {"size": 5, "color": NEUTRAL, "symbol": "circle-open"}})
    for number, arrow in enumerate(figure.arrows):
        tip = arrow.at + arrow.vector
        shared = {"legendgroup": "force", "name": "force", "hovertext": arrow.text, "hoverinfo": "text"}
        shaft = {"type": "scatter3d", "mode": "lines", "line": {"color": FORCE, "width": 5}, **_xyz(np.stack([arrow.at, tip]))}
        data.append({**shared, **shaft, "showlegend": number == 0})
        u, v, w = (0.3 * arrow.vector).tolist()
        head = {"type": "cone", **_xyz(tip[None]), "u": [u], "v": [v], "w": [w], "anchor": "tip", "showscale": False}
        head |= {"colorscale": [[0, FORCE], [1, FORCE]], "sizemode": "raw", "sizeref": 1.0}
        data.append({**shared, **head, "showlegend": False})
    axes = {
        f"{name}axis": {
            "title": {"text": f"{name} (m)"},
            "range": [low[k], high[k]],
            "showbackground": False,
            "zeroline": False,
        }
        for k, name in enumerate("xyz")
    }
    ratio = dict(zip("xyz", (1.3 * size / size.max()).tolist(), strict=True))
    camera = {"eye": {"x": 1.45, "y": -1.95, "z": 0.68}, "center": {"x": 0, "y": 0, "z": -0.17}}
    scene = {**axes, "aspectmode": "manual", "aspectratio": ratio, "camera": camera, "dragmode": "turntable"}
    layout = _layout(scene=scene, margin={"l": 0, "r": 0, "t": 36, "b": 0})
    return {"data": data, "layout": layout, "height": PATH_HEIGHT}


def _path(path: Path, cross: float) -> list[dict[str, Any]]:
    """A way, and a cross of that size (m) where it ends too soon; as lines, since not every font has a cross."""
    shared = {"type": "scatter3d", "mode": "lines", "legendgroup": path.name, "name": path.name}
    traces = [{**shared, "line": {"color": path.colour, "width": 4}, "showlegend": path.first, **_xyz(path.points)}]
    if path.lost:
        ends = [[sign * x, sign * y, sign] for x, y in ((1, 1), (1, -1), (-1, 1), (-1, -1)) for sign in (-1.0, 1.0, np.nan)]
        strokes = {
            "line": {"color": path.colour, "width": 3},
            "showlegend": False,
            **_xyz(path.points[-1] + cross * np.array(ends)),
        }
        traces.append({**shared, **strokes, "hovertext": path.lost, "hoverinfo": "text+name"})
    return traces


def _xyz(points: FloatArray) -> dict[str, list[float | None]]:
    return {name: _numbers(points[:, k]) for k, name in enumerate("xyz")}


def _bounds(figure: PathFigure) -> tuple[list[float], list[float]]:
    """A box around all there is to see, with some room, no side much shorter than the longest."""
    tips = [arrow.at + arrow.vector for arrow in figure.arrows]
    points = np.concatenate(
        [*(path.points for path in figure.paths), figure.targets, figure.start[None], *(t[None] for t in tips)]
    )
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    half = np.maximum(1.06 * half, max(0.3 * float(half.max()), 0.5))
    bottom = middle - half
    if low[2] >= 0.0 and bottom[2] < 0.0:
        bottom[2] = -0.2
    return bottom.tolist(), (middle + half).tolist()
