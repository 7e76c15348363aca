"""The plots of what ``vary`` makes of scenarios: curves over one quantity, bars over several, all curves in one picture."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sb3_quad.base.arrays import FloatArray
from sb3_quad.evaluation.metrics import Metrics
from sb3_quad.evaluation.results import Results
from sb3_quad.evaluation.scenarios.load import UNITS, axis_label, axis_name
from sb3_quad.evaluation.scenarios.scenario import Scenario
from sb3_quad.report.plots import POINTS, WIDTH, Plot, band, interval_ends, legend, new_axes, styled

Groups = Sequence[tuple[str, Sequence[Scenario]]]
Cells = list[tuple[Scenario, Metrics]]  # those of a varied scenario that one controller has flown
IN_A_ROW = 3  # families side by side in one picture
LEAST_ERROR = 1e-3  # m; smaller ones are drawn there, on a logarithmic axis
MARKERS, ASIDE = "osD^vPX*", 0.014  # of the quantity's range: equal values stand side by side
ERRORS = "median of the final error of the flights that were not lost, unless these are fewer than half."


@styled
def group_plots(results: Results, scenarios: Sequence[Scenario], colours: Mapping[str, str]) -> list[Plot]:
    """The plots of the cells that ``vary`` makes of a scenario: curves over one quantity, or bars in each cell of several.

    :param colours: by the labels of the controllers.
    """
    flown = _flown(results, scenarios, colours)
    if not flown:
        return []
    return _sweep(scenarios[0], flown, colours) if len(scenarios[0].cell) == 1 else [_losses(scenarios, flown, colours)]


@styled
def families_plot(results: Results, groups: Groups, colours: Mapping[str, str]) -> list[Plot]:
    """One picture of all groups of which a single quantity varies, success above the final error; none of fewer than two.

    :param groups: as :func:`~sb3_quad.evaluation.metric_tables.scenario_groups` gives them.
    """
    single = [(heading, scenarios) for heading, scenarios in groups if len(scenarios[0].cell) == 1]
    found = [(heading, scenarios[0], _flown(results, scenarios, colours)) for heading, scenarios in single]
    families = [family for family in found if family[2]]
    if len(families) < 2:
        return []
    rows, columns = -(-len(families) // IN_A_ROW), min(IN_A_ROW, len(families))
    figure = Figure(figsize=(2 * WIDTH, 0.4 + 3.6 * rows), layout="constrained")
    grid, order = figure.add_gridspec(2 * rows, columns), list(colours)
    top = bottom = None  # the first panels, whose heights all others have
    for number, (heading, first, flown) in enumerate(families):
        row, column = divmod(number, columns)
        top = shares = figure.add_subplot(grid[2 * row, column], sharey=top)
        bottom = distances = figure.add_subplot(grid[2 * row + 1, column], sharex=shares, sharey=bottom)
        for label, cells in flown.items():
            x, successes, errors = _curves(cells)
            place = order.index(label)
            x += ASIDE * np.ptp(x) * (place - 0.5 * (len(order) - 1))
            style: Any = {"linewidth": 1.6, "marker": MARKERS[place % len(MARKERS)], "markersize": 4.5}
            band(shares, colours[label], label, x, successes, **style)
            distances.plot(x, np.maximum(errors, LEAST_ERROR), color=colours[label], label=label, **style)
        shares.set_title(heading, loc="left", fontweight="bold")
        distances.set_xlabel(_label(first))
        for axes, name in ((shares, "success (%)"), (distances, "final error (m)")):
            axes.set_ylabel("" if column else name)
            axes.tick_params(labelbottom=axes is distances, labelleft=not column)
        shares.set_ylim(-3.0, 103.0)
        distances.set_yscale("log")
        distances.yaxis.set_major_formatter("{x:g}")
    distances.set_ylim(bottom=0.8 * LEAST_ERROR)
    legend(figure, figure.axes)
    caption = (
        f"Above: success, with 95 % intervals. Below: {ERRORS} Less than 1 mm is drawn as 1 mm; points of one value stand"
    )
    return [Plot("overview_families", f"{caption} side by side.", figure)]


def _flown(results: Results, scenarios: Sequence[Scenario], colours: Mapping[str, str]) -> dict[str, Cells]:
    """By the label of a controller, those of some scenarios that it has flown; without those that have flown none."""
    flown: dict[str, Cells] = {}
    for label, scenario in itertools.product(colours, scenarios):
        entry = results.entry(label, scenario.name)
        if entry is not None:
            flown.setdefault(label, []).append((scenario, entry.metrics))
    return flown


def _label(scenario: Scenario) -> str:
    """The name of the quantity that varies, with its unit."""
    return axis_label(next(iter(scenario.cell)), scenario)


def _curves(cells: Cells) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The quantity that varies, (n,), success in % and the ends of its interval, (3, n), and median final errors, (n,), m."""
    x = np.array([value for scenario, _ in cells for value in scenario.cell.values()])
    successes = interval_ends([metrics.success or metrics.survival for _, metrics in cells], 100.0)
    errors = [metrics.final_error_median if metrics.survival.value >= 0.5 else None for _, metrics in cells]
    return x, successes, np.array(errors, dtype=np.float64)


