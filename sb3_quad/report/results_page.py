"""The report of an evaluation: who flew, an overview, and a section for each scenario or each group
that ``vary`` makes.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from sb3_quad.base.colours import colours_of
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import refuse_existing
from sb3_quad.base.types import StrPath
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
    "Success: the flight ends within 0.1 m of its target, or, where it starts at its target, within"
    " 0.25 m and tilted by at most 10°. Survival: it neither touches the ground nor leaves the"
    " range. Where a scenario is varied, you see the least and the greatest share."
)
SMALL_PRINT = (
    "Small numbers are 95 % intervals, Wilson's for shares, bootstrap for means; an interval"
    " narrower than the last digit is not shown. Bold: better than all others of the row, with the"
    " intervals apart; times and rewards are compared only where no flight is lost."
)


def write_report(folder: StrPath, overwrite: bool = False) -> Path:
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
    """Return how many flights there are, when and by which version, and how to read numbers."""
    flights = sum(entry.metrics.n for entry in results.entries)
    backends = " and ".join(sorted({entry.backend for entry in results.entries}))
    dates = {entry.date for entry in results.entries}
    days = " to ".join(sorted({min(dates), max(dates)}))
    sentences = [
        f"{flights:,} flights of {len(results.controllers)} controllers in"
        f" {len(results.scenarios)} scenarios, {backends} backend, flown {days} by sb3_quad"
        f" {results.package_version}.",
        SMALL_PRINT,
    ]
    # Only evaluations with an own reward have a row of it.
    if results.reward:
        sentences.insert(1, f"Own reward: {results.reward}.")
    if results.description:
        sentences.insert(0, f"{results.description.rstrip('.')}.")
    return " ".join(sentences)


def sections(results: Results, folder: StrPath) -> list[Section]:
    """Return all sections of a folder of results.

    :raises ConfigError: a missing or damaged file.
    """
    colours = colours_of([record.label for record in results.controllers])
    groups = scenario_groups(results)
    shares = []
    for row in (SUCCESS, SURVIVAL):
        table = _share_table(row, results, groups, colours, row.heading)
        if table.rows:
            shares.append(table)
    parts = [Section("overview", "Success and survival", OVERVIEW, shares)]
    for heading, scenarios in groups:
        if scenarios[0].group is None:
            parts.append(_scenario_section(results, heading, scenarios[0], colours, folder))
        else:
            parts.append(_group_section(results, heading, scenarios, colours))
    rows = []
    for record in results.controllers:
        rows.append(
            (record.label, record.spec, record.algorithm or "", (record.content or "")[:12])
        )
    heads = ("name", "controller", "algorithm", "SHA-256")
    parts.append(
        Section("controllers", "Controllers", tables=[text_table("", heads, rows, align="left")])
    )
    if results.failures:
        lines = []
        for failure in results.failures:
            lines.append((failure.controller, failure.scenario or "", failure.message))
        table = text_table("", ("controller", "scenario", "what happened"), lines, align="left")
        parts.append(Section("failures", "Failures", tables=[table]))
    return parts


def _scenario_section(
    results: Results,
    heading: str,
    scenario: Scenario,
    colours: Mapping[str, str],
    folder: StrPath,
) -> Section:
    measured = [measured_cells(results, label, scenario) for label in colours]
    rows = metric_rows(scenario, measured, scenario.reference.values())
    table = Table(_columns(colours, scenario.reference, results.source), rows)
    plots = _scenario_plots(results, scenario, colours, folder)
    how = f"{scenario.episodes} flights of each controller, {_conditions(scenario)}"
    return Section(scenario.name, heading, scenario.description, [table], plots, how)


def _group_section(
    results: Results, heading: str, scenarios: Sequence[Scenario], colours: Mapping[str, str]
) -> Section:
    first = scenarios[0]
    tables = []
    # A grid of several quantities has too many cells for a table.
    if len(first.cell) == 1:
        cells = []
        for scenario in scenarios:
            (value,) = scenario.cell.values()
            cells.append((f"{value:g}", [scenario]))
        corner = f"{axis_label(next(iter(first.cell)), first)}: success (%)"
        tables.append(_share_table(SUCCESS, results, cells, colours, corner))
    how = (
        f"{first.episodes} flights of each controller in each of {len(scenarios)} cells,"
        f" {_conditions(first)}"
    )
    plots = group_plots(results, scenarios, colours)
    return Section(first.group or first.name, heading, first.description, tables, plots, how)


def _conditions(scenario: Scenario) -> str:
    noise = in_words(scenario.noise)
    return f"{scenario.duration:g} s; observation noise {noise}; seed {scenario.seed}."


def _scenario_plots(
    results: Results, scenario: Scenario, colours: Mapping[str, str], folder: StrPath
) -> list[Plot]:
    metrics = {}
    recorded = []
    for label, colour in colours.items():
        entry = results.entry(label, scenario.name)
        if entry is not None:
            metrics[label] = entry.metrics
            tracks = read_tracks(Path(folder) / entry.flights)
            if tracks:
                recorded.append(ControllerFlights(label, colour, tracks))
    plots = []
    # Controllers that failed have no flights to draw.
    if recorded:
        plots.append(paths_plot(scenario, recorded))
    has_way = scenario.target.waypoints is None and scenario.target.distance != 0.0
    if metrics and has_way and len(scenario.tolerances) > 2:
        plots.append(arrivals_plot(scenario, metrics, colours))
    if recorded:
        plots.append(errors_plot(scenario, recorded))
    return plots


def _share_table(
    row: Row,
    results: Results,
    groups: Iterable[tuple[str, Sequence[Scenario]]],
    colours: Mapping[str, str],
    corner: str,
) -> Table:
    """Success or survival in each group of scenarios; of several, from the worst to the best."""
    lines = {}
    others: dict[str, None] = {}
    for heading, scenarios in groups:
        own = mark_best(row, [_share(row, results, label, scenarios) for label in colours])
        given = {}
        for name, reference in scenarios[0].reference.items():
            given[name] = reference_cells(reference).get(row, Cell())
            if given[name] != Cell():
                others[name] = None
        if any(cell != Cell() for cell in own):
            lines[heading] = own, given
    # The columns of references are known only now.
    rows = []
    for heading, (own, given) in lines.items():
        rows.append(Row(heading, "", [*own, *(given.get(name, Cell()) for name in others)]))
    return Table(_columns(colours, others, results.source), rows, corner)


def _share(row: Row, results: Results, label: str, scenarios: Sequence[Scenario]) -> Cell:
    """The share of a controller in some scenarios; of several, the least and the greatest."""
    shares = []
    cell = Cell(words="failed")
    for scenario in scenarios:
        cells = measured_cells(results, label, scenario)
        if cells is not None:
            cell = cells[row]
            shares.append(cell.value or 0.0)
    if len(scenarios) == 1 or not shares:
        return cell
    return Cell(words=f"{min(shares):.0f} to {max(shares):.0f}")


def _columns(colours: Mapping[str, str], others: Iterable[str], source: str) -> list[Column]:
    columns = [*map(Column, colours.keys(), colours.values())]
    for name in others:
        columns.append(Column(name, source=source))
    return columns
