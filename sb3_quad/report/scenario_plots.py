"""The plots of a scenario: paths, times to its target, distances from it, what ``vary`` changes."""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sb3_quad.evaluation.flightlog import Track
from sb3_quad.evaluation.metrics import Metrics
from sb3_quad.evaluation.results import Results
from sb3_quad.evaluation.scenarios.load import axis_label
from sb3_quad.evaluation.scenarios.scenario import Scenario
from sb3_quad.report.plots import HEIGHT, POINTS, WIDTH, Plot, band, legend, new_axes, styled

FORCE = "#db1a24"
TARGET = "#1a9a45"
LEAST_ERROR = 1e-3  # m; smaller ones are drawn at this value of the logarithmic axis
LINE_POINTS = 200  # maximum number of points of a flight
SHOWN_FLIGHTS = 4  # of a controller


@styled
def arrivals_plot(
    scenario: Scenario, metrics: Mapping[str, Metrics], colours: Mapping[str, str]
) -> Plot:
    """Draw the mean times to each tolerance, cf. Figs. 4.6 and 4.7.

    :param metrics: metrics by the controllers' labels, like ``colours``.
    """
    figure, axes = new_axes("tolerance (m)", "time (s)")
    for label, measured in metrics.items():
        # There is no point if no flight arrives.
        means = [dict(arrival.time or {}) for arrival in measured.arrivals]
        times = pd.DataFrame(means, scenario.tolerances, ["value", "low", "high"], np.float64)
        band(axes, colours[label], label, times, **POINTS)
    axes.set_ylim(bottom=0.0)
    legend(figure)
    return Plot(
        f"{scenario.name}_times",
        "Mean time until the vehicle is first within a tolerance of its target, over the flights"
        " that get there, with 95 % intervals.",
        figure,
    )


@styled
def paths_plot(
    scenario: Scenario, flights: Mapping[str, Sequence[Track]], colours: Mapping[str, str]
) -> Plot:
    """Draw recorded flights from above and from the side, with targets, or the paths of moving
    references, and disturbances.

    :param flights: flights by the controllers' labels, like ``colours``.
    """
    follows = scenario.reference is not None
    # Place the views one above the other, so that they can be read on a telephone.
    figure = Figure(figsize=(WIDTH, 2.2 * HEIGHT), layout="constrained")
    for axes, (i, j) in zip(figure.subplots(2, 1), ((0, 1), (0, 2)), strict=True):
        axes.set(xlabel=f"{'xyz'[i]} (m)", ylabel=f"{'xyz'[j]} (m)", aspect="equal")
        axes.set_adjustable("datalim")
        for label, tracks in flights.items():
            for track in tracks[:SHOWN_FLIGHTS]:
                _draw_path(axes, track, label, colours[label], [i, j], follows)
    legend(figure)
    return Plot(
        f"{scenario.name}_paths",
        f"The first {SHOWN_FLIGHTS} flights of each controller, from above and from the side. A"
        " cross marks where a flight is lost; red arrows show the direction of a force.",
        figure,
    )


