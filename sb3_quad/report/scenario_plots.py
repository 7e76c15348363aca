"""The plots of a scenario: paths, times to its target, distances from it, what ``vary`` changes."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
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

FORCE, TARGET = "#db1a24", "#1a9a45"
LEAST_ERROR = 1e-3  # m; smaller ones are drawn there, on a logarithmic axis
LINE_POINTS = 200  # that a flight is drawn with, at most
SHOWN_FLIGHTS = 4  # of a controller, of random episodes


class ControllerFlights(NamedTuple):
    """One controller in one scenario: its colour, its recorded flights."""

    label: str
    colour: str
    tracks: Sequence[Track]


@styled
def arrivals_plot(
    scenario: Scenario, metrics: Mapping[str, Metrics], colours: Mapping[str, str]
) -> Plot:
    """Bars of the mean times to each tolerance, cf. Figs. 4.6 and 4.7; metrics and colours by the
    controllers' labels.
    """
    figure, axes = new_axes("tolerance (m)", "time (s)")
    places, width = np.arange(len(scenario.tolerances)), 0.75 / len(metrics)
    for number, (label, each) in enumerate(metrics.items()):
        value, low, high = interval_ends([arrival.time for arrival in each.arrivals])
        spread, middle = (
            np.stack([value - low, high - value]),
            places + (number - 0.5 * (len(metrics) - 1)) * width,
        )
        whiskers = {"ecolor": INK, "elinewidth": 0.9, "capsize": 2}
        axes.bar(
            middle,
            value,
            0.92 * width,
            color=colours[label],
            label=label,
            yerr=spread,
            error_kw=whiskers,
        )
    axes.set_xticks(places, [f"{tolerance:g}" for tolerance in scenario.tolerances])
    axes.grid(axis="x", visible=False)
    legend(figure)
    caption = "Mean time until the vehicle is first within a tolerance of its target, over the flights that get there."
    return Plot(f"{scenario.name}_times", caption, figure)


@styled
def paths_plot(scenario: Scenario, flights: Sequence[ControllerFlights]) -> Plot:
    """Flights seen from above and from the side, their targets and the pushes met, of controllers
    with recorded flights.
    """
    count = 1 if scenario.is_fixed else SHOWN_FLIGHTS
    figure = Figure(figsize=(2.0 * WIDTH, 1.2 * HEIGHT), layout="constrained")
    for axes, (i, j) in zip(figure.subplots(1, 2), ((0, 1), (0, 2)), strict=True):
        axes.set(
            xlabel=f"{'xyz'[i]} (m)", ylabel=f"{'xyz'[j]} (m)", aspect="equal", adjustable="datalim"
        )
        for each in flights:
            for track in each.tracks[:count]:
                path = track.position[:: -(-len(track.position) // LINE_POINTS)]
                axes.plot(
                    path[:, i], path[:, j], color=each.colour, label=each.label, linewidth=1.2
                )
                axes.plot(
                    *track.targets[:, [i, j]].T, "D", color=TARGET, markersize=4, label="target"
                )
                if track.lost:
                    axes.plot(*track.position[-1, [i, j]], "x", color=each.colour)
                pushed = track.wrench[:, :3].any(axis=1)
                begins = pushed & ~np.roll(pushed, 1)
                force = track.wrench[begins, :3] / np.linalg.norm(
                    track.wrench[begins, :3], axis=1, keepdims=True
                )
                axes.quiver(
                    *track.position[begins][:, [i, j]].T,
                    *force[:, [i, j]].T,
                    color=FORCE,
                    scale=12,
                    width=0.006,
                )
    legend(figure)
    what = (
        "The first flight of each controller"
        if count == 1
        else f"The first {count} flights of each controller"
    )
    caption = f"{what}, from above and from the side; a cross marks where one is lost, red the direction of a push."
    return Plot(f"{scenario.name}_paths", caption, figure)


@styled
def errors_plot(scenario: Scenario, flights: Sequence[ControllerFlights]) -> Plot:
    """Distances from the target over time, of controllers with recorded flights."""
    figure, axes = new_axes("time (s)", "distance from target (m)")
    for each in flights:
        band(axes, each.colour, each.label, *_quantiles(each.tracks))
    for wrench in scenario.wrenches:
        if wrench.duration is not None and wrench.start + wrench.duration < scenario.duration:
            axes.axvspan(
                wrench.start,
                wrench.start + wrench.duration,
                facecolor=FORCE,
                edgecolor=FORCE,
                alpha=0.16,
            )
    axes.set_ylim(bottom=0.0)
    legend(figure)
    caption = (
        f"Median and band from least to greatest of {len(flights[0].tracks)} flights; red: a push. A lost flight counts as"
        " infinitely far: a median ends where half are lost."
    )
    return Plot(f"{scenario.name}_error", caption, figure)


def _quantiles(tracks: Sequence[Track]) -> tuple[FloatArray, FloatArray]:
    """Times, (k,), and the median, least and greatest error, (3, k); NaN where it is infinite."""
    longest = max(tracks, key=lambda track: len(track.times))
    errors = np.full((len(tracks), len(longest.times)), np.inf)
    for row, track in zip(errors, tracks, strict=True):
        row[: len(track.times)] = track.error
    chosen = slice(None, None, -(-len(longest.times) // LINE_POINTS))
    ends = np.quantile(errors[:, chosen], (0.5, 0.0, 1.0), axis=0, method="higher")
    return longest.times[chosen], np.where(np.isfinite(ends), ends, np.nan)


@styled
def group_plots(
    results: Results, scenarios: Sequence[Scenario], colours: Mapping[str, str]
) -> list[Plot]:
    """The plots of the cells that ``vary`` makes of a scenario: success over each quantity, the
    final error over a single one.

    :param colours: by the labels of the controllers.
    """
    group, cell, plots = scenarios[0].group, scenarios[0].cell, []
    found = [
        (label, each, results.entry(label, each.name)) for label in colours for each in scenarios
    ]
    flown = [(label, each.cell, entry.metrics) for label, each, entry in found if entry is not None]
    for number, key in enumerate(cell):
        name = axis_label(key, scenarios[0])
        figure, axes = new_axes(name, "success (%)")
        for label in dict.fromkeys(each[0] for each in flown):
            metrics = [(at[key], metrics) for who, at, metrics in flown if who == label]
            values = sorted({at for at, _ in metrics})
            rows = [
                interval_ends([m.success or m.survival for at, m in metrics if at == x], 100.0)
                for x in values
            ]
            # Of one quantity the interval; of several the least and the greatest share over the
            # others.
            ends = [
                row[:, 0] if len(cell) == 1 else (row[0].mean(), row[0].min(), row[0].max())
                for row in rows
            ]
            band(axes, colours[label], label, np.array(values), np.transpose(ends), **POINTS)
        axes.set_ylim(-3.0, 103.0)
        legend(figure)
        spread = (
            "with 95 % intervals"
            if len(cell) == 1
            else "mean, least and greatest over the other quantities"
        )
        ending = "success" if len(cell) == 1 else f"{number}_success"
        plots.append(Plot(f"{group}_{ending}", f"Success, {spread}.", figure))
    if len(cell) == 1:
        figure, axes = new_axes(name, "final error (m)")
        for label in dict.fromkeys(each[0] for each in flown):
            cells = [
                (at[key], m.final_error_median)
                for who, at, m in flown
                if who == label and m.survival.value >= 0.5
            ]
            if cells:
                x, errors = np.array(cells, dtype=np.float64).T
                axes.plot(
                    x, np.maximum(errors, LEAST_ERROR), color=colours[label], label=label, **POINTS
                )
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:g}")
        legend(figure)
        caption = "Median final error of the flights that were not lost, unless these are fewer than half; 1 mm at least."
        plots.append(Plot(f"{group}_error", caption, figure))
    return plots
