"""Tables of metrics: a column for each controller, then columns of published metrics."""

from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from typing import Any

import numpy as np

from sb3_quad.evaluation.flights import TOLERANCES
from sb3_quad.evaluation.following import FOLLOWED
from sb3_quad.evaluation.hooks import arrival_tolerance
from sb3_quad.evaluation.metrics import Metrics, Moment
from sb3_quad.evaluation.results import Results
from sb3_quad.evaluation.scenarios.load import axis_values
from sb3_quad.evaluation.scenarios.scenario import Printed, Published, Scenario
from sb3_quad.evaluation.statistics import Estimate
from sb3_quad.evaluation.tables import Cell, Column, Row, Table

# The rows, without their cells:
SUCCESS = Row("success", "%")
SURVIVAL = Row("survival", "%")
REWARD = Row("mean reward")
OWN_REWARD = Row("mean own reward")
FLOWN = Row("time flown", "s")
LIMIT = Row("physical limit of the settling time", "s")
OVERSHOOT_RATE = Row("overshoot rate", "%")
OVERSHOOT = Row("farthest after arrival, median", "m")
PATH = Row("mean path", "m")
MEDIAN = Row("final error, median", "m", decimals=3)
QUANTILE = Row("final error, 95 %", "m", decimals=3)
RECOVERY_TIME = Row("recovery time", "s", verb="recover")
CROSS_TRACK_ERROR = Row("cross-track error", "m")
# For moving targets, in the order of FOLLOWED
FOLLOWING = (
    Row("position error, rms", "m", decimals=3),
    Row("position error, greatest", "m", decimals=3),
    Row("cross-track error, rms", "m", decimals=3),
    Row("heading error, rms", "°", decimals=1),
    Row("lag", "s", decimals=3),
)
REACHED = Row("waypoints reached")
COMPLETED = Row("courses completed", "%")
COURSE_TIME = Row("time of the course", "s", verb="complete")
# The rows of the fields of Metrics; fields of Published have the same names.
ROWS = {
    "success": SUCCESS,
    "survival": SURVIVAL,
    "reward": REWARD,
    "own_reward": OWN_REWARD,
    "flown": FLOWN,
    "overshoot": OVERSHOOT,
    "path": PATH,
    "cross_track_error": CROSS_TRACK_ERROR,
    "final_error_median": MEDIAN,
    "final_error_95": QUANTILE,
    "recovery_time": RECOVERY_TIME,
    **dict(zip(FOLLOWED, FOLLOWING, strict=True)),
}
# Lost flights end early, which makes the other rows incomparable.
ALWAYS_COMPARABLE = {SUCCESS, SURVIVAL, REACHED, COMPLETED}
HIGHER_IS_BETTER = ALWAYS_COMPARABLE | {REWARD, OWN_REWARD}
MOST_TOLERANCES = 6
CAPTION = "in brackets: 95 % intervals; bold: best of its row, intervals apart"

NOTHING = Cell()

Cells = Mapping[Row, Cell]  # by row


def time_row(tolerance: float) -> Row:
    """Return the row with the time to a tolerance, m."""
    return Row(f"mean time to {tolerance:g} m", "s", verb="arrive")


def settling_row(tolerance: float) -> Row:
    """Return the row with the settling time of a tolerance, m."""
    return Row(f"settling time ({tolerance:g} m)", "s", verb="settle")


def estimate_cell(row: Row, estimate: Estimate | None, none: str = "–") -> Cell:
    """Return the cell of an estimate with its interval in a row; for None, the words ``none``."""
    if estimate is None:
        return Cell(words=none)
    ends = (row.factor * estimate.low, row.factor * estimate.high)
    return Cell(row.factor * estimate.value, ends, row.decimals)