def _draw_path(
    axes: Axes, track: Track, label: str, colour: str, plane: list[int], follows: bool
) -> None:
    stride = -(-len(track.position) // LINE_POINTS)
    path = track.position[:, plane]
    axes.plot(*path[::stride].T, color=colour, label=label, linewidth=1.8)
    if follows:
        axes.plot(*track.target[::stride, plane].T, color=TARGET, label="reference", zorder=1)
    else:
        axes.plot(*track.targets[:, plane].T, "D", color=TARGET, markersize=4, label="target")
    if track.lost:
        axes.plot(*path[-1], "X", color=colour, markersize=9)
    # Draw an arrow where a force begins.
    acts = track.wrench[:, :3].any(axis=1)
    begins = acts & ~np.roll(acts, 1)
    force = track.wrench[begins, :3]
    direction = force / np.linalg.norm(force, axis=1, keepdims=True)
    if begins.any():
        arrows = axes.quiver(
            *path[begins].T, *direction[:, plane].T, color=FORCE, scale=12, width=0.006
        )
        arrows.set_label("disturbance force")


@styled
def errors_plot(
    scenario: Scenario, flights: Mapping[str, Sequence[Track]], colours: Mapping[str, str]
) -> Plot:
    """Draw distances from the target over time, of :func:`paths_plot`'s flights."""
    figure, axes = new_axes("time (s)", "distance from target (m)")
    for label, tracks in flights.items():
        lines = [pd.Series(track.error, track.times) for track in tracks]
        # A flight that ended early is lost, which counts as infinitely far away.
        errors = pd.concat(lines, axis="columns").fillna(np.inf)
        errors = errors[:: -(-len(errors) // LINE_POINTS)]
        ends = errors.quantile([0.5, 0.0, 1.0], axis="columns", interpolation="higher").T
        band(axes, colours[label], label, ends.replace(np.inf, np.nan))
    # A disturbance that lasts to the end would colour the whole plot.
    for wrench in scenario.wrenches:
        end = wrench.start + (wrench.duration or np.inf)
        if end < scenario.duration:
            axes.axvspan(wrench.start, end, color=FORCE, alpha=0.16)
    axes.set_ylim(bottom=0.0)
    legend(figure)
    # The same number of flights is recorded for each controller.
    return Plot(
        f"{scenario.name}_error",
        f"Median of {len(tracks)} flights, in a band from the least to the greatest"
        " distance; red: a disturbance. A lost flight counts as infinitely far away, so that a"
        " median ends where half of the flights are lost.",
        figure,
    )


@styled
def group_plots(results: Results, scenarios: Sequence[Scenario]) -> list[Plot]:
    """Draw the cells that ``vary`` makes of a scenario: success over each quantity, the final error
    over a single one.
    """
    group = scenarios[0].group
    keys = [*scenarios[0].cell]
    controllers = _cells(results, scenarios).groupby("label", sort=False)
    is_single = len(keys) == 1
    plots = []
    for number, key in enumerate(keys):
        figure, axes = new_axes(axis_label(key), "success (%)")
        for label, flown in controllers:
            cells = flown.groupby(key)
            if is_single:
                shares = cells[["value", "low", "high"]].first()
            else:
                shares = cells["value"].agg(["mean", "min", "max"])
            band(axes, results.colours[label], label, 100.0 * shares, **POINTS)
        axes.set_ylim(-3.0, 103.0)
        legend(figure)
        name = f"{group}_{number}_success"
        caption = "Success, mean, least and greatest over the other quantities."
        if is_single:
            name = f"{group}_success"
            caption = "Success, with 95 % intervals."
        plots.append(Plot(name, caption, figure))
    if is_single:
        figure, axes = new_axes(axis_label(keys[0]), "final error (m)")
        for label, flown in controllers:
            errors = flown.set_index(keys[0])["error"].dropna().sort_index().clip(lower=LEAST_ERROR)
            axes.plot(errors, color=results.colours[label], label=label, **POINTS)
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:g}")
        legend(figure)
        plots.append(
            Plot(
                f"{group}_error",
                "Median final error of the flights that survive, unless these are fewer than half;"
                " errors below 1 mm are drawn at 1 mm.",
                figure,
            )
        )
    return plots


def _cells(results: Results, scenarios: Sequence[Scenario]) -> pd.DataFrame:
    """A row for each controller in each cell in which it did not fail: its success, and its final
    error if at least half of the flights survive.
    """
    rows = []
    for label in results.colours:
        for scenario in scenarios:
            entry = results.entry(label, scenario.name)
            if entry is not None:
                metrics = entry.metrics
                row = {**scenario.cell, "label": label, **dict(metrics.success)}
                if metrics.survival.value >= 0.5:
                    row["error"] = metrics.final_error_median
                rows.append(row)
    columns = [*scenarios[0].cell, "label", "value", "low", "high", "error"]
    return pd.DataFrame(rows, columns=columns)
