"""The plots of one scenario: times to its target, distances from it, and how large a hit is survived."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from sb3_quad.base.arrays import FloatArray
from sb3_quad.evaluation.flightlog import Track
from sb3_quad.evaluation.results import Entry
from sb3_quad.evaluation.scenarios.scenario import Scenario
from sb3_quad.report.plots import INK, PAPER, POINTS, Plot, band, interval_ends, legend, new_axes, styled

FORCE = "#db1a24"
LINE_POINTS = 200  # that a flight is drawn with, at most


class ControllerFlights(NamedTuple):
    """One controller in one scenario: its colour, its metrics, its recorded flights."""

    label: str
    colour: str
    entry: Entry
    tracks: Sequence[Track]


@styled
def arrivals_plot(scenario: Scenario, flights: Sequence[ControllerFlights], source: str) -> Plot:
    """Bars of the mean times to each tolerance, cf. Figs. 4.6 and 4.7.

    :param source: where the reference metrics come from.
    """
    figure, axes = new_axes("tolerance (m)", "time (s)")
    places, width = np.arange(len(scenario.tolerances)), 0.75 / len(flights)
    for number, each in enumerate(flights):
        arrivals = each.entry.metrics.arrivals
        value, low, high = interval_ends([arrival.time for arrival in arrivals])
        spread, middle = np.stack([value - low, high - value]), places + (number - 0.5 * (len(flights) - 1)) * width
        whiskers = {"ecolor": INK, "elinewidth": 0.9, "capsize": 2}
        axes.bar(middle, value, 0.92 * width, color=each.colour, label=each.label, yerr=spread, error_kw=whiskers)
        for x, y, arrival in zip(middle, high, arrivals, strict=True):
            if arrival.time is not None and arrival.share.value < 1.0:
                note = f"{100 * arrival.share.value:.3g} %"
                axes.annotate(note, (x, y), (0, 3), textcoords="offset points", rotation=90, ha="center", fontsize=6.5)
    for (name, reference), marker in zip(scenario.reference.items(), "Dos^" * len(scenario.reference), strict=False):
        given = {float(key): float(np.mean(time)) for key, time in reference.time_to.items() if time is not None}
        if given.keys() & set(scenario.tolerances):
            heights = [given.get(tolerance, np.nan) for tolerance in scenario.tolerances]
            style: Any = {"color": INK, "markerfacecolor": PAPER, "markeredgewidth": 1.3, "markersize": 6, "zorder": 4}
            axes.plot(places, heights, marker, label=f"{source}: {name}", **style)
    axes.set_xticks(places, [f"{tolerance:g}" for tolerance in scenario.tolerances])
    axes.grid(axis="x", visible=False)
    legend(figure, axes)
    caption = (
        "Mean time until the vehicle is first within a tolerance of its target, over the flights that get there; "
        "their share, if not all, stands above."
    )
    return Plot(f"{scenario.name}_times", caption, figure)


@styled
def errors_plot(scenario: Scenario, flights: Sequence[ControllerFlights]) -> Plot:
    """Distances from the target over time, of controllers with recorded flights."""
    figure, axes = new_axes("time (s)", "distance from target (m)")
    for each in flights:
        x, ends = _quantiles(each.tracks)
        if scenario.is_fixed:
            band(axes, each.colour, each.label, x, ends)
            continue
        for track in each.tracks:
            axes.plot(track.times[:: _stride(track)], track.error[:: _stride(track)], each.colour, linewidth=0.6, alpha=0.45)
        axes.plot(x, ends[0], color=each.colour, label=each.label, linewidth=1.8)
    for wrench in scenario.wrenches:
        if wrench.duration is not None and wrench.start + wrench.duration < scenario.duration:
            axes.axvspan(wrench.start, wrench.start + wrench.duration, facecolor=FORCE, edgecolor=FORCE, alpha=0.16)
            style: Any = {"xycoords": ("data", "axes fraction"), "textcoords": "offset points", "va": "top"}
            axes.annotate("push", (wrench.start, 1.0), (2, -2), **style)
    axes.set_ylim(bottom=0.0)
    legend(figure, axes)
    count = len(flights[0].tracks)
    spread = f"band: least to greatest of {count}" if scenario.is_fixed else f"thin: {count}"
    caption = f"Thick: median, {spread} flights. A lost flight counts as infinitely far: a median ends where half are lost."
    return Plot(f"{scenario.name}_error", caption, figure)


def _stride(track: Track) -> int:
    return -(-len(track.times) // LINE_POINTS)


def _quantiles(tracks: Sequence[Track]) -> tuple[FloatArray, FloatArray]:
    """Times, (k,), and the median, least and greatest error, (3, k); NaN where it is infinite."""
    longest = max(tracks, key=lambda track: len(track.times))
    errors = np.full((len(tracks), len(longest.times)), np.inf)
    for row, track in zip(errors, tracks, strict=True):
        row[: len(track.times)] = track.error
    ends = np.quantile(errors[:, :: _stride(longest)], (0.5, 0.0, 1.0), axis=0, method="higher")
    return longest.times[:: _stride(longest)], np.where(np.isfinite(ends), ends, np.nan)


@styled
def hits_plot(scenario: Scenario, flights: Sequence[ControllerFlights]) -> Plot:
    """Shares of flights that survive, over the size of force and torque."""
    figure, axes = new_axes("factor of force and torque", "survived (%)")
    for each in flights:
        if each.entry.hit_limit is not None:
            trials = sorted(each.entry.hit_limit.trials, key=lambda trial: trial.factor)
            factors = np.array([trial.factor for trial in trials])
            band(axes, each.colour, each.label, factors, interval_ends([trial.survived for trial in trials], 100.0), **POINTS)
    axes.set_xscale("log", base=2)
    axes.set_ylim(-3.0, 103.0)
    axes.xaxis.set_major_formatter("{x:g}")
    legend(figure, axes)
    caption = "Flights that survive when force and torque are scaled by a factor, with 95 % intervals."
    return Plot(f"{scenario.name}_limit", caption, figure)
