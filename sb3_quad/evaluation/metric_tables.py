"""Tables of metrics: a column for each controller, and others' metrics beside them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import groupby

from sb3_quad.evaluation.flights import arrival_tolerance
from sb3_quad.evaluation.metrics import Metrics, Moment
from sb3_quad.evaluation.results import Results
from sb3_quad.evaluation.scenarios.load import axis_name
from sb3_quad.evaluation.scenarios.scenario import NumberOrRange, Reference, Scenario
from sb3_quad.evaluation.statistics import Estimate
from sb3_quad.evaluation.tables import Cell, Column, Row, Table

# The rows, without their cells:
SUCCESS, SURVIVAL = Row("success", "%"), Row("survival", "%")
REWARD, FLOWN = Row("mean reward"), Row("time flown", "s")
PATH, MEDIAN, QUANTILE = (
    Row("mean path", "m"),
    Row("final error, median", "m"),
    Row("final error, 95 %", "m"),
)
RECOVERY_TIME, CROSS_TRACK_ERROR = (
    Row("mean time until stable", "s"),
    Row("beside the straight way", "m"),
)
REACHED, COMPLETED, COURSE_TIME = (
    Row("waypoints reached"),
    Row("courses completed", "%"),
    Row("time of the course", "s"),
)
TIME = "mean time to"  # begins the names of the rows with times to a tolerance
LIMIT = Row("physical limit of that time", "s")
OVERSHOOT_RATE, OVERSHOOT = Row("leave it again", "%"), Row("overshoot, median", "m")
ALWAYS_COMPARABLE = {
    SUCCESS,
    SURVIVAL,
    REACHED,
    COMPLETED,
}  # also where flights are lost, which end early
HIGHER_IS_BETTER = ALWAYS_COMPARABLE | {REWARD}
MOST_TOLERANCES, MAIN_TOLERANCES = 6, (0.1, 0.2, 0.5, 1.0)  # m
CAPTION = "in brackets: 95 % intervals; bold: best of its row, intervals apart"

Cells = Mapping[Row, Cell]  # by the rows they stand in


def time_row(tolerance: float | str) -> Row:
    """The row with the time to a tolerance."""
    return Row(f"{TIME} {float(tolerance):g} m", "s")


def settling_row(tolerance: float) -> Row:
    """The row with the time after which a tolerance is not left again."""
    return Row(f"{TIME} stay within {tolerance:g} m", "s")


def metric_cells(metrics: Metrics) -> Cells:
    """Everything that was measured of a controller in a scenario."""
    near = arrival_tolerance(each.tolerance for each in metrics.arrivals)
    arrival = next(each for each in metrics.arrivals if each.tolerance == near)
    cells = {
        SUCCESS: _share(metrics.success),
        SURVIVAL: _share(metrics.survival),
        REWARD: _mean(metrics.reward),
        FLOWN: _mean(metrics.flown),
        settling_row(near): _moment(arrival.settling, "do"),
        **{time_row(each.tolerance): _moment(each) for each in metrics.arrivals},
        OVERSHOOT_RATE: Cell(words="–")
        if arrival.overshoot_rate is None
        else _share(arrival.overshoot_rate),
        OVERSHOOT: Cell(metrics.overshoot, words="–"),
        PATH: _mean(metrics.path),
        MEDIAN: Cell(metrics.final_error_median, decimals=3, words="–"),
        QUANTILE: replace(_mean(metrics.final_error_95), decimals=3),
        RECOVERY_TIME: _moment(metrics.recovery_time, "are"),
    }
    if metrics.cross_track_error is not None:
        cells[CROSS_TRACK_ERROR] = _mean(metrics.cross_track_error)
    if metrics.course is not None:
        cells[REACHED], cells[COMPLETED] = (
            _mean(metrics.course.reached),
            _share(metrics.course.completed),
        )
        cells[COURSE_TIME] = _mean(metrics.course.time, "never")
    return cells


def measured_cells(results: Results, controller: str, scenario: Scenario) -> Cells | None:
    """As :func:`metric_cells`, of the controller with that label, beside what its vehicle could do;
    None if it failed.
    """
    entry = results.entry(controller, scenario.name)
    return (
        None
        if entry is None
        else {**metric_cells(entry.metrics), LIMIT: Cell(entry.physical_limit)}
    )


def reference_cells(reference: Reference) -> Cells:
    """Others' metrics."""
    values = {
        REWARD: reference.reward,
        PATH: reference.path,
        MEDIAN: reference.final_error,
        FLOWN: reference.flown,
    }
    values |= {RECOVERY_TIME: reference.recovery_time}
    cells = {row: _printed(value) for row, value in values.items() if value is not None}
    shares = {SUCCESS: reference.success, SURVIVAL: reference.survival}
    cells |= {
        row: replace(_printed(share, 100.0), note=reference.note)
        for row, share in shares.items()
        if share is not None
    }
    return cells | {
        time_row(tolerance): _printed(time) for tolerance, time in reference.time_to.items()
    }


def metric_rows(
    scenario: Scenario, measured: Sequence[Cells | None], references: Iterable[Reference] = ()
) -> list[Row]:
    """The rows of a scenario, the best of each marked: first the cells of the controllers, then
    those from elsewhere.

    :param measured: of each controller; None: it failed.
    """
    others = [reference_cells(reference) for reference in references]
    none_lost = all(cells is None or cells[SURVIVAL].value == 100.0 for cells in measured)
    rows = []
    for row in _rows_of(scenario):
        failed = Cell(words="failed") if row == SUCCESS else Cell()
        own = [failed if cells is None else cells.get(row, Cell()) for cells in measured]
        if all(cell == Cell() for cell in own):
            continue
        if none_lost or row in ALWAYS_COMPARABLE:
            own = mark_best(row, own)
        rows.append(replace(row, cells=[*own, *(cells.get(row, Cell()) for cells in others)]))
    return rows


