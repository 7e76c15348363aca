"""Tables of flights: one column per controller, and others' figures beside them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby

from rich.markup import escape
from rich.table import Table

from sb3_quad.evaluation.records import Arrival, Estimate, HitLimit, Metrics, Results
from sb3_quad.scenarios.scenario import NumberOrRange, Reference, Scenario
from sb3_quad.scenarios.vary import axis_name

SUCCESS, REWARD, PATH, MEDIAN, LARGEST = "success", "mean reward", "mean path", "final error, median", "final error, largest"
FLOWN, REACHED, COMPLETED, COURSE_TIME = "time flown", "waypoints reached", "courses completed", "time of the course"
HIT, HIT_SIZE = "half survive up to", "which is"
CAPTION = "(…): 95 % interval; ±: half of it; (… %) after a time: the flights that came so close, if not all"


TASK_SCENARIOS = {"target_tracking": "tracking", "state_recovery": "recovery"}  # of the thesis suite


def time_row(tolerance: float | str) -> str:
    """The name of the row with the time to a tolerance."""
    return f"mean time to {float(tolerance):g} m"


def rows(figures: Metrics, limit: HitLimit | None = None) -> dict[str, str]:
    """Figures as text, by the names of the rows; each with its 95 % interval, where that is wider than the last digit."""
    cells = {SUCCESS: _share(figures.success), REWARD: _mean(figures.reward), FLOWN: _mean(figures.flown, " s")}
    cells |= {time_row(arrival.tolerance): _arrival(arrival) for arrival in figures.arrivals}
    cells[PATH] = _mean(figures.path, " m")
    cells[MEDIAN] = "" if figures.final_error_median is None else f"{figures.final_error_median:.3f} m"
    cells[LARGEST] = "" if figures.final_error_max is None else f"{figures.final_error_max:.3f} m"
    if figures.course is not None:
        cells[REACHED] = _mean(figures.course.reached)
        cells[COMPLETED] = _share(figures.course.completed)
        cells[COURSE_TIME] = _mean(figures.course.time, " s") or "never"
    if limit is not None:
        cells[HIT], cells[HIT_SIZE] = _limit(limit)
    return cells


def reference_rows(reference: Reference) -> dict[str, str]:
    """Others' figures as text, by the names of the rows."""
    given = {SUCCESS: (reference.success, " %"), REWARD: (reference.reward, ""), PATH: (reference.path, " m")}
    given |= {MEDIAN: (reference.final_error, " m"), FLOWN: (reference.flown, " s")}
    cells = {name: _figure(figure, unit) for name, (figure, unit) in given.items() if figure is not None}
    for tolerance, time in reference.time_to.items():
        cells[time_row(tolerance)] = "never" if time is None else _figure(time, " s")
    return cells


def shown_rows(scenario: Scenario) -> list[str]:
    """The rows that mean something in a scenario."""
    if scenario.target.waypoints is not None:
        return [SUCCESS, REACHED, COMPLETED, COURSE_TIME]
    if scenario.group is not None:
        return [SUCCESS, MEDIAN] if len(scenario.cell) == 1 else [SUCCESS]
    times = [time_row(tolerance) for tolerance in scenario.tolerances]
    if scenario.target.distance == 0.0:  # where an episode starts at its target there is no way to it
        names = [SUCCESS, REWARD, MEDIAN, LARGEST]
        if scenario.is_fixed:
            names.insert(1, FLOWN)
    else:
        names = [SUCCESS, REWARD, *times, PATH, MEDIAN, LARGEST]
    return names + ([] if scenario.hit_search is None else [HIT, HIT_SIZE])


