"""The figures that a scenario's results give: which kinds it has, and what is in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from sb3_quad.evaluation.records import Entry
from sb3_quad.report.figures import (
    Arrow,
    BarFigure,
    BarGroup,
    Figure,
    HeatFigure,
    HeatPanel,
    Line,
    LineFigure,
    Path,
    PathFigure,
)
from sb3_quad.report.tracks import Track
from sb3_quad.scenarios.scenario import Scenario
from sb3_quad.scenarios.vary import axis_label, axis_name

FloatArray = npt.NDArray[np.float64]

DRAWN_PATHS = 4  # flights of a controller in a 3-D figure of random episodes
PATH_POINTS, LINE_POINTS = 300, 400  # that a flight is drawn with, at most
ARROW = 0.16  # length of the longest force arrow, of the longest side of what is drawn
ARROWS = 5  # along a path on which a force lasts throughout
BRIEF = 10  # samples; a shorter push has one arrow


@dataclass(frozen=True, eq=False)
class Flown:
    """One controller in one scenario: its colour, its figures, its sampled flights."""

    label: str
    colour: str
    entry: Entry
    tracks: Sequence[Track]


def scenario_figures(scenario: Scenario, flown: Sequence[Flown], source: str) -> list[Figure]:
    """The figures of a scenario that stands for itself."""
    figures: list[Figure] = []
    if scenario.target.waypoints is None and scenario.target.distance != 0.0 and len(scenario.tolerances) > 2:
        figures.append(_arrivals(scenario, flown, source))
    with_tracks = [each for each in flown if each.tracks]
    if with_tracks:
        figures += [_paths(scenario, with_tracks), _errors(scenario, with_tracks)]
    if any(each.entry.hit_limit is not None for each in flown):
        figures.append(_hits(scenario, flown))
    return figures


def group_figures(group: str, scenarios: Sequence[Scenario], flown: Sequence[Sequence[Flown]]) -> list[Figure]:
    """The figures of the cells that ``vary`` makes of a scenario.

    :param flown: of each cell.
    """
    keys = list(scenarios[0].cell)
    if len(keys) == 1:
        return _sweep(group, keys[0], scenarios, flown)
    return [_heat_map(group, keys, scenarios, flown)]


def _arrivals(scenario: Scenario, flown: Sequence[Flown], source: str) -> BarFigure:
    """Mean times to each tolerance, cf. Figs. 4.6 and 4.7."""
    groups = []
    for each in flown:
        times = [arrival.time for arrival in each.entry.metrics.arrivals]
        values, low, high = (
            np.array([np.nan if time is None else getattr(time, name) for time in times]) for name in ("value", "low", "high")
        )
        notes = [f"({100 * arrival.share.value:.3g} % of flights)" for arrival in each.entry.metrics.arrivals]
        groups.append(BarGroup(each.label, each.colour, values, low, high, notes))
    names = [f"{tolerance:g}" for tolerance in scenario.tolerances]
    references = []
    for name, reference in scenario.reference.items():
        given = {float(key): time for key, time in reference.time_to.items()}
        marks = np.array([_number(given.get(tolerance)) for tolerance in scenario.tolerances])
        if np.isfinite(marks).any():
            references.append((f"{source}: {name}", marks))
    caption = "Mean time until the vehicle is first within a tolerance of its target, over the flights that get there."
    return BarFigure(f"{scenario.name}_times", caption, "tolerance (m)", "time (s)", names, groups, references)


def _number(figure: object) -> float:
    if isinstance(figure, tuple):
        return float(np.mean(figure))
    return float(figure) if isinstance(figure, (int, float)) else float("nan")


def _paths(scenario: Scenario, flown: Sequence[Flown]) -> PathFigure:
    count = 1 if scenario.is_fixed else DRAWN_PATHS
    paths, arrows, targets = [], [], []
    for each in flown:
        for number, track in enumerate(each.tracks[:count]):
            stride = max(1, -(-len(track.times) // PATH_POINTS))
            points = track.position[np.unique([*range(0, len(track.times), stride), len(track.times) - 1])]
            paths.append(Path(each.label, each.colour, points, track.lost, first=number == 0))
            targets.append(track.targets)
            if scenario.is_fixed or number == 0:
                arrows += _arrows(track)
    points = np.concatenate([path.points for path in paths])
    length = ARROW * float(np.ptp(points, axis=0).max())
    longest = max((float(np.linalg.norm(arrow.vector)) for arrow in arrows), default=1.0)
    scaled = [Arrow(arrow.at, arrow.vector * length / longest, arrow.text) for arrow in arrows]
    shown = np.asarray(np.unique(np.round(np.concatenate(targets), 6), axis=0), dtype=np.float64)
    what = "The first flight of each controller" if count == 1 else f"The first {count} flights of each controller"
    caption = f"{what}; a cross marks where one is lost." + (" Arrows: the external force." if scaled else "")
    return PathFigure(f"{scenario.name}_paths", caption, paths, shown, flown[0].tracks[0].position[0], scaled)


def _arrows(track: Track) -> list[Arrow]:
    """The forces met on a flight: one arrow for a short one, several along the way for one that lasts; lengths in N."""
    force = track.wrench[:, :3]
    size = np.linalg.norm(force, axis=1)
    pushed = np.flatnonzero(size > 0)
    chosen: list[int] = []
    for part in np.split(pushed, np.flatnonzero(np.diff(pushed) > 1) + 1):
        if part.size < BRIEF:
            chosen += part[:1].tolist()
            continue
        way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(track.position[part], axis=0), axis=1))])
        number = max(2, round(ARROWS * part.size / len(force)))
        chosen += part[np.searchsorted(way, np.linspace(0.0, way[-1], number))].tolist()
    return [Arrow(track.position[k], force[k], f"{size[k]:.3g} N at {track.times[k]:.2f} s") for k in chosen]


def _errors(scenario: Scenario, flown: Sequence[Flown]) -> LineFigure:
    lines = []
    for each in flown:
        if not scenario.is_fixed:
            lines += [Line(each.label, each.colour, *_thinned(track), faint=True) for track in each.tracks]
        lines.append(_median(each, band=scenario.is_fixed))
    spans = []
    for wrench in scenario.wrenches:
        if wrench.duration is not None and wrench.start + wrench.duration < scenario.duration:
            spans.append((wrench.start, wrench.start + wrench.duration, "push" if wrench.duration > 0.2 else "hit"))
    count = len(flown[0].tracks)
    spread = (
        f"band: least to greatest of {count} flights" if scenario.is_fixed else f"thin: {count} flights of each controller"
    )
    caption = f"Thick: median, {spread}. A lost flight counts as infinitely far: a median ends where half are lost."
    return LineFigure(f"{scenario.name}_error", caption, "time (s)", "distance from target (m)", lines, spans)


def _thinned(track: Track) -> tuple[FloatArray, FloatArray]:
    stride = max(1, -(-len(track.times) // LINE_POINTS))
    return track.times[::stride], track.error[::stride]


def _median(flown: Flown, band: bool) -> Line:
    longest = max(flown.tracks, key=lambda track: len(track.times))
    errors = np.full((len(flown.tracks), len(longest.times)), np.inf)
    for row, track in zip(errors, flown.tracks, strict=True):
        row[: len(track.times)] = track.error
    stride = max(1, -(-len(longest.times) // LINE_POINTS))
    quantiles = np.quantile(errors[:, ::stride], (0.0, 0.5, 1.0), axis=0, method="higher")
    low, middle, high = np.where(np.isfinite(quantiles), quantiles, np.nan)
    line = Line(flown.label, flown.colour, longest.times[::stride], middle)
    return replace(line, low=np.where(np.isnan(high), np.nan, low), high=high) if band else line


def _hits(scenario: Scenario, flown: Sequence[Flown]) -> LineFigure:
    lines = []
    for each in flown:
        if each.entry.hit_limit is None:
            continue
        trials = sorted(each.entry.hit_limit.trials, key=lambda trial: trial.factor)
        shares = [trial.survived for trial in trials]
        values, low, high = (100.0 * np.array([getattr(share, name) for share in shares]) for name in ("value", "low", "high"))
        lines.append(Line(each.label, each.colour, np.array([trial.factor for trial in trials]), values, low, high))
    caption = "Flights that survive when force and torque are scaled by a factor, with 95 % intervals."
    labels = "factor of force and torque", "survived (%)"
    return LineFigure(f"{scenario.name}_limit", caption, *labels, lines, y_range=(-3.0, 103.0), marks=True, log_x=True)


def _sweep(group: str, key: str, scenarios: Sequence[Scenario], flown: Sequence[Sequence[Flown]]) -> list[Figure]:
    success, error = [], []
    for label, colour in _controllers(flown):
        cells = [
            (scenario.cell[key], each.entry.metrics)
            for scenario, entries in zip(scenarios, flown, strict=True)
            for each in entries
            if each.label == label
        ]
        x = np.array([value for value, _ in cells])
        shares = [
            100.0 * np.array([getattr(figures.success, name) for _, figures in cells]) for name in ("value", "low", "high")
        ]
        value, low, high = shares
        success.append(Line(label, colour, x, value, low, high))
        medians = [figures.final_error_median for _, figures in cells]
        error.append(Line(label, colour, x, np.array([np.nan if value is None else value for value in medians])))
    x_label = axis_label(key).replace("_", " ")
    return [
        LineFigure(
            f"{group}_success",
            "Success, with 95 % intervals.",
            x_label,
            "success (%)",
            success,
            y_range=(-3.0, 103.0),
            marks=True,
        ),
        LineFigure(
            f"{group}_error",
            "Median of the final error of flights that were not lost.",
            x_label,
            "final distance (m)",
            error,
            marks=True,
        ),
    ]


def _heat_map(group: str, keys: Sequence[str], scenarios: Sequence[Scenario], flown: Sequence[Sequence[Flown]]) -> HeatFigure:
    """Success over the first two keys, a panel for each controller and each combination of the others."""
    x_values, y_values = (sorted({scenario.cell[key] for scenario in scenarios}) for key in keys[:2])
    panels: dict[tuple[str, str], FloatArray] = {}
    controllers = _controllers(flown)
    for label, _ in controllers:
        for scenario, entries in zip(scenarios, flown, strict=True):
            rest = ", ".join(_with_unit(key, scenario.cell[key]) for key in keys[2:])
            grid = panels.setdefault((label, rest), np.full((len(y_values), len(x_values)), np.nan))
            for each in entries:
                if each.label == label:
                    place = y_values.index(scenario.cell[keys[1]]), x_values.index(scenario.cell[keys[0]])
                    grid[place] = 100.0 * each.entry.metrics.success.value
    names = ", ".join(axis_name(key).replace("_", " ") for key in keys)
    return HeatFigure(
        f"{group}_success",
        f"Success in % over {names}.",
        axis_label(keys[0]).replace("_", " "),
        axis_label(keys[1]).replace("_", " "),
        [f"{value:g}" for value in x_values],
        [f"{value:g}" for value in y_values],
        [HeatPanel(label, rest, grid) for (label, rest), grid in panels.items()],
        dict(controllers),
    )


def _with_unit(key: str, value: float) -> str:
    name, _, unit = axis_label(key).replace("_", " ").partition(" (")
    return f"{name} {value:g} {unit.removesuffix(')')}".strip()


def _controllers(flown: Sequence[Sequence[Flown]]) -> list[tuple[str, str]]:
    return list(dict.fromkeys((each.label, each.colour) for entries in flown for each in entries))