def mark_best(row: Row, cells: Sequence[Cell]) -> list[Cell]:
    """The cells of a row, the best of them marked, if its interval is apart from all others'."""
    higher = row in HIGHER_IS_BETTER
    if not (higher or row == COURSE_TIME or row.name.startswith(TIME)):
        return list(cells)
    measured = [cell for cell in cells if cell.value is not None]
    marked = []
    for cell in cells:
        others = [other for other in measured if other is not cell]
        best = (
            cell.value is not None
            and bool(others)
            and all(_beats(cell, other, higher) for other in others)
        )
        marked.append(replace(cell, best=best))
    return marked


def overview(results: Results, controllers: Sequence[str]) -> Table:
    """All scenarios in one table: a section each, a column per controller, reference metrics in the
    last column.

    :param controllers: labels, in the order of their columns.
    """
    columns = [*map(Column, controllers), Column(results.source, align="left")]
    if not any(scenario.reference for scenario in results.scenarios):
        columns.pop()
    rows = []
    for heading, scenarios in scenario_groups(results):
        rows.append(Row(heading))
        for scenario in scenarios:
            measured = [measured_cells(results, label, scenario) for label in controllers]
            found = metric_rows(scenario, measured, scenario.reference.values())
            varied = ", ".join(
                f"{axis_name(key)} {value:g}" for key, value in scenario.cell.items()
            )
            for row in found:
                name = f"{varied}, {row.name}" if varied and len(found) > 1 else varied or row.name
                others = zip(scenario.reference, row.cells[len(controllers) :], strict=True)
                beside = "; ".join(
                    f"{who} {replace(cell, note='').text}" for who, cell in others if cell != Cell()
                )
                cells = [*row.cells[: len(controllers)], Cell(words=beside)]
                rows.append(Row(f"  {name}", row.unit, cells[: len(columns)]))
    return Table(columns, rows, title=results.suite, caption=CAPTION)


def scenario_groups(results: Results) -> list[tuple[str, list[Scenario]]]:
    """Each scenario, or the cells that ``vary`` makes of one, with its heading."""
    groups = []
    for _, members in groupby(results.scenarios, lambda scenario: scenario.group or scenario.name):
        scenarios = list(members)
        heading = (
            scenarios[0].heading.rsplit(":", 1)[0] if scenarios[0].group else scenarios[0].heading
        )
        groups.append((heading[:1].upper() + heading[1:], scenarios))
    return groups


def _rows_of(scenario: Scenario) -> list[Row]:
    """The rows that mean something in a scenario; only the main ones of many tolerances, a plot
    shows the others.
    """
    if scenario.target.waypoints is not None:
        return [SUCCESS, SURVIVAL, REACHED, COMPLETED, COURSE_TIME]
    if scenario.group is not None:
        return [SUCCESS, SURVIVAL, MEDIAN] if len(scenario.cell) == 1 else [SUCCESS]
    tolerances = scenario.tolerances
    if len(tolerances) > MOST_TOLERANCES:
        referenced = {
            float(key) for reference in scenario.reference.values() for key in reference.time_to
        }
        kept = {tolerances[0], *MAIN_TOLERANCES, *referenced}
        tolerances = tuple(tolerance for tolerance in tolerances if tolerance in kept)
    if (
        scenario.target.distance == 0.0
    ):  # where an episode starts at its target there is no way to it
        return [
            SUCCESS,
            SURVIVAL,
            *([FLOWN] if scenario.is_fixed else []),
            REWARD,
            RECOVERY_TIME,
            MEDIAN,
            QUANTILE,
        ]
    times = [
        settling_row(arrival_tolerance(tolerances)),
        LIMIT,
        OVERSHOOT_RATE,
        OVERSHOOT,
        *map(time_row, tolerances),
    ]
    return [SUCCESS, SURVIVAL, REWARD, *times, PATH, CROSS_TRACK_ERROR, MEDIAN, QUANTILE]


def _beats(cell: Cell, other: Cell, higher: bool) -> bool:
    (low, high), (other_low, other_high) = (
        each.ends or (each.value or 0.0,) * 2 for each in (cell, other)
    )
    return low > other_high if higher else high < other_low


def _share(estimate: Estimate) -> Cell:
    """In percent, with as many digits as a single flight takes to show."""
    digits = len(str(estimate.n // 200))
    return Cell(100 * estimate.value, (100 * estimate.low, 100 * estimate.high), decimals=digits)


def _mean(estimate: Estimate | None, none: str = "–") -> Cell:
    return (
        Cell(words=none)
        if estimate is None
        else Cell(estimate.value, (estimate.low, estimate.high))
    )


def _moment(moment: Moment, verb: str = "arrive") -> Cell:
    some = moment.time is not None and moment.share.value < 1.0
    return replace(
        _mean(moment.time, "never"), note=f"{100 * moment.share.value:.3g} % {verb}" if some else ""
    )


def _printed(value: NumberOrRange | None, factor: float = 1.0) -> Cell:
    """A number as its source prints it; a pair is a range, None a time that never came."""
    if value is None:
        return Cell(words="never")
    if isinstance(value, tuple):
        return Cell(words=" to ".join(f"{factor * end:g}" for end in value).replace("-", "−"))
    return Cell(factor * value, decimals=len(f"{factor * value:g}".partition(".")[2]))
