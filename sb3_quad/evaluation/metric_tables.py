"""Tables of metrics: a column for each controller, then columns of published metrics."""

from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np

from sb3_quad.evaluation.following import FOLLOWED
from sb3_quad.evaluation.hooks import arrival_tolerance
from sb3_quad.evaluation.hover import HOVERED
from sb3_quad.evaluation.metrics import Metrics, Moment
from sb3_quad.evaluation.results import Results
from sb3_quad.evaluation.scenarios.scenario import Printed, Published, Scenario
from sb3_quad.evaluation.statistics import Estimate
from sb3_quad.evaluation.tables import Table


class Row(NamedTuple):
    """A metric with its unit.

    :param decimals: number of decimals in its cells.
    :param verb: for a mean time: what the flights do at that time.
    """

    name: str
    unit: str = ""
    decimals: int = 2
    verb: str = ""

    @property
    def heading(self) -> str:
        """The name and the unit."""
        return f"{self.name}, {self.unit}" if self.unit else self.name

    @property
    def factor(self) -> float:
        """The factor from values to cells, which show shares in %."""
        return 100.0 if self.unit == "%" else 1.0

    def number(self, value: float) -> str:
        """Return a value in its cell, with a proper minus sign."""
        # Adding 0.0 turns a negative zero into one without a sign.
        rounded = round(self.factor * value, self.decimals) + 0.0
        return f"{rounded:.{self.decimals}f}".replace("-", "−")


SUCCESS = Row("success", "%")
SURVIVAL = Row("survival", "%")
REWARD = Row("mean reward")
FLOWN = Row("time flown", "s")
LIMIT = Row("physical limit of the settling time", "s")
OVERSHOOT_RATE = Row("overshoot rate", "%")
PATH = Row("mean path", "m")
MEDIAN = Row("final error, median", "m", decimals=3)
QUANTILE = Row("final error, 95 %", "m", decimals=3)
RECOVERY_TIME = Row("recovery time", "s", verb="recover")
CROSS_TRACK_ERROR = Row("cross-track error", "m")
# Of calm, in the order of HOVERED
HOVER = (
    Row("body rates in hover, rms", "rad/s"),
    Row("tilt in hover, rms", "°"),
    Row("change of commands in hover, rms", "1/s"),
)
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
    "flown": FLOWN,
    "path": PATH,
    "cross_track_error": CROSS_TRACK_ERROR,
    "final_error_median": MEDIAN,
    "final_error_95": QUANTILE,
    "recovery_time": RECOVERY_TIME,
    **dict(zip(HOVERED, HOVER, strict=True)),
    **dict(zip(FOLLOWED, FOLLOWING, strict=True)),
}
CAPTION = "in brackets: 95 % intervals"
# Beyond, the cells of a grid have a row each.
MANY_CELLS = 12

Cells = Mapping[Row, str]


def time_row(tolerance: float) -> Row:
    """Return the row with the time to a tolerance, m."""
    return Row(f"mean time to {tolerance:g} m", "s", verb="arrive")


def settling_row(tolerance: float) -> Row:
    """Return the row with the settling time of a tolerance, m."""
    return Row(f"settling time ({tolerance:g} m)", "s", verb="settle")


def estimate_text(row: Row, estimate: Estimate | None, none: str = "–") -> str:
    """Return an estimate with its interval as a row shows it; for None, the words ``none``."""
    if estimate is None:
        return none
    text = row.number(estimate.value)
    low = row.number(estimate.low)
    high = row.number(estimate.high)
    # An interval narrower than the last digit says nothing.
    return text if low == high else f"{text} ({low} to {high})"


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


