"""The report of an evaluation: who flew, an overview, and a section for each scenario or each group
that ``vary`` makes.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from sb3_quad.base.colours import colours_of
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import refuse_existing
from sb3_quad.evaluation.flightlog import read_tracks
from sb3_quad.evaluation.metric_tables import (
    SUCCESS,
    SURVIVAL,
    mark_best,
    measured_cells,
    metric_rows,
    reference_cells,
    scenario_groups,
)
from sb3_quad.evaluation.results import Results, load_results
from sb3_quad.evaluation.scenarios.load import axis_label
from sb3_quad.evaluation.scenarios.scenario import Scenario
from sb3_quad.evaluation.tables import Cell, Column, Row, Table, text_table
from sb3_quad.report.page import PAGE, Section, write_page
from sb3_quad.report.plots import Plot
from sb3_quad.report.scenario_plots import (
    ControllerFlights,
    arrivals_plot,
    errors_plot,
    group_plots,
    paths_plot,
)
from sb3_quad.simulation.settings import in_words

OVERVIEW = (
    "Success: the flight ends within 0.1 m of its target, or, where it starts at its target, within 0.25 m and tilted by at"
    " most 10°. Survival: it neither touches the ground nor leaves the range. Where a scenario is varied: least to greatest."
)
SMALL_PRINT = (
    "Small numbers are 95 % intervals, Wilson's for shares, bootstrap for means; they are left out where they are narrower"
    " than the last digit. Bold: better than all others of the row, with the intervals apart; times and rewards are compared"
    " only where no flight is lost."
)


def write_report(folder: str | Path, overwrite: bool = False) -> Path:
    """Write the report of a folder of results: ``report.html``, its tables as ``report.md``, its
    plots as files.

    :param overwrite: replace a report that is there.
    :return: the page.
    :raises ConfigError: no results, damaged ones, a report that is there already, a folder that
        cannot be written.
    """
    results = load_results(folder)
    if not results.entries:
        raise ConfigError(f"{folder}: holds no flights, only failures; there is nothing to report")
    refuse_existing(Path(folder) / PAGE, overwrite)
    return write_page(folder, f"Suite {results.suite}", facts(results), sections(results, folder))


def facts(results: Results) -> str:
    """What was flown, when and by which version, and how to read the numbers."""
    flights = sum(entry.metrics.n for entry in results.entries)
    backends = " and ".join(sorted({entry.backend for entry in results.entries}))
    dates = sorted({entry.date for entry in results.entries} - {""})
    about = f"{results.description.rstrip('.')}. " if results.description else ""
    return (
        f"{about}{flights:,} flights of {len(results.controllers)} controllers in {len(results.scenarios)}"
        f" scenarios, {backends} backend, flown {' to '.join(dict.fromkeys([*dates[:1], *dates[-1:]]))} by sb3_quad"
        f" {results.package_version}. {SMALL_PRINT}"
    )


def sections(results: Results, folder: str | Path) -> list[Section]:
    """All sections of a folder of results.

    :raises ConfigError: a missing or damaged file.
    """
    colours = colours_of([record.label for record in results.controllers])
    groups = scenario_groups(results)
    shares = [
        _share_table(row, results, groups, colours, row.heading) for row in (SUCCESS, SURVIVAL)
    ]
    parts = [
        Section(
            "overview", "Success and survival", OVERVIEW, [table for table in shares if table.rows]
        )
    ]
    for heading, scenarios in groups:
        first, each_of = scenarios[0], ""
        if first.group is None:
            measured = [measured_cells(results, label, first) for label in colours]
            rows = metric_rows(first, measured, first.reference.values())
            tables = [Table(_columns(colours, first.reference, results.source), rows)]
            plots: Sequence[Plot] = _scenario_plots(results, first, colours, folder)
        else:
            each_of = f" in each of {len(scenarios)} cells"
            tables, plots = [], group_plots(results, scenarios, colours)
            if len(first.cell) == 1:
                cells = [
                    (f"{value:g}", [scenario])
                    for scenario in scenarios
                    for value in scenario.cell.values()
                ]
                corner = f"{axis_label(next(iter(first.cell)), first)}: success (%)"
                tables.append(_share_table(SUCCESS, results, cells, colours, corner))
        how = (
            f"{first.episodes} flights of each controller{each_of}, {first.duration:g} s; "
            f"observation noise {in_words(first.noise)}; seed {first.seed}."
        )
        parts.append(
            Section(first.group or first.name, heading, first.description, tables, plots, how)
        )
    known = [
        (each.label, each.spec, each.algorithm or "", (each.content or "")[:12])
        for each in results.controllers
    ]
    table = text_table("", ("name", "controller", "algorithm", "SHA-256"), known, align="left")
    parts.append(Section("controllers", "Controllers", tables=[table]))
    if results.failures:
        failures = [
            (each.controller, each.scenario or "", each.message) for each in results.failures
        ]
        table = text_table("", ("controller", "scenario", "what happened"), failures, align="left")
        parts.append(Section("failures", "Failures", tables=[table]))
    return parts


def _scenario_plots(
    results: Results, scenario: Scenario, colours: Mapping[str, str], folder: str | Path
) -> list[Plot]:
    found = {label: results.entry(label, scenario.name) for label in colours}
    entries = {label: entry for label, entry in found.items() if entry is not None}
    tracks = {label: read_tracks(Path(folder) / entry.flights) for label, entry in entries.items()}
    recorded = [
        ControllerFlights(label, colours[label], each) for label, each in tracks.items() if each
    ]
    plots = [paths_plot(scenario, recorded)] if recorded else []
    if (
        entries
        and scenario.target.waypoints is None
        and scenario.target.distance != 0.0
        and len(scenario.tolerances) > 2
    ):
        plots.append(
            arrivals_plot(
                scenario, {label: entry.metrics for label, entry in entries.items()}, colours
            )
        )
    if recorded:
        plots.append(errors_plot(scenario, recorded))
    return plots


def _share_table(
    row: Row,
    results: Results,
    groups: Sequence[tuple[str, Sequence[Scenario]]],
    colours: Mapping[str, str],
    corner: str,
) -> Table:
    """Success or survival in each group of scenarios; where there are several in one, from the
    worst to the best.
    """
    references = [scenarios[0].reference for _, scenarios in groups]
    others = dict.fromkeys(
        name for given in references for name in given if row in reference_cells(given[name])
    )
    rows = []
    for (heading, scenarios), given in zip(groups, references, strict=True):
        own = mark_best(row, [_share(row, results, label, scenarios) for label in colours])
        beside = [
            reference_cells(given[name]).get(row, Cell()) if name in given else Cell()
            for name in others
        ]
        if any(cell != Cell() for cell in own):
            rows.append(Row(heading, "", [*own, *beside]))
    return Table(_columns(colours, others, results.source), rows, corner)


def _share(row: Row, results: Results, label: str, scenarios: Sequence[Scenario]) -> Cell:
    found = [measured_cells(results, label, scenario) for scenario in scenarios]
    shares = [cells.get(row, Cell()) for cells in found if cells is not None]
    if not shares:
        return Cell(words="failed")
    if len(scenarios) == 1:
        return shares[0]
    values = [share.value for share in shares if share.value is not None]
    return Cell(words=f"{min(values):.0f} to {max(values):.0f}") if values else Cell()


def _columns(colours: Mapping[str, str], others: Iterable[str], source: str) -> list[Column]:
    return [
        *(Column(*each) for each in colours.items()),
        *(Column(name, source=source) for name in others),
    ]
