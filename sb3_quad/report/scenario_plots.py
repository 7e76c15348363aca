"""The plots of a scenario: paths, times to its target, distances from it, what ``vary`` changes."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sb3_quad.base.arrays import FloatArray
from sb3_quad.evaluation.flightlog import Track
from sb3_quad.evaluation.metrics import Metrics
from sb3_quad.evaluation.results import Results
from sb3_quad.evaluation.scenarios.load import axis_label
from sb3_quad.evaluation.scenarios.scenario import Scenario
from sb3_quad.report.plots import (
    HEIGHT,
    INK,
    POINTS,
    WIDTH,
    Plot,
    band,
    interval_ends,
    legend,
    new_axes,
    styled,
)

FORCE = "#db1a24"
TARGET = "#1a9a45"
LEAST_ERROR = 1e-3  # m; smaller ones are drawn there, on a logarithmic axis
LINE_POINTS = 200  # of a flight, at most
SHOWN_FLIGHTS = 4  # of a controller, where episodes differ


class ControllerFlights(NamedTuple):
    """One controller in one scenario: its colour, its recorded flights."""

    label: str
    colour: str
    tracks: Sequence[Track]


@styled
def arrivals_plot(
    scenario: Scenario, metrics: Mapping[str, Metrics], colours: Mapping[str, str]
) -> Plot:
    """Draw bars of the mean times to each tolerance, cf. Figs. 4.6 and 4.7.

    :param metrics: by the controllers' labels, as are ``colours``.
    """
    figure, axes = new_axes("tolerance (m)", "time (s)")
    places = np.arange(len(scenario.tolerances))
    width = 0.75 / len(metrics)
    # A group of bars at each tolerance, one for each controller.
    for number, (label, measured) in enumerate(metrics.items()):
        value, low, high = interval_ends([arrival.time for arrival in measured.arrivals])
        axes.bar(
            places + (number - 0.5 * (len(metrics) - 1)) * width,
            value,
            0.92 * width,
            color=colours[label],
            label=label,
            yerr=np.stack([value - low, high - value]),
            error_kw={"ecolor": INK, "elinewidth": 0.9, "capsize": 2},
        )
    axes.set_xticks(places, [f"{tolerance:g}" for tolerance in scenario.tolerances])
    axes.grid(axis="x", visible=False)
    legend(figure)
    caption = (
        "Mean time until the vehicle is first within a tolerance of its target, over the flights"
        " that get there."
    )
    return Plot(f"{scenario.name}_times", caption, figure)


@styled
def paths_plot(scenario: Scenario, flights: Sequence[ControllerFlights]) -> Plot:
    """Draw recorded flights from above and from the side, with targets and disturbances."""
    count = 1 if scenario.is_fixed else SHOWN_FLIGHTS
    figure = Figure(figsize=(2.0 * WIDTH, 1.2 * HEIGHT), layout="constrained")
    for axes, (i, j) in zip(figure.subplots(1, 2), ((0, 1), (0, 2)), strict=True):
        axes.set(xlabel=f"{'xyz'[i]} (m)", ylabel=f"{'xyz'[j]} (m)", aspect="equal")
        axes.set_adjustable("datalim")
        for flown in flights:
            for track in flown.tracks[:count]:
                _draw_path(axes, track, flown, [i, j])
    legend(figure)
    flights_shown = "flight" if count == 1 else f"{count} flights"
    caption = (
        f"The first {flights_shown} of each controller, from above and from the side. A cross marks"
        " where a flight is lost; red arrows show the direction of a disturbance force."
    )
    return Plot(f"{scenario.name}_paths", caption, figure)


def _draw_path(axes: Axes, track: Track, flown: ControllerFlights, plane: list[int]) -> None:
    stride = -(-len(track.position) // LINE_POINTS)
    path = track.position[::stride, plane].T
    axes.plot(*path, color=flown.colour, label=flown.label, linewidth=1.2)
    axes.plot(*track.targets[:, plane].T, "D", color=TARGET, markersize=4, label="target")
    if track.lost:
        axes.plot(*track.position[-1, plane], "x", color=flown.colour)
    # An arrow where a force begins.
    acts = track.wrench[:, :3].any(axis=1)
    begins = acts & ~np.roll(acts, 1)
    force = track.wrench[begins, :3]
    direction = force / np.linalg.norm(force, axis=1, keepdims=True)
    places = track.position[begins][:, plane].T
    axes.quiver(*places, *direction[:, plane].T, color=FORCE, scale=12, width=0.006)


@styled
def errors_plot(scenario: Scenario, flights: Sequence[ControllerFlights]) -> Plot:
    """Draw distances from the target over time, of controllers with recorded flights."""
    figure, axes = new_axes("time (s)", "distance from target (m)")
    for flown in flights:
        band(axes, flown.colour, flown.label, *_quantiles(flown.tracks))
    # A disturbance that lasts to the end would colour the whole plot.
    for wrench in scenario.wrenches:
        end = wrench.start + (wrench.duration or np.inf)
        if end < scenario.duration:
            axes.axvspan(wrench.start, end, facecolor=FORCE, edgecolor=FORCE, alpha=0.16)
    axes.set_ylim(bottom=0.0)
    legend(figure)
    caption = (
        f"Median of {len(flights[0].tracks)} flights, in a band from the least to the greatest"
        " distance; red: a disturbance. A lost flight counts as infinitely far away, so that a"
        " median ends where half of the flights are lost."
    )
    return Plot(f"{scenario.name}_error", caption, figure)


def _quantiles(tracks: Sequence[Track]) -> tuple[FloatArray, FloatArray]:
    """Times, (k,), and the median, least and greatest error, (3, k); NaN where it is infinite."""
    times = max((track.times for track in tracks), key=len)
    # A flight that has ended early is lost, infinitely far away.
    errors = np.full((len(tracks), len(times)), np.inf)
    for row, track in enumerate(tracks):
        errors[row, : len(track.times)] = track.error
    stride = -(-len(times) // LINE_POINTS)
    ends = np.quantile(errors[:, ::stride], (0.5, 0.0, 1.0), axis=0, method="higher")
    ends[np.isinf(ends)] = np.nan
    return times[::stride], ends


@styled
def group_plots(
    results: Results, scenarios: Sequence[Scenario], colours: Mapping[str, str]
) -> list[Plot]:
    """Draw the cells that ``vary`` makes of a scenario: success over each quantity, the final error
    over a single one.

    :param colours: by the labels of the controllers.
    """
    group = scenarios[0].group
    keys = [*scenarios[0].cell]
    plots = []
    for number, key in enumerate(keys):
        name = f"{group}_success" if len(keys) == 1 else f"{group}_{number}_success"
        figure, axes = new_axes(axis_label(key, scenarios[0]), "success (%)")
        for label, colour in colours.items():
            metrics = _by_value(results, scenarios, label, key)
            _draw_success(axes, metrics, label, colour, several=len(keys) > 1)
        axes.set_ylim(-3.0, 103.0)
        legend(figure)
        spread = "with 95 % intervals"
        if len(keys) > 1:
            spread = "mean, least and greatest over the other quantities"
        plots.append(Plot(name, f"Success, {spread}.", figure))
    if len(keys) == 1:
        figure, axes = new_axes(axis_label(keys[0], scenarios[0]), "final error (m)")
        for label, colour in colours.items():
            _draw_error(axes, _by_value(results, scenarios, label, keys[0]), label, colour)
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:g}")
        legend(figure)
        caption = (
            "Median final error of the flights that survive, unless these are fewer than half;"
            " errors below 1 mm are drawn at 1 mm."
        )
        plots.append(Plot(f"{group}_error", caption, figure))
    return plots


def _by_value(
    results: Results, scenarios: Sequence[Scenario], label: str, key: str
) -> dict[float, list[Metrics]]:
    """The metrics of a controller by the values of a varied key, rising; failures are not in it."""
    metrics: dict[float, list[Metrics]] = {}
    for scenario in sorted(scenarios, key=lambda cell: cell.cell[key]):
        entry = results.entry(label, scenario.name)
        if entry is not None:
            metrics.setdefault(scenario.cell[key], []).append(entry.metrics)
    return metrics


def _draw_success(
    axes: Axes,
    metrics: Mapping[float, Sequence[Metrics]],
    label: str,
    colour: str,
    several: bool,
) -> None:
    """A band of success over a quantity.

    It is the interval; of several quantities, the least and the greatest share over the others.
    """
    ends = []
    for measured in metrics.values():
        value, low, high = interval_ends([cell.success for cell in measured], 100.0)
        if several:
            ends.append([value.mean(), value.min(), value.max()])
        else:
            ends.append([value[0], low[0], high[0]])
    if ends:
        band(axes, colour, label, np.array([*metrics]), np.transpose(ends), **POINTS)


def _draw_error(
    axes: Axes, metrics: Mapping[float, Sequence[Metrics]], label: str, colour: str
) -> None:
    """A line of the median final error over a quantity, where at least half the flights survive."""
    errors = {}
    for value, measured in metrics.items():
        if measured[0].survival.value >= 0.5 and measured[0].final_error_median is not None:
            errors[value] = max(measured[0].final_error_median, LEAST_ERROR)
    if errors:
        axes.plot([*errors], [*errors.values()], color=colour, label=label, **POINTS)