def metric_cells(metrics: Metrics) -> Cells:
    """Return everything that was measured of a controller in a scenario.

    Values that do not exist, such as the error of survivors if there are none, have no cell.
    """
    values = {row: getattr(metrics, name) for name, row in ROWS.items()}
    near = arrival_tolerance(arrival.tolerance for arrival in metrics.arrivals)
    for arrival in metrics.arrivals:
        values[time_row(arrival.tolerance)] = arrival
        # Settling and overshoot are shown for one tolerance only.
        if arrival.tolerance == near:
            values[settling_row(near)] = arrival.settling
            values[OVERSHOOT_RATE] = arrival.overshoot_rate
    if metrics.course is not None:
        values[REACHED] = metrics.course.reached
        values[COMPLETED] = metrics.course.completed
        values[COURSE_TIME] = metrics.course.time
    return {row: _measured(row, value) for row, value in values.items() if value is not None}


def _measured(row: Row, value: Any) -> Cell:
    """The cell of a number, an :class:`Estimate` or a :class:`Moment`."""
    if isinstance(value, float):
        return Cell(value, decimals=row.decimals)
    if not isinstance(value, Moment):
        # A share has as many digits as it takes for a single flight to show.
        if row.unit == "%":
            row = row._replace(decimals=len(str(value.n // 200)))
        return estimate_cell(row, value)
    # The note of a mean time says how many flights it covers, unless it is all or none.
    note = ""
    if 0.0 < value.share.value < 1.0:
        note = f"{100 * value.share.value:.3g} % {row.verb}"
    return estimate_cell(row, value.time, none="never")._replace(note=note)


def measured_cells(results: Results, controller: str, scenario: Scenario) -> Cells | None:
    """Return the :func:`metric_cells` of a label and its vehicle's limit; None if it failed."""
    entry = results.entry(controller, scenario.name)
    if entry is None:
        return None
    return {**metric_cells(entry.metrics), LIMIT: Cell(entry.physical_limit)}


def published_cells(published: Published) -> Cells:
    """Return others' metrics."""
    rows = ROWS | {"final_error": MEDIAN}
    cells = {}
    for name, number in published:
        if name in rows and number is not None:
            cells[rows[name]] = _printed(rows[name], number)
    for row in cells.keys() & {SUCCESS, SURVIVAL}:
        cells[row] = cells[row]._replace(note=published.note)
    # Here None means: never within the tolerance.
    for tolerance, time in published.time_to.items():
        row = time_row(tolerance)
        cells[row] = _printed(row, time)
    return cells


def metric_rows(
    scenario: Scenario, measured: Sequence[Cells | None], published: Iterable[Published] = ()
) -> list[Row]:
    """Return the rows of a scenario, with the best of each marked: controllers first, then
    published columns.

    :param measured: cells of each controller; None: it failed.
    """
    # A controller that failed has one cell, which says so.
    ours = [cells or {SUCCESS: Cell(words="failed")} for cells in measured]
    others = [*map(published_cells, published)]
    none_lost = all(cells[SURVIVAL].value == 100.0 for cells in measured if cells)
    rows = []
    for row in _rows_of(scenario):
        own = [cells.get(row, NOTHING) for cells in ours]
        # A row without a number of ours is left out, whatever was published.
        if own == [NOTHING] * len(own):
            continue
        if none_lost or row in ALWAYS_COMPARABLE:
            own = mark_best(row, own)
        own += [cells.get(row, NOTHING) for cells in others]
        rows.append(row._replace(cells=own))
    return rows


def mark_best(row: Row, cells: Sequence[Cell]) -> list[Cell]:
    """Return the cells of a row, the best marked if its interval is apart from all others'."""
    if row in HIGHER_IS_BETTER:
        sign = 1.0
    elif row in FOLLOWING[:-1] or (row.verb and not any(cell.note for cell in cells)):
        # A note means that a mean time covers only some flights, perhaps those with the nearest
        # targets.
        sign = -1.0
    else:
        return list(cells)
    # The intervals, with signs such that more is better; NaN without a number, which cannot win.
    ends = np.array([cell.ends or (cell.value, cell.value) for cell in cells], np.float64)
    low, high = np.sort(sign * ends, axis=1).T
    marked = []
    for number, cell in enumerate(cells):
        others = np.fmax.reduce(np.delete(high, number), initial=-np.inf)
        # A single cell is not the best.
        marked.append(cell._replace(best=bool(low[number] > others > -np.inf)))
    return marked


def overview(results: Results, labels: Sequence[str]) -> list[Table]:
    """Return the tables of all scenarios for a terminal; the last one says how to read them.

    :param labels: labels of the controllers, in the order of their columns.
    """
    tables = []
    for heading, scenarios in scenario_groups(results):
        tables.append(group_table(results, labels, heading, scenarios))
    tables[-1] = tables[-1]._replace(caption=CAPTION)
    return tables


def group_table(
    results: Results, labels: Iterable[str], heading: str, scenarios: Sequence[Scenario]
) -> Table:
    """Return the table of a scenario, or of the cells that ``vary`` makes of one: some controllers,
    then what was published.
    """
    rows = []
    for scenario in scenarios:
        measured = [measured_cells(results, label, scenario) for label in labels]
        for row in metric_rows(scenario, measured, scenario.published.values()):
            names = [*axis_values(scenario.cell), row.name]
            rows.append(row._replace(name=", ".join(names)))
    return Table(table_columns(results, labels, scenarios[0].published), rows, title=heading)


def table_columns(
    results: Results, labels: Iterable[str], published: Iterable[str]
) -> list[Column]:
    """Return the columns of some controllers, then those of what was published."""
    columns = [Column(label, results.colours[label]) for label in labels]
    return [*columns, *(Column(name, source=results.source) for name in published)]


def scenario_groups(results: Results) -> list[tuple[str, list[Scenario]]]:
    """Return each scenario, or the cells that ``vary`` makes of one, with its heading."""
    groups = []
    for _, members in groupby(results.scenarios, lambda scenario: scenario.group or scenario.name):
        scenarios = list(members)
        heading = scenarios[0].heading
        if scenarios[0].group:
            heading = heading.rsplit(":", 1)[0]  # without the values of the cell
        groups.append((heading[:1].upper() + heading[1:], scenarios))
    return groups


def _rows_of(scenario: Scenario) -> list[Row]:
    """The rows that have a meaning in a scenario."""
    shares = [SUCCESS, SURVIVAL]
    rewards = [REWARD, OWN_REWARD]
    if scenario.waypoints:
        return [*shares, OWN_REWARD, REACHED, COMPLETED, COURSE_TIME]
    if len(scenario.cell) > 1:
        return [SUCCESS, OWN_REWARD]
    if scenario.reference is not None:
        return [*shares, *rewards, *FOLLOWING]
    if scenario.group is not None:
        return [*shares, OWN_REWARD, MEDIAN]
    # An episode that starts at its target does not fly to it.
    if not scenario.has_way:
        return [*shares, FLOWN, *rewards, RECOVERY_TIME, MEDIAN, QUANTILE]
    tolerances = {*scenario.tolerances}
    if len(tolerances) > MOST_TOLERANCES:
        # Only the main and the published ones; a plot shows the others.
        kept = {min(tolerances), *TOLERANCES}
        for published in scenario.published.values():
            kept |= {*published.time_to}
        tolerances &= kept
    settling = [settling_row(arrival_tolerance(tolerances)), LIMIT, OVERSHOOT_RATE, OVERSHOOT]
    times = map(time_row, sorted(tolerances))
    return [*shares, *rewards, *settling, *times, PATH, CROSS_TRACK_ERROR, MEDIAN, QUANTILE]


def _printed(row: Row, value: Printed) -> Cell:
    """A number as its source prints it; a pair is a range, None an event that never happened."""
    if value is None:
        return Cell(words="never")
    ends = map("{:g}".format, row.factor * np.atleast_1d(value))
    # Tables have a proper minus sign.
    return Cell(words=" to ".join(ends).replace("-", "−"))
