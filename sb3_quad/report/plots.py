"""The plots of a report, drawn by matplotlib: how they look, and the bars and lines of a scenario's results."""

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sb3_quad.base.arrays import FloatArray
from sb3_quad.evaluation.flightlog import Track
from sb3_quad.evaluation.results import Entry
from sb3_quad.evaluation.scenarios.scenario import Scenario
from sb3_quad.evaluation.statistics import Estimate

INK, QUIET, GRID, PAPER = "#1c2430", "#5c6672", "#dfe3e8", "#ffffff"  # of text, small print, grid and background
FORCE = "#db1a24"
WIDTH, HEIGHT = 5.0, 3.3  # inches: two stand side by side in the page, and one can be read on a telephone
DPI, LINE_POINTS = 150, 200  # points that a flight is drawn with, at most
POINTS: Any = {"marker": "o", "markersize": 3.5}  # on curves through few of them
STYLE: Any = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "svg.fonttype": "none",
    "svg.hashsalt": "sb3_quad",
    "text.parse_math": False,
    "grid.color": GRID,
    "figure.facecolor": PAPER,
    "axes.facecolor": PAPER,
    **dict.fromkeys(("text.color", "axes.labelcolor", "xtick.labelcolor", "ytick.labelcolor"), INK),
    **dict.fromkeys(("axes.edgecolor", "xtick.color", "ytick.color"), QUIET),
}
styled = matplotlib.rc_context(STYLE)
METADATA = dict.fromkeys(("Date", "Creator", "Format", "Type"))  # left out: the same results give the same file


class Flown(NamedTuple):
    """One controller in one scenario: its colour, its metrics, its sampled flights."""

    label: str
    colour: str
    entry: Entry
    tracks: Sequence[Track]


@dataclass(frozen=True, eq=False)
class Plot:
    """A plot of a report.

    :param name: of its files; unique in a report.
    :param space: the same in three dimensions, ``data`` and ``layout`` of Plotly, to be turned in the page; None: the page
        shows the picture.
    """

    name: str
    caption: str
    figure: Figure
    space: dict[str, Any] | None = None

    @cached_property
    def svg(self) -> bytes:
        """The plot as an SVG file."""
        return picture(self.figure, "svg", bbox_inches="tight", metadata=METADATA)

    @cached_property
    def png(self) -> bytes:
        """The plot as a PNG file."""
        return picture(self.figure, "png", bbox_inches="tight", dpi=DPI)

    @property
    def is_narrow(self) -> bool:
        """Whether two of its kind stand side by side in the page."""
        return self.space is None and self.figure.get_figwidth() <= WIDTH

    @property
    def inline(self) -> str:
        """The plot as a part of the page: an ``svg`` element in the page's colours, which may be dark."""
        text = self.svg.decode("utf-8")
        text = text[text.index("<svg") :]
        for colour, name in ((INK, "ink"), (QUIET, "quiet"), (GRID, "grid"), (PAPER, "paper")):
            text = text.replace(colour, f"var(--{name})")
        text = re.sub(r' id="[a-zA-Z0-9]+_\d+"', "", text)  # names of groups, which others have, too
        return re.sub(r' d="[^"]*"', lambda path: re.sub(r"(\.\d\d)\d+", r"\1", path[0]), text)  # to 0.01 of a point


