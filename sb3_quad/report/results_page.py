"""The report of an evaluation: who flew, an overview, and a section for each scenario or each group
that ``vary`` makes.
"""

from collections.abc import Sequence
from pathlib import Path

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import refuse_existing
from sb3_quad.base.templates import render
from sb3_quad.base.types import StrPath
from sb3_quad.envs.simulation.settings import in_words
from sb3_quad.evaluation.flightlog import read_tracks
from sb3_quad.evaluation.metric_tables import (
    NOTHING,
    SUCCESS,
    SURVIVAL,
    group_table,
    mark_best,
    measured_cells,
    published_cells,
    scenario_groups,
    table_columns,
)
from sb3_quad.evaluation.results import Results, load_results
from sb3_quad.evaluation.scenarios.load import axis_label
from sb3_quad.evaluation.scenarios.scenario import Published, Scenario
from sb3_quad.evaluation.tables import Cell, Row, Table, text_table
from sb3_quad.report.page import PAGE, TEMPLATES, Section, write_page
from sb3_quad.report.plots import Plot
from sb3_quad.report.scenario_plots import (
    arrivals_plot,
    errors_plot,
    group_plots,
    paths_plot,
)

OVERVIEW = (
    "Success: the flight ends within 0.1 m of its target, or, where it starts at its target, which"
    " rests, within 0.25 m and tilted by at most 10°. Survival: it neither touches the ground nor"
    " leaves the range. Where a scenario is varied, you see the least and the greatest share."
)

# Scenarios that are shown together, with their heading
Groups = Sequence[tuple[str, Sequence[Scenario]]]


def write_report(folder: StrPath, overwrite: bool = False) -> Path:
    """Write the report of a folder of results: ``report.html``, its tables as ``report.md``, its
    plots as files.

    :param overwrite: replace an existing report.
    :return: the page.
    :raises ConfigError: no results, damaged ones, an existing report, a folder that cannot be
        written.
    """
    results = load_results(folder)
    if not results.entries:
        raise ConfigError(f"{folder}: holds no flights, only failures; there is nothing to report")
    refuse_existing(Path(folder) / PAGE, overwrite)
    return write_page(folder, f"Suite {results.suite}", facts(results), sections(results, folder))


def facts(results: Results) -> str:
    """Return how many flights there are, when and by which version, and how to read numbers."""
    return " ".join(render(TEMPLATES, "facts.txt.j2", results=results).split())


def sections(results: Results, folder: StrPath) -> list[Section]:
    """Return all sections of a folder of results.

    :raises ConfigError: a missing or damaged file.
    """
    groups = scenario_groups(results)
    shares = [_share_table(row, results, groups, row.heading) for row in (SUCCESS, SURVIVAL)]
    parts = [Section("overview", "Success and survival", OVERVIEW, shares)]
    for heading, scenarios in groups:
        parts.append(_flights_section(results, heading, scenarios, Path(folder)))
    controllers = [
        (record.label, record.spec, record.algorithm or "", (record.content or "")[:12])
        for record in results.controllers
    ]
    heads = ("name", "controller", "algorithm", "SHA-256")
    table = text_table("", heads, controllers, "left")
    parts.append(Section("controllers", "Controllers", tables=[table]))
    if results.failures:
        failures = [
            (failure.controller, failure.scenario or "", failure.message)
            for failure in results.failures
        ]
        table = text_table("", ("controller", "scenario", "what happened"), failures, "left")
        parts.append(Section("failures", "Failures", tables=[table]))
    return parts


def _flights_section(
    results: Results, heading: str, scenarios: Sequence[Scenario], folder: Path
) -> Section:
    """The section of a scenario, or of the cells that ``vary`` makes of one."""
    first = scenarios[0]
    # Conditions that differ between the cells are left out.
    conditions = []
    for scenario in scenarios:
        flown = f"{scenario.n_episodes} flights of each controller"
        if first.group is not None:
            flown += f" in each of {len(scenarios)} cells"
        conditions.append(
            (
                flown,
                f", {scenario.duration:g} s",
                f"; observation noise {in_words(scenario.noise)}",
                f"; seed {scenario.seed}",
            )
        )
    shared = [texts[0] for texts in zip(*conditions, strict=True) if len({*texts}) == 1]
    tables = []
    if first.group is None:
        tables.append(group_table(results, results.colours, heading, scenarios))
        plots = _scenario_plots(results, first, folder)
    else:
        # A grid of several quantities has too many cells for a table.
        if len(first.cell) == 1:
            (key,) = first.cell
            cells = [(f"{scenario.cell[key]:g}", [scenario]) for scenario in scenarios]
            tables.append(_share_table(SUCCESS, results, cells, f"{axis_label(key)}: success (%)"))
        plots = group_plots(results, scenarios)
    return Section(
        first.group or first.name,
        heading,
        first.description,
        tables,
        plots,
        "".join(shared).lstrip(",; ") + ".",
    )


def _scenario_plots(results: Results, scenario: Scenario, folder: Path) -> list[Plot]:
    metrics = {}
    flights = {}
    for label in results.colours:
        entry = results.entry(label, scenario.name)
        if entry is not None:
            metrics[label] = entry.metrics
            flights[label] = read_tracks(folder / entry.flights)
    # A scenario in which all controllers failed has no flights to draw.
    if not flights:
        return []
    plots = [paths_plot(scenario, flights, results.colours)]
    has_way = scenario.has_way and not scenario.waypoints
    if has_way and scenario.reference is None and len(scenario.tolerances) > 2:
        plots.append(arrivals_plot(scenario, metrics, results.colours))
    return [*plots, errors_plot(scenario, flights, results.colours)]


def _share_table(row: Row, results: Results, groups: Groups, corner: str) -> Table:
    """Success or survival in each group of scenarios; for several, from the worst to the best."""
    others = []
    for _, scenarios in groups:
        for name, published in scenarios[0].published.items():
            if row in published_cells(published) and name not in others:
                others.append(name)
    rows = []
    for heading, scenarios in groups:
        cells = mark_best(
            row, [_share(row, results, label, scenarios) for label in results.colours]
        )
        for name in others:
            # A scenario may lack the published metrics of another one.
            published = scenarios[0].published.get(name, Published())
            cells.append(published_cells(published).get(row, NOTHING))
        rows.append(Row(heading, "", cells))
    return Table(table_columns(results, results.colours, others), rows, corner)


def _share(row: Row, results: Results, label: str, scenarios: Sequence[Scenario]) -> Cell:
    """The share of a controller in some scenarios; for several, the least and the greatest."""
    measured = [measured_cells(results, label, scenario) for scenario in scenarios]
    cells = [cells[row] for cells in measured if cells is not None]
    if not cells:
        return Cell(words="failed")
    if len(scenarios) == 1:
        return cells[0]
    shares = [cell.value or 0.0 for cell in cells]
    return Cell(words=f"{min(shares):.0f} to {max(shares):.0f}")
