"""The plots of what ``vary`` makes of scenarios: curves over one quantity, bars over several, all curves in one picture."""

import itertools
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sb3_quad.evaluation.metrics import Metrics
from sb3_quad.evaluation.results import Results
from sb3_quad.evaluation.scenarios.load import UNITS, axis_label, axis_name
from sb3_quad.evaluation.scenarios.scenario import Scenario
from sb3_quad.report.plots import POINTS, WIDTH, Plot, band, interval_ends, legend, new_axes, styled

Cells = list[tuple[Scenario, Metrics]]  # those of a varied scenario that one controller has flown
IN_A_ROW = 3  # scenarios side by side in the overview
LEAST_ERROR = 1e-3  # m; smaller ones are drawn there, on a logarithmic axis
ASIDE = 0.014  # of the quantity's range: equal values stand side by side
SUCCESS = "success, with 95 % intervals."
ERRORS = "median of the final error of the flights that were not lost, unless these are fewer than half; 1 mm at least."


@styled
def group_plots(results: Results, scenarios: Sequence[Scenario], colours: Mapping[str, str]) -> list[Plot]:
    """The plots of the cells that ``vary`` makes of a scenario: curves over one quantity, or bars in each cell of several.

    :param colours: by the labels of the controllers.
    """
    flown = _flown(results, scenarios, colours)
    if not flown:
        return []
    group, cell = scenarios[0].group, scenarios[0].cell
    if len(cell) > 1:
        return [Plot(f"{group}_success", "Flights lost, in %; no bar: none.", _losses(scenarios, flown, colours))]
    (success, shares), (error, distances) = new_axes("", ""), new_axes("", "")
    _draw_curves(shares, distances, scenarios[0], flown, colours)
    for figure, axes in ((success, shares), (error, distances)):
        legend(figure, axes)
    captions = SUCCESS.capitalize(), ERRORS.capitalize()
    return [Plot(f"{group}_success", captions[0], success), Plot(f"{group}_error", captions[1], error)]


@styled
def families_plot(
    results: Results, groups: Sequence[tuple[str, Sequence[Scenario]]], colours: Mapping[str, str]
) -> list[Plot]:
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
    grid = figure.subplots(2 * rows, columns, squeeze=False)
    for number, (heading, first, flown) in enumerate(families):
        row, column = divmod(number, columns)
        shares, distances = grid[2 * row : 2 * row + 2, column]
        _draw_curves(shares, distances, first, flown, colours)
        shares.set_title(heading, loc="left", fontweight="bold")
        shares.set_xlabel("")
        distances.sharex(shares)
        for axes in (shares, distances):
            axes.set_ylabel("" if column else axes.get_ylabel())
            axes.tick_params(labelbottom=axes is distances, labelleft=not column)
    for axes in grid[1::2].flat:
        axes.sharey(grid[1, 0])
        axes.autoscale()
    for axes in grid[-2:, len(families) - columns * (rows - 1) :].flat:
        axes.set_visible(False)
    legend(figure, grid)
    return [Plot("overview_families", f"Above: {SUCCESS} Below: {ERRORS} Equal values stand side by side.", figure)]


def _flown(results: Results, scenarios: Sequence[Scenario], colours: Mapping[str, str]) -> dict[str, Cells]:
    """By the label of a controller, those of some scenarios that it has flown; without those that have flown none."""
    flown: dict[str, Cells] = {}
    for label, scenario in itertools.product(colours, scenarios):
        entry = results.entry(label, scenario.name)
        if entry is not None:
            flown.setdefault(label, []).append((scenario, entry.metrics))
    return flown


def _draw_curves(
    shares: Axes, distances: Axes, first: Scenario, flown: Mapping[str, Cells], colours: Mapping[str, str]
) -> None:
    """Draw success into one pair of axes, and final errors into another, over the single quantity that varies."""
    for label, cells in flown.items():
        x = np.array([value for scenario, _ in cells for value in scenario.cell.values()])
        x += ASIDE * np.ptp(x) * ([*colours].index(label) - 0.5 * (len(colours) - 1))
        successes = interval_ends([metrics.success or metrics.survival for _, metrics in cells], 100.0)
        lasting = [metrics.final_error_median if metrics.survival.value >= 0.5 else None for _, metrics in cells]
        errors = np.maximum(np.array(lasting, dtype=np.float64), LEAST_ERROR)
        band(shares, colours[label], label, x, successes, **POINTS)
        distances.plot(x, errors, color=colours[label], label=label, **POINTS)
    name = axis_label(next(iter(first.cell)), first)
    shares.set(xlabel=name, ylabel="success (%)", ylim=(-3.0, 103.0))
    distances.set(xlabel=name, ylabel="final error (m)", yscale="log")
    distances.yaxis.set_major_formatter("{x:g}")


def _losses(scenarios: Sequence[Scenario], flown: Mapping[str, Cells], colours: Mapping[str, str]) -> Figure:
    """Bars of what each controller loses over the first key; a row of panels for each value of the second, else a column."""
    first, second, *others = scenarios[0].cell
    x_values, y_values = (sorted({scenario.cell[key] for scenario in scenarios}) for key in (first, second))
    columns = list(dict.fromkeys(tuple(scenario.cell[key] for key in others) for scenario in scenarios))
    figure = Figure(figsize=(WIDTH * min(2, len(columns)), 0.8 + 1.3 * len(y_values)), layout="constrained")
    panels = figure.subplots(len(y_values), len(columns), squeeze=False, sharex=True, sharey=True)
    width = 0.84 / len(flown)
    for axes, (y_value, column) in zip(panels.flat, itertools.product(y_values, columns), strict=True):
        here = {second: y_value, **dict(zip(others, column, strict=True))}
        for number, (label, cells) in enumerate(flown.items()):
            survivals = {
                x_values.index(scenario.cell[first]): metrics.survival.value
                for scenario, metrics in cells
                if here.items() <= scenario.cell.items()
            }
            middle, lost = np.array([*survivals]), 100.0 - 100.0 * np.array([*survivals.values()])
            middle = middle + (number - 0.5 * (len(flown) - 1)) * width
            bars = axes.bar(middle, lost, 0.92 * width, color=colours[label], label=label)
            axes.bar_label(bars, [f"{share:.0f}" if share else "" for share in lost], fontsize=6)
        axes.set_title(", ".join(_words(key, value) for key, value in here.items()), loc="left")
        axes.set_xticks(np.arange(len(x_values)), [f"{value:g}" for value in x_values])
        axes.set(ylim=(0.0, 115.0), xlabel=axis_label(first, scenarios[0]), ylabel="lost (%)")
        axes.grid(axis="x", visible=False)
        axes.label_outer()
    legend(figure, panels[0, 0])
    return figure


def _words(key: str, value: float) -> str:
    """A value of a cell with its name and unit."""
    name = axis_name(key)
    return f"{name} {value:g} {UNITS.get(name, '')}".replace("_", " ").strip()
