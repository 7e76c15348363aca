r"""The picture of docs/agents.md: success and final error over the quantities that a suite varies.

    PYTHONPATH=examples sb3-quad evaluate PID=pid geometric "RL agent=itm-recovery" \
        itm-robust RAPTOR=raptor:Raptor --suite robustness \
        --scenario mass constant_force motor_gain delay noise wandering_gusts -o FOLDER
    python examples/robustness_plot.py FOLDER robustness.png

A scenario that varies nothing, or two quantities at once, has no panel.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sb3_quad.evaluation.results import Results, load_results
from sb3_quad.evaluation.scenarios.load import axis_label
from sb3_quad.evaluation.scenarios.scenario import Scenario

COLUMNS = 2
MARKERS = "osD^vP"
# m. The axis is logarithmic; smaller errors are drawn there.
LEAST_ERROR = 1e-3


def panel(top: Axes, bottom: Axes, results: Results, cells: list[Scenario]) -> None:
    """Draw success and final error of the cells of one scenario.

    Success is in %, with 95 % intervals; the final error is the median, in m.
    """
    (key,) = cells[0].cell
    for number, controller in enumerate(results.controllers):
        colour = results.colours[controller.label]
        style: dict[str, Any] = {
            "marker": MARKERS[number % len(MARKERS)],
            "markersize": 5,
            "color": colour,
            "alpha": 0.9,
        }
        shares = []
        errors = []
        for cell in cells:
            entry = results.entry(controller.label, cell.name)
            if entry is None:
                continue
            x = cell.cell[key]
            success = entry.metrics.success
            if success is not None:
                shares.append((x, success.value, success.low, success.high))
            # A median over few survivors would look too good: half of the flights must survive.
            median = entry.metrics.final_error_median
            if median is not None and entry.metrics.survival.value >= 0.5:
                errors.append((x, max(median, LEAST_ERROR)))
        if shares:
            x, value, low, high = np.array(shares, dtype=np.float64).T
            top.plot(x, 100.0 * value, label=controller.label, **style)
            top.fill_between(x, 100.0 * low, 100.0 * high, color=colour, alpha=0.15, linewidth=0)
        if errors:
            x, error = np.array(errors, dtype=np.float64).T
            bottom.plot(x, error, **style)
    top.set_title(
        cells[0].title.split(":")[0].capitalize(), loc="left", fontweight="bold", fontsize=10
    )
    top.set_ylim(-4.0, 104.0)
    top.tick_params(labelbottom=False)
    bottom.set_yscale("log")
    bottom.set_ylim(0.8 * LEAST_ERROR, 10.0)
    bottom.yaxis.set_major_formatter("{x:g}")
    bottom.set_xlabel(axis_label(key))
    for axes in (top, bottom):
        axes.grid(color="#e4e7ec")
        axes.spines[["top", "right"]].set_visible(False)


def draw(results: Results) -> Figure:
    """Draw two panels for each scenario that varies one quantity.

    :raises SystemExit: no scenario varies one quantity.
    """
    groups: dict[str, list[Scenario]] = {}
    for scenario in results.scenarios:
        if len(scenario.cell) == 1 and scenario.group is not None:
            groups.setdefault(scenario.group, []).append(scenario)
    if not groups:
        raise SystemExit(
            "no scenario of these results varies one quantity; "
            "evaluate --suite robustness --scenario mass does"
        )
    columns = min(COLUMNS, len(groups))
    rows = -(-len(groups) // columns)
    figure = Figure(figsize=(4.2 * columns, 4.3 * rows), dpi=120, layout="constrained")
    places = figure.subfigures(rows, columns, squeeze=False).flat
    for place, (part, cells) in enumerate(zip(places, groups.values(), strict=False)):
        top, bottom = part.subplots(2, 1, sharex=True)
        panel(top, bottom, results, cells)
        if place % columns == 0:
            top.set_ylabel("success (%)")
            bottom.set_ylabel("final error (m)")
        if place == 0:
            handles = top.get_legend_handles_labels()
    figure.legend(*handles, loc="outside upper left", ncols=len(results.controllers), frameon=False)
    return figure


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="folder of results that evaluate wrote")
    parser.add_argument("picture", type=Path, help="PNG, SVG or PDF to write")
    options = parser.parse_args()
    draw(load_results(options.folder)).savefig(options.picture)
    print(f"wrote {options.picture}")
