"""A report's content in order: an overview, then a section for each scenario, or for the cells that ``vary`` makes of one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path

from sb3_quad.drawing.palette import colours_of
from sb3_quad.evaluation.records import Entry, Results
from sb3_quad.evaluation.tables import SUCCESS
from sb3_quad.report.figures import Figure
from sb3_quad.report.kinds import Flown, group_figures, scenario_figures
from sb3_quad.report.tables import Cell, Row, Table, estimate_cell, mark_best, reference_cells, scenario_table
from sb3_quad.report.tracks import read_tracks
from sb3_quad.scenarios.scenario import Scenario
from sb3_quad.scenarios.vary import axis_label


@dataclass(frozen=True)
class Section:
    """A part of the page; ``anchor`` is part of file names and of the page's address."""

    anchor: str
    heading: str
    description: str
    tables: Sequence[Table]
    figures: Sequence[Figure] = field(default_factory=tuple)
    facts: str = ""


def sections(results: Results, folder: str | Path) -> list[Section]:
    """All sections of a folder of results.

    :raises ConfigError: a missing or damaged file.
    """
    colours = colours_of([record.label for record in results.controllers])
    source = results.source
    parts = [_overview(results, colours, source)]
    for name, members in _groups(results):
        scenarios = list(members)
        flown = [_flown(results, scenario, colours, folder) for scenario in scenarios]
        first = scenarios[0]
        if first.group is None:
            tables = [scenario_table(first, _entries(results, first, colours), source)]
            figures = scenario_figures(first, flown[0], source) if flown[0] else []
        else:
            tables = [_sweep_table(results, scenarios, colours)] if len(first.cell) == 1 else []
            figures = group_figures(name, scenarios, flown) if any(flown) else []
        parts.append(Section(name, _heading(scenarios), first.description, tables, figures, _facts(scenarios)))
    return parts


def _groups(results: Results) -> list[tuple[str, list[Scenario]]]:
    found = groupby(results.scenarios, lambda scenario: scenario.group or scenario.name)
    return [(name, list(members)) for name, members in found]


def _heading(scenarios: Sequence[Scenario]) -> str:
    heading = scenarios[0].heading
    heading = heading.rsplit(":", 1)[0] if scenarios[0].group is not None else heading
    return heading[:1].upper() + heading[1:]


def _facts(scenarios: Sequence[Scenario]) -> str:
    first = scenarios[0]
    flights = f"{first.episodes} flights of each controller"
    cells = f" in each of {len(scenarios)} cells" if first.group is not None else ""
    return f"{flights}{cells}, {first.duration:g} s; observation noise {100 * first.noise:g} %; seeds from {first.seed} on"


def _entries(results: Results, scenario: Scenario, colours: dict[str, str]) -> list[tuple[str, str, Entry | None]]:
    return [(label, colour, results.entry(label, scenario.name)) for label, colour in colours.items()]


def _flown(results: Results, scenario: Scenario, colours: dict[str, str], folder: str | Path) -> list[Flown]:
    found = []
    for label, colour, entry in _entries(results, scenario, colours):
        if entry is not None:
            found.append(Flown(label, colour, entry, read_tracks(folder, entry) if scenario.group is None else []))
    return found


def _overview(results: Results, colours: dict[str, str], source: str) -> Section:
    rows = []
    others: list[str] = list(dict.fromkeys(name for scenario in results.scenarios for name in scenario.reference))
    for _, scenarios in _groups(results):
        first = scenarios[0]
        cells = []
        for label in colours:
            entries = [results.entry(label, scenario.name) for scenario in scenarios]
            shares = [entry.metrics.success for entry in entries if entry is not None]
            if not shares:
                cells.append(Cell(words="failed"))
            elif len(scenarios) == 1:
                cells.append(estimate_cell(shares[0], 1, 100.0))
            else:
                values = [100.0 * share.value for share in shares]
                cells.append(Cell(words=f"{min(values):.0f} to {max(values):.0f}"))
        beside = [
            reference_cells(first.reference[name]).get(SUCCESS, Cell()) if name in first.reference else Cell()
            for name in others
        ]
        rows.append(Row(_heading(scenarios), "", [*mark_best(SUCCESS, cells), *beside]))
    filled = [k for k in range(len(others)) if any(row.cells[len(colours) + k] != Cell() for row in rows)]
    kept = [*range(len(colours)), *(len(colours) + k for k in filled)]
    rows = [Row(row.name, "", [row.cells[k] for k in kept]) for row in rows]
    table = Table(list(colours.items()), [others[k] for k in filled], rows, source, "success (%)")
    description = (
        "Share of flights that neither touch the ground nor leave the range. Where a scenario is varied: least to greatest."
    )
    return Section("overview", "Success", description, [table])


def _sweep_table(results: Results, scenarios: Sequence[Scenario], colours: dict[str, str]) -> Table:
    """Success over the one quantity that is varied."""
    rows = []
    for scenario in scenarios:
        entries = [results.entry(label, scenario.name) for label in colours]
        cells = [Cell(words="failed") if each is None else estimate_cell(each.metrics.success, 1, 100.0) for each in entries]
        (key, value) = next(iter(scenario.cell.items()))
        rows.append(Row(f"{value:g}", "", mark_best(SUCCESS, cells)))
    corner = f"{axis_label(key).replace('_', ' ')}: success (%)"
    return Table(list(colours.items()), [], rows, "", corner)