def _measured(row: Row, value: Any) -> str:
    """An :class:`Estimate` or a :class:`Moment` as a row shows it."""
    if not isinstance(value, Moment):
        # A share has as many digits as it takes for a single flight to show.
        if row.unit == "%":
            row = row._replace(decimals=len(str(value.n // 200)))
        return estimate_text(row, value)
    text = estimate_text(row, value.time, none="never")
    # Say how many flights a mean time covers, unless it is all or none.
    if 0.0 < value.share.value < 1.0:
        text += f", {100 * value.share.value:.3g} % {row.verb}"
    return text


def published_cells(published: Published) -> Cells:
    """Return others' metrics."""
    rows = ROWS | {"final_error": MEDIAN}
    cells = {}
    for name, number in published:
        if name in rows and number is not None:
            cells[rows[name]] = _printed(rows[name], number)
    if published.note:
        for row in cells.keys() & {SUCCESS, SURVIVAL}:
            cells[row] += f", {published.note}"
    # Here None means: never within the tolerance.
    for tolerance, time in published.time_to.items():
        row = time_row(tolerance)
        cells[row] = _printed(row, time)
    return cells


def _printed(row: Row, value: Printed) -> str:
    """A number as its source prints it; a pair is a range, None an event that never happened."""
    if value is None:
        return "never"
    ends = map("{:g}".format, row.factor * np.atleast_1d(value))
    # Tables have a proper minus sign.
    return " to ".join(ends).replace("-", "−")


def metric_rows(
    scenario: Scenario,
    measured: Sequence[Cells],
    published: Sequence[Published] = (),
    n_cells: int = 1,
) -> list[list[str]]:
    """Return the rows of a scenario for a :class:`~sb3_quad.evaluation.tables.Table`: controllers
    first, then published columns. Rows that no controller has are not shown.

    :param n_cells: scenarios that share the table.
    """
    columns = [*measured, *map(published_cells, published)]
    rows = []
    for row in _rows_of(scenario, n_cells):
        if any(row in cells for cells in measured):
            rows.append([row.heading, *(cells.get(row, "") for cells in columns)])
    return rows


def overview(results: Results) -> list[Table]:
    """Return the tables of all scenarios; the last one says how to read them."""
    tables = [group_table(results, scenarios) for scenarios in scenario_groups(results)]
    tables[-1] = tables[-1]._replace(caption=CAPTION)
    return tables


def group_table(results: Results, scenarios: Sequence[Scenario]) -> Table:
    """Return the table of a scenario, or of the cells that ``vary`` makes of one."""
    rows = []
    for scenario in scenarios:
        measured = []
        for label in results.colours:
            entry = results.entry(label, scenario.name)
            if entry is None:
                measured.append({SUCCESS: "failed"})
                continue
            cells = dict(metric_cells(entry.metrics))
            if entry.physical_limit is not None:
                cells[LIMIT] = LIMIT.number(entry.physical_limit)
            measured.append(cells)
        _, _, cell = scenario.name.partition(".")
        published = [*scenario.published.values()]
        for name, *texts in metric_rows(scenario, measured, published, len(scenarios)):
            rows.append([", ".join(filter(None, [cell, name])), *texts])
    columns = [f"{results.source}: {name}" for name in scenarios[0].published]
    return Table(["", *results.colours, *columns], rows, scenarios[0].heading)


def scenario_groups(results: Results) -> list[list[Scenario]]:
    """Return each scenario, or the cells that ``vary`` makes of one, in a list."""
    groups = groupby(results.scenarios, lambda scenario: scenario.group)
    return [[*members] for _, members in groups]


def _rows_of(scenario: Scenario, n_cells: int) -> list[Row]:
    """The rows that have a meaning in a scenario."""
    shares = [SUCCESS, SURVIVAL]
    errors = [MEDIAN, QUANTILE, *HOVER]
    if scenario.waypoints:
        return [*shares, REACHED, COMPLETED, COURSE_TIME, *HOVER]
    if n_cells > MANY_CELLS:
        return [SUCCESS]
    if scenario.reference is not None:
        return [*shares, REWARD, *FOLLOWING]
    if n_cells > 1:
        return [*shares, MEDIAN, *HOVER]
    # An episode that starts at its target does not fly to it.
    if not scenario.has_way:
        return [*shares, FLOWN, REWARD, RECOVERY_TIME, *errors]
    settling = [settling_row(arrival_tolerance(scenario.tolerances)), LIMIT, OVERSHOOT_RATE]
    times = map(time_row, scenario.tolerances)
    return [*shares, REWARD, *settling, *times, PATH, CROSS_TRACK_ERROR, *errors]