def _sweep(first: Scenario, flown: Mapping[str, Cells], colours: Mapping[str, str]) -> list[Plot]:
    name = _label(first)
    success, shares = new_axes(name, "success (%)")
    error, distances = new_axes(name, "final distance (m)")
    for label, cells in flown.items():
        x, successes, errors = _curves(cells)
        band(shares, colours[label], label, x, successes, **POINTS)
        distances.plot(x, errors, color=colours[label], label=label, **POINTS)
    shares.set_ylim(-3.0, 103.0)
    distances.set_ylim(bottom=0.0)
    legend(success, shares)
    legend(error, distances)
    success_plot = Plot(f"{first.group}_success", "Success, with 95 % intervals.", success)
    return [success_plot, Plot(f"{first.group}_error", ERRORS[:1].upper() + ERRORS[1:], error)]


def _losses(scenarios: Sequence[Scenario], flown: Mapping[str, Cells], colours: Mapping[str, str]) -> Plot:
    """What each controller loses, side by side in each cell of the first two keys; a panel for each value of the others."""
    keys = list(scenarios[0].cell)
    x_values, y_values = (sorted({scenario.cell[key] for scenario in scenarios}) for key in keys[:2])
    columns = list(dict.fromkeys(_rest(scenario) for scenario in scenarios))
    size = WIDTH, 0.7 + len(columns) * (0.3 + 0.36 * len(y_values))
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(len(columns), sharex=True, squeeze=False)[:, 0]
    width = 0.84 / len(flown)
    for axes, column in zip(panels, columns, strict=True):
        for number, (label, cells) in enumerate(flown.items()):
            lost = {
                (x_values.index(scenario.cell[keys[0]]), y_values.index(scenario.cell[keys[1]])): 1.0 - metrics.survival.value
                for scenario, metrics in cells
                if _rest(scenario) == column
            }
            x, y = np.array([*lost]).T
            middle, heights = x + (number - 0.5 * (len(flown) - 1)) * width, 0.7 * np.sqrt([*lost.values()])
            axes.bar(middle, heights, 0.92 * width, bottom=y, color=colours[label], label=label)
            for at, top, share in zip(middle, y + heights, lost.values(), strict=True):
                if share > 0.0:
                    axes.text(at, top + 0.02, f"{100 * share:.0f}", ha="center", va="bottom", fontsize=6)
        axes.set_title(column, loc="left")
        axes.set(xlim=(-0.5, len(x_values) - 0.5), ylim=(0.0, len(y_values)), ylabel=axis_label(keys[1], scenarios[0]))
        axes.set_xticks(np.arange(len(x_values) - 1) + 0.5, minor=True)
        axes.set_xticks(np.arange(len(x_values)), [f"{value:g}" for value in x_values])
        axes.set_yticks(np.arange(len(y_values)), [f"{value:g}" for value in y_values], va="bottom")
        axes.tick_params(which="both", length=0)
        axes.grid(axis="x", visible=False)
        axes.grid(axis="x", which="minor")
    panels[-1].set_xlabel(axis_label(keys[0], scenarios[0]))
    legend(figure, panels[0])
    names = ", ".join(axis_name(key).replace("_", " ") for key in keys)
    caption = f"Flights lost, in %, over {names}; no bar: none. The bars' heights grow with the square root."
    return Plot(f"{scenarios[0].group}_success", caption, figure)


def _rest(scenario: Scenario) -> str:
    """The values of all but the first two keys of a cell, with their units."""
    names = {key: axis_name(key) for key in list(scenario.cell)[2:]}
    parts = (f"{name} {scenario.cell[key]:g} {UNITS.get(name, '')}" for key, name in names.items())
    return ", ".join(part.replace("_", " ").strip() for part in parts)
