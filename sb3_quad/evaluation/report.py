"""The report of an evaluation: its tables as Markdown, ``report.md``, and its plots as PNG."""

from collections.abc import Iterator, Sequence
from html import escape
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from sb3_quad.base.files import write_text
from sb3_quad.base.types import StrPath
from sb3_quad.evaluation.flightlog import read_tracks
from sb3_quad.evaluation.metric_tables import CAPTION, group_table, scenario_groups
from sb3_quad.evaluation.plots import paths_plot, save_figure, success_plot
from sb3_quad.evaluation.results import FIGURES, REPORT, Results, load_results
from sb3_quad.evaluation.scenarios.load import axis_name
from sb3_quad.evaluation.scenarios.scenario import Scenario


def write_report(folder: StrPath) -> Path:
    """Write the report of a folder of results: ``report.md`` and ``figures/``. Existing files are
    replaced.

    :return: ``report.md``.
    :raises ConfigError: no results, damaged ones, a folder that cannot be written.
    """
    place = Path(folder)
    results = load_results(folder)
    parts = [
        f"# {escape(results.title or results.suite)}",
        escape(results.description),
        f"Vehicles: {escape(_vehicles(results))}.",
        f"Suite {escape(results.suite)}, sb3_quad {results.package_version}; {CAPTION}.",
    ]
    for heading, scenarios in scenario_groups(results):
        parts += [f"## {escape(heading)}", escape(scenarios[0].description)]
        parts.append(group_table(results, heading, scenarios).markdown())
        for name, figure in _figures(results, scenarios, place):
            picture = f"{FIGURES}/{name}.png"
            save_figure(figure, place / picture)
            parts.append(f"![{name}]({picture})")
    write_text(place / REPORT, "\n\n".join(filter(None, parts)) + "\n")
    return place / REPORT


def _vehicles(results: Results) -> str:
    """Return the names of the vehicles that were flown."""
    own = {record.vehicle for record in results.controllers}
    names = set[str]()
    for scenario in results.scenarios:
        if scenario.vehicles is not None:
            names.add("sampled quadcopters")
        else:
            names |= {scenario.nominal_vehicle().name} if scenario.vehicle else own
    return ", ".join(sorted(names))


def _figures(
    results: Results, scenarios: Sequence[Scenario], folder: Path
) -> Iterator[tuple[str, Figure]]:
    """Yield the plots of a scenario, or of the cells that ``vary`` makes of one, with their
    names.
    """
    first = scenarios[0]
    if first.group is not None:
        cells = _cells(results, scenarios)
        for number, key in enumerate(first.cell):
            name = f"{first.group}_{number}"
            yield name, success_plot(cells, key, axis_name(key), results.colours)
        return
    flights = {}
    for label in results.colours:
        entry = results.entry(label, first.name)
        if entry is not None:
            flights[label] = read_tracks(folder / entry.flights)
    # A scenario in which all controllers failed has no flights to draw.
    if flights:
        yield f"{first.name}_paths", paths_plot(flights, results.colours)


def _cells(results: Results, scenarios: Sequence[Scenario]) -> pd.DataFrame:
    """The success of each controller, a column by its label, in the cells that ``vary`` makes, a
    row for each; NaN where it failed.
    """
    cells = pd.DataFrame([scenario.cell for scenario in scenarios])
    for label in results.colours:
        entries = [results.entry(label, scenario.name) for scenario in scenarios]
        cells[label] = [entry.metrics.success.value if entry else np.nan for entry in entries]
    return cells.set_index([*scenarios[0].cell])