def comparison(title: str, columns: Mapping[str, Metrics], scenario: Scenario, only: Iterable[str] | None = None) -> Table:
    """A table of controllers side by side in one scenario, and the columns of its reference figures.

    :param columns: from the name of each controller to its figures.
    :param only: the reference columns to show; None: all.
    """
    table = Table(title=title, title_justify="left", caption=CAPTION, caption_justify="left")
    table.add_column("", no_wrap=True)
    kept = [name for name in (scenario.reference if only is None else only) if name in scenario.reference]
    cells = {name: rows(figures) for name, figures in columns.items()}
    cells |= {f"thesis: {name}": reference_rows(scenario.reference[name]) for name in kept}
    for name in cells:
        table.add_column(escape(name), justify="right")
    for row in shown_rows(scenario):
        if any(row in cells[name] for name in columns):
            table.add_row(row, *(column.get(row, "") for column in cells.values()))
    return table


def overview(results: Results, controllers: Sequence[str], source: str = "reference") -> Table:
    """All scenarios in one table: a section each, a column per controller, reference figures in the last column.

    :param controllers: labels, in the order of their columns.
    :param source: heads the column of the reference figures.
    """
    table = Table(title=results.suite, title_justify="left", caption=CAPTION, caption_justify="left")
    table.add_column("", no_wrap=True)
    for label in controllers:
        table.add_column(escape(label), justify="right")
    referenced = any(scenario.reference for scenario in results.scenarios)
    if referenced:
        table.add_column(escape(source))
    for group, members in groupby(results.scenarios, lambda scenario: scenario.group or scenario.name):
        scenarios = list(members)
        heading = scenarios[0].heading.rsplit(":", 1)[0] if scenarios[0].group else scenarios[0].heading
        table.add_row(f"[bold]{escape(heading or group)}[/]", end_section=False)
        for scenario in scenarios:
            _add_scenario(table, results, scenario, controllers, referenced)
        table.add_section()
    return table


def _add_scenario(table: Table, results: Results, scenario: Scenario, controllers: Sequence[str], referenced: bool) -> None:
    entries = [results.entry(label, scenario.name) for label in controllers]
    cells = [rows(entry.metrics, entry.hit_limit) if entry is not None else None for entry in entries]
    others = {name: reference_rows(reference) for name, reference in scenario.reference.items()}
    cell = ", ".join(f"{axis_name(key)} {value:g}" for key, value in scenario.cell.items())
    names = shown_rows(scenario)
    for row in names:
        name = row if not cell else cell if row == SUCCESS else ""
        name = f"{cell}, {row}" if cell and len(names) > 1 else name
        values = ["failed" if column is None and row == names[0] else (column or {}).get(row, "") for column in cells]
        beside = "; ".join(f"{who} {column[row]}" for who, column in others.items() if row in column)
        table.add_row(f"  {escape(name)}", *values, *([escape(beside)] if referenced else []))


def _arrival(arrival: Arrival) -> str:
    if arrival.time is None:
        return "never"
    text = _mean(arrival.time, " s")
    return text if arrival.share.value == 1.0 else f"{text} ({100 * arrival.share.value:.3g} %)"


def _share(estimate: Estimate) -> str:
    return f"{_percent(estimate.value)} % ({100 * estimate.low:.3g}-{100 * estimate.high:.3g})"


def _mean(estimate: Estimate | None, unit: str = "") -> str:
    if estimate is None:
        return ""
    half = (estimate.high - estimate.low) / 2
    return f"{estimate.value:.2f}" + (f" ± {half:.2f}" if half >= 0.005 else "") + unit


def _limit(limit: HitLimit) -> tuple[str, str]:
    factor = limit.trials[-1].factor if limit.factor is None else limit.factor
    size = " and ".join(f"{factor * part:.1f} {unit}" for part, unit in ((limit.force, "N"), (limit.torque, "N m")) if part)
    if limit.factor is None:
        return f"more than {factor:g} x", f"more than {size}"
    high = "" if limit.high is None else f"{limit.high:.2f}"
    return f"{factor:.2f} x ({limit.low:.2f}-{high})", size


def _figure(figure: NumberOrRange, unit: str) -> str:
    values = figure if isinstance(figure, tuple) else (figure,)
    return "-".join(_percent(value) if unit == " %" else f"{value:g}" for value in values) + unit


def _percent(share: float) -> str:
    return f"{100 * share:.2f}".rstrip("0").rstrip(".")
