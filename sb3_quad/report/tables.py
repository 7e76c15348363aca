"""The tables of a report: numbers with their intervals, and others' figures beside them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from sb3_quad.evaluation.records import Entry, Estimate, HitLimit, Metrics
from sb3_quad.evaluation.tables import (
    COMPLETED,
    COURSE_TIME,
    FLOWN,
    HIT,
    LARGEST,
    MEDIAN,
    PATH,
    REACHED,
    REWARD,
    SUCCESS,
    shown_rows,
    time_row,
)
from sb3_quad.scenarios.scenario import NumberOrRange, Reference, Scenario

UNITS = {SUCCESS: "%", FLOWN: "s", PATH: "m", MEDIAN: "m", LARGEST: "m", COMPLETED: "%", COURSE_TIME: "s", HIT: "×"}
DECIMALS = {SUCCESS: 1, MEDIAN: 3, LARGEST: 3, COMPLETED: 1}
HIGHER_IS_BETTER = {SUCCESS, REWARD, REACHED, COMPLETED, HIT}
SHARES = {SUCCESS, REACHED, COMPLETED, HIT}  # can be compared where flights are lost, too
MOST_TOLERANCES, MAIN_TOLERANCES = 6, (0.1, 0.2, 0.5, 1.0)  # m
LOWER_IS_BETTER = {COURSE_TIME}  # and the times to a tolerance


@dataclass(frozen=True)
class Cell:
    """A number with the ends of its 95 % interval, or words in its place.

    :param note: small print beside it.
    :param best: better than all others of its row, and the intervals are apart; times and rewards only where none is lost.
    """

    value: float | None = None
    low: float | None = None
    high: float | None = None
    decimals: int = 2
    words: str = ""
    note: str = ""
    best: bool = False

    @property
    def whole(self) -> str:
        """What stands before the decimal point; minus signs are proper ones."""
        return "" if self.value is None else self._text(self.value).partition(".")[0]

    @property
    def fraction(self) -> str:
        """The decimal point and what stands behind it."""
        return "" if self.value is None else "".join(self._text(self.value).partition(".")[1:])

    @property
    def interval(self) -> str:
        """The interval, empty where it is narrower than the last digit."""
        if self.low is None or self.high is None or self._text(self.low) == self._text(self.high):
            return ""
        return f"{self._text(self.low)} to {self._text(self.high)}"

    def _text(self, value: float) -> str:
        text = f"{value:.{self.decimals}f}"
        return text.removeprefix("-") if float(text) == 0.0 else text.replace("-", "−")


@dataclass(frozen=True)
class Row:
    """A quantity with its unit, and a cell for each column."""

    name: str
    unit: str
    cells: Sequence[Cell]


@dataclass(frozen=True)
class Table:
    """Columns of controllers, label and colour of each, then columns from elsewhere.

    :param source: heads the columns from elsewhere.
    :param corner: heads the column of the rows' names.
    """

    columns: Sequence[tuple[str, str]]
    others: Sequence[str]
    rows: Sequence[Row]
    source: str
    corner: str = ""

    @property
    def has_units(self) -> bool:
        """Whether any row says its unit."""
        return any(row.unit for row in self.rows)


def scenario_table(scenario: Scenario, entries: Sequence[tuple[str, str, Entry | None]], source: str) -> Table:
    """The figures of controllers in one scenario.

    :param entries: label, colour and results of each controller; None: it failed.
    :param source: where reference figures come from.
    """
    found = [_cells(entry.metrics, entry.hit_limit) if entry is not None else None for _, _, entry in entries]
    others = {name: reference_cells(reference) for name, reference in scenario.reference.items()}
    rows = []
    left_out = _left_out(scenario)
    none_lost = all(entry is None or entry.metrics.success.value == 1.0 for _, _, entry in entries)
    for name in shown_rows(scenario):
        if name in left_out or not any(cells and name in cells for cells in found):
            continue
        own = [Cell(words="failed") if cells is None else cells.get(name, Cell()) for cells in found]
        beside = [cells.get(name, Cell()) for cells in others.values()]
        unit = UNITS.get(name, "s" if name.startswith("mean time") else "")
        comparable = name in SHARES or none_lost
        rows.append(Row(name, unit, [*(mark_best(name, own) if comparable else own), *beside]))
    return Table([(label, colour) for label, colour, _ in entries], list(others), rows, source)


def _left_out(scenario: Scenario) -> set[str]:
    """Rows of tolerances that only the figure shows, where there are many of them."""
    if len(scenario.tolerances) <= MOST_TOLERANCES:
        return set()
    referenced = {float(key) for reference in scenario.reference.values() for key in reference.time_to}
    kept = {scenario.tolerances[0], *MAIN_TOLERANCES, *referenced}
    return {time_row(tolerance) for tolerance in scenario.tolerances if tolerance not in kept}


def estimate_cell(estimate: Estimate | None, decimals: int = 2, factor: float = 1.0, none: str = "") -> Cell:
    """A mean or share as a cell."""
    if estimate is None:
        return Cell(words=none)
    return Cell(factor * estimate.value, factor * estimate.low, factor * estimate.high, decimals)


def mark_best(row: str, cells: Sequence[Cell]) -> list[Cell]:
    """The cells of a row, the best of them marked, if its interval is apart from all others'."""
    higher = row in HIGHER_IS_BETTER
    if not (higher or row in LOWER_IS_BETTER or row.startswith("mean time")):
        return list(cells)
    ends = [_ends(cell) for cell in cells]
    marked = []
    for number, cell in enumerate(cells):
        others = [end for place, end in enumerate(ends) if place != number and end is not None]
        own = ends[number]
        if own is None or not others:
            marked.append(cell)
            continue
        best = all(own[0] > high if higher else own[1] < low for low, high in others)
        marked.append(replace(cell, best=best))
    return marked


