"""The plots of a scenario: paths, times to its target, distances from it, what ``vary`` changes."""

from collections.abc import Mapping, Sequence
from operator import attrgetter
from typing import NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sb3_quad.base.types import FloatArray
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
        value, low, high = interval_ends([*map(attrgetter("time"), measured.arrivals)])
        axes.bar(
            places + (number - 0.5 * (len(metrics) - 1)) * width,
            value,
            0.92 * width,
            color=colours[label],
            label=label,
            yerr=np.stack([value - low, high - value]),
            error_kw={"ecolor": INK, "elinewidth": 0.9, "capsize": 2},
        )
    axes.set_xticks(places, [*map("{:g}".format, scenario.tolerances)])
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
    longest = max(tracks, key=lambda track: len(track.times))
    # A flight that has ended early is lost, infinitely far away.
    errors = pd.DataFrame(map(attrgetter("error"), tracks)).fillna(np.inf)
    stride = -(-errors.shape[1] // LINE_POINTS)
    ends = np.quantile(errors, (0.5, 0.0, 1.0), axis=0, method="higher")[:, ::stride]
    return longest.times[::stride], np.where(np.isinf(ends), np.nan, ends)


@styled
def group_plots(results: Results, scenarios: Sequence[Scenario]) -> list[Plot]:
    """Draw the cells that ``vary`` makes of a scenario: success over each quantity, the final error
    over a single one.
    """
    group = scenarios[0].group
    table = _cells(results, scenarios)
    keys = [*scenarios[0].cell]
    spread = "with 95 % intervals"
    if len(keys) > 1:
        spread = "mean, least and greatest over the other quantities"
    plots = []
    for number, key in enumerate(keys):
        name = f"{group}_success"
        if len(keys) > 1:
            name = f"{group}_{number}_success"
        figure, axes = new_axes(axis_label(key, scenarios[0]), "success (%)")
        for label, flown in table.groupby("label", sort=False):
            shares = flown.groupby(key).agg({"success": "mean", "low": "min", "high": "max"})
            ends = 100.0 * shares.to_numpy().T
            band(axes, results.colours[label], label, shares.index, ends, **POINTS)
        axes.set_ylim(-3.0, 103.0)
        legend(figure)
        plots.append(Plot(name, f"Success, {spread}.", figure))
    if len(keys) == 1:
        figure, axes = new_axes(axis_label(keys[0], scenarios[0]), "final error (m)")
        for label, flown in table.dropna(subset="error").groupby("label", sort=False):
            errors = flown.set_index(keys[0])["error"].sort_index().clip(lower=LEAST_ERROR)
            axes.plot(errors, color=results.colours[label], label=label, **POINTS)
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:g}")
        legend(figure)
        caption = (
            "Median final error of the flights that survive, unless these are fewer than half;"
            " errors below 1 mm are drawn at 1 mm."
        )
        plots.append(Plot(f"{group}_error", caption, figure))
    return plots


def _cells(results: Results, scenarios: Sequence[Scenario]) -> pd.DataFrame:
    """A line for each controller in each cell that it did not fail in.

    Of several quantities, the ends are the share itself, so that they become the least and the
    greatest over the others. There is no error where most flights are lost.
    """
    keys = scenarios[0].cell
    rows = []
    for label in results.colours:
        for scenario in scenarios:
            entry = results.entry(label, scenario.name)
            if entry is not None:
                success = entry.metrics.success
                ends = (success.low, success.high)
                if len(keys) > 1:
                    ends = (success.value, success.value)
                error = entry.metrics.final_error_median
                if entry.metrics.survival.value < 0.5:
                    error = None
                rows.append((*scenario.cell.values(), label, success.value, *ends, error))
    columns = [*keys, "label", "success", "low", "high", "error"]
    return pd.DataFrame(rows, columns=columns).astype({"error": np.float64})