@styled
def picture(figure: Figure, kind: str, **options: Any) -> bytes:
    """A figure of matplotlib as a file of some kind, such as ``png``; ``options`` are those of its ``savefig``."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, **options)
    return buffer.getvalue()


def legend(figure: Figure, axes: Any, first: Sequence[str] = (), side: Literal["upper", "lower"] = "upper") -> None:
    """Every name of ``axes``, one or several, once outside, those of ``first`` first, in as many columns as have room."""
    pairs = [zip(*each.get_legend_handles_labels(), strict=True) for each in np.ravel(axes)]
    found = {name: handle for pair in pairs for handle, name in pair}
    order = sorted(found, key=lambda name: name not in first)
    place: Any = f"outside {side} left"
    for columns in range(len(order), 0, -1):
        made = figure.legend([found[name] for name in order], order, loc=place, ncols=columns)
        if columns == 1 or made.get_window_extent().width <= figure.bbox.width:
            break
        made.remove()


def new_axes(x_label: str, y_label: str) -> tuple[Figure, Axes]:
    """A figure as wide as one of two side by side, and its axes."""
    figure = Figure(figsize=(WIDTH, HEIGHT), layout="constrained")
    axes = figure.subplots()
    axes.set(xlabel=x_label, ylabel=y_label)
    return figure, axes


def interval_ends(estimates: Sequence[Estimate | None], factor: float = 1.0) -> FloatArray:
    """Values and both ends of their intervals, (3, n); NaN where there is none."""
    rows = [[each and getattr(each, name) for each in estimates] for name in ("value", "low", "high")]
    return factor * np.array(rows, dtype=np.float64)


def band(axes: Axes, colour: str, label: str, x: FloatArray, ends: FloatArray, **style: Any) -> None:
    """A line and the band around it; ``ends`` are values, low and high, (3, n)."""
    axes.plot(x, ends[0], color=colour, label=label, **{"linewidth": 1.6, **style})
    axes.fill_between(x, ends[1], ends[2], color=colour, alpha=0.16, linewidth=0)


@styled
def arrivals_plot(scenario: Scenario, flown: Sequence[Flown], source: str) -> Plot:
    """Bars of the mean times to each tolerance, cf. Figs. 4.6 and 4.7.

    :param source: where the reference metrics come from.
    """
    figure, axes = new_axes("tolerance (m)", "time (s)")
    places, width = np.arange(len(scenario.tolerances)), 0.75 / len(flown)
    for number, each in enumerate(flown):
        arrivals = each.entry.metrics.arrivals
        value, low, high = interval_ends([arrival.time for arrival in arrivals])
        spread, middle = np.stack([value - low, high - value]), places + (number - 0.5 * (len(flown) - 1)) * width
        bars = {"ecolor": INK, "elinewidth": 0.9, "capsize": 2}
        axes.bar(middle, value, 0.92 * width, color=each.colour, label=each.label, yerr=spread, error_kw=bars)
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
    legend(figure, axes, [each.label for each in flown])
    caption = (
        "Mean time until the vehicle is first within a tolerance of its target, over the flights that get there; "
        "their share, if not all, stands above."
    )
    return Plot(f"{scenario.name}_times", caption, figure)


@styled
def errors_plot(scenario: Scenario, flown: Sequence[Flown]) -> Plot:
    """Distances from the target over time, of controllers with sampled flights."""
    figure, axes = new_axes("time (s)", "distance from target (m)")
    for each in flown:
        x, ends = _quantiles(each.tracks)
        if scenario.is_fixed:
            band(axes, each.colour, each.label, x, ends)
            continue
        for track in each.tracks:
            stride = max(1, -(-len(track.times) // LINE_POINTS))
            axes.plot(track.times[::stride], track.error[::stride], color=each.colour, linewidth=0.6, alpha=0.45)
        axes.plot(x, ends[0], color=each.colour, label=each.label, linewidth=1.8)
    for wrench in scenario.wrenches:
        if wrench.duration is not None and wrench.start + wrench.duration < scenario.duration:
            axes.axvspan(wrench.start, wrench.start + wrench.duration, facecolor=FORCE, edgecolor=FORCE, alpha=0.16)
            style: Any = {"xycoords": ("data", "axes fraction"), "textcoords": "offset points", "va": "top"}
            axes.annotate("push" if wrench.duration > 0.2 else "hit", (wrench.start, 1.0), (2, -2), **style)
    axes.set_ylim(bottom=0.0)
    legend(figure, axes)
    count = len(flown[0].tracks)
    spread = f"band: least to greatest of {count} flights"
    spread = spread if scenario.is_fixed else f"thin: {count} flights of each controller"
    caption = f"Thick: median, {spread}. A lost flight counts as infinitely far: a median ends where half are lost."
    return Plot(f"{scenario.name}_error", caption, figure)


def _quantiles(tracks: Sequence[Track]) -> tuple[FloatArray, FloatArray]:
    """Times, (k,), and the median, least and greatest error, (3, k); NaN where it is infinite."""
    longest = max(tracks, key=lambda track: len(track.times))
    errors = np.full((len(tracks), len(longest.times)), np.inf)
    for row, track in zip(errors, tracks, strict=True):
        row[: len(track.times)] = track.error
    stride = max(1, -(-len(longest.times) // LINE_POINTS))
    ends = np.quantile(errors[:, ::stride], (0.5, 0.0, 1.0), axis=0, method="higher")
    return longest.times[::stride], np.where(np.isfinite(ends), ends, np.nan)


@styled
def hits_plot(scenario: Scenario, flown: Sequence[Flown]) -> Plot:
    """Shares of flights that survive, over the size of force and torque."""
    figure, axes = new_axes("factor of force and torque", "survived (%)")
    for each in flown:
        if each.entry.hit_limit is not None:
            trials = sorted(each.entry.hit_limit.trials, key=lambda trial: trial.factor)
            factors = np.array([trial.factor for trial in trials])
            ends = interval_ends([trial.survived for trial in trials], 100.0)
            first = 1 + next((k for k, share in enumerate(ends[0]) if share <= 50.0), len(factors))
            band(axes, each.colour, each.label, factors[:first], ends[:, :first], **POINTS)
            axes.plot(factors[first:], ends[0, first:], color=each.colour, **POINTS, linestyle="none", markerfacecolor=PAPER)
    axes.set_xscale("log", base=2)
    axes.set_ylim(-3.0, 103.0)
    axes.xaxis.set_major_formatter("{x:g}")
    legend(figure, axes)
    caption = (
        "Flights that survive when force and torque are scaled by a factor, with 95 % intervals, up to the first "
        "that at most half survive. Open circles: greater factors, of which a few may be survived again."
    )
    return Plot(f"{scenario.name}_limit", caption, figure)