def _ends(cell: Cell) -> tuple[float, float] | None:
    if cell.value is None:
        return None
    return (cell.value if cell.low is None else cell.low), (cell.value if cell.high is None else cell.high)


def _cells(figures: Metrics, limit: HitLimit | None) -> dict[str, Cell]:
    cells = {
        SUCCESS: estimate_cell(figures.success, 1, 100.0),
        REWARD: estimate_cell(figures.reward),
        FLOWN: estimate_cell(figures.flown),
        PATH: estimate_cell(figures.path, none="–"),
        MEDIAN: Cell(words="–") if figures.final_error_median is None else Cell(figures.final_error_median, decimals=3),
        LARGEST: Cell(words="–") if figures.final_error_max is None else Cell(figures.final_error_max, decimals=3),
    }
    for arrival in figures.arrivals:
        share = arrival.share.value
        cell = estimate_cell(arrival.time, none="never")
        note = f"{100 * share:.3g} % arrive" if arrival.time is not None and share < 1.0 else ""
        cells[time_row(arrival.tolerance)] = replace(cell, note=note)
    if figures.course is not None:
        cells[REACHED] = estimate_cell(figures.course.reached)
        cells[COMPLETED] = estimate_cell(figures.course.completed, 1, 100.0)
        cells[COURSE_TIME] = estimate_cell(figures.course.time, none="never")
    if limit is not None:
        cells[HIT] = _limit_cell(limit)
    return cells


def _limit_cell(limit: HitLimit) -> Cell:
    greatest = limit.trials[-1].factor
    factor = greatest if limit.factor is None else limit.factor
    size = " and ".join(f"{factor * part:.1f} {unit}" for part, unit in ((limit.force, "N"), (limit.torque, "N m")) if part)
    if limit.factor is None:
        return Cell(words=f"more than {greatest:g}", note=size)
    return Cell(limit.factor, limit.low, limit.high, note=size)


def reference_cells(reference: Reference) -> dict[str, Cell]:
    """Others' figures, by the names of the rows."""
    given = {SUCCESS: reference.success, REWARD: reference.reward, PATH: reference.path, MEDIAN: reference.final_error}
    given |= {FLOWN: reference.flown}
    cells = {name: _figure(name, figure) for name, figure in given.items() if figure is not None}
    if SUCCESS in cells and reference.note:
        cells[SUCCESS] = replace(cells[SUCCESS], note=reference.note)
    for tolerance, time in reference.time_to.items():
        cells[time_row(tolerance)] = Cell(words="never") if time is None else _figure(time_row(tolerance), time)
    return cells


def _figure(name: str, figure: NumberOrRange) -> Cell:
    factor = 100.0 if name == SUCCESS else 1.0
    if isinstance(figure, tuple):
        return Cell(words=" to ".join(f"{factor * value:g}" for value in figure).replace("-", "−"))
    value = factor * figure
    decimals = max(0 if math.isclose(value, round(value, 0)) else 1 if math.isclose(value, round(value, 1)) else 2, 1)
    return Cell(value, decimals=decimals)
