"""The report of an evaluation: its tables as Markdown, ``report.md``, and its plots as PNG."""

from html import escape
from pathlib import Path

from sb3_quad.base.files import write_text
from sb3_quad.base.types import StrPath
from sb3_quad.evaluation.flightlog import Track, read_tracks
from sb3_quad.evaluation.metric_tables import CAPTION, group_table, scenario_groups
from sb3_quad.evaluation.plots import paths_plot, save_figure
from sb3_quad.evaluation.results import FIGURES, REPORT, Results, load_results
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
    for scenarios in scenario_groups(results):
        parts += [f"## {escape(scenarios[0].heading)}", escape(scenarios[0].description)]
        parts.append(group_table(results, scenarios).markdown())
        # The cells that vary makes have no plot.
        flights = _flights(results, scenarios[0], place) if len(scenarios) == 1 else {}
        if flights:
            name = f"{scenarios[0].name}_paths"
            picture = f"{FIGURES}/{name}.png"
            save_figure(paths_plot(flights, results.colours), place / picture)
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


def _flights(results: Results, scenario: Scenario, folder: Path) -> dict[str, list[Track]]:
    """Return the flights of a scenario by label; none of controllers that failed."""
    flights = {}
    for label in results.colours:
        entry = results.entry(label, scenario.name)
        if entry is not None:
            flights[label] = read_tracks(folder / entry.flights)
    return flights
