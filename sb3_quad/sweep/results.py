"""What a sweep found: ``results.csv``, ``results.json``, and the tables that the terminal and the report show."""

import csv
import io
import itertools
import json
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from sb3_quad.base.arrays import FloatArray
from sb3_quad.base.files import write_text
from sb3_quad.base.version import __version__
from sb3_quad.evaluation.tables import Cell, Column, Row, Table
from sb3_quad.sweep.aggregates import aggregates
from sb3_quad.sweep.folder import Plan, SweepFolder
from sb3_quad.sweep.records import ERROR, MEASURES, REWARD, SUCCESS, SURVIVAL, TIME, RunRecord
from sb3_quad.sweep.statistics import Comparison, Interval, compare, over_seeds

CSV, JSON = "results.csv", "results.json"
ROWS = {  # by measure: its row, factor and decimals
    SUCCESS: (Row("success", "%"), 100.0, 2),
    SURVIVAL: (Row("survival", "%"), 100.0, 2),
    REWARD: (Row("mean reward"), 1.0, 2),
    ERROR: (Row("final error, median", "m"), 1.0, 3),
    TIME: (Row("mean time until there, or stable", "s"), 1.0, 2),
}
COMPARED = (SUCCESS, REWARD)
CAPTION = "means over seeds; in brackets: 95 % intervals, by a bootstrap over seeds and episodes"
MOST_COMPARED = 8  # configurations of which every pair is compared

Records = Mapping[str, RunRecord]


class Found(NamedTuple):
    """What a sweep found.

    :param groups: by configuration, its finished runs, in the order of the seeds; only configurations that have any.
    :param intervals: by configuration, scenario and measure; None: not measured.
    :param comparisons: by scenario, measure and pair of configurations.
    """

    groups: dict[str, list[RunRecord]]
    intervals: dict[tuple[str, str, str], Interval | None]
    comparisons: dict[tuple[str, str, str, str], Comparison]

    @property
    def n_finished(self) -> int:
        """How many runs are finished."""
        return sum(len(group) for group in self.groups.values())


def evaluate(plan: Plan, records: Records) -> Found:
    """Means, intervals and comparisons of all runs that are finished."""
    groups: dict[str, list[RunRecord]] = {name: [] for name in plan.configurations}
    for run in plan.runs:
        record = records.get(run.name)
        if record is not None and record.state == "finished":
            groups[run.configuration].append(record)
    groups = {name: group for name, group in groups.items() if group}
    keys = itertools.product(groups, scenarios_of(groups), MEASURES)
    intervals = {key: _over_seeds(matrix(groups[key[0]], *key[1:]), key[2]) for key in keys}
    return Found(groups, intervals, comparisons(groups))


def write_results(place: SweepFolder, plan: Plan, records: Records, found: Found) -> None:
    """Write ``results.csv``, a line for each run and scenario, and ``results.json``.

    :raises ConfigError: a folder that cannot be written, a full disk.
    """
    text, rows = io.StringIO(), [row for run in plan.runs if run.name in records for row in _rows(records[run.name])]
    columns = ["run", "configuration", "seed", "state", "scenario", "episodes", *MEASURES, "timesteps", "agent", "weights"]
    writer = csv.DictWriter(text, [*columns, "message"], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(place.path / CSV, text.getvalue())
    content = {
        "sweep": plan.spec.name,
        "package_version": __version__,
        "runs": len(plan.runs),
        "finished": found.n_finished,
        "failed": {name: record.message for name, record in records.items() if record.state == "failed"},
        "configurations": {
            name: {"seeds": [record.seed for record in group], "scenarios": _summary(found, name)}
            for name, group in found.groups.items()
        },
        "comparisons": [
            {"scenario": scenario, "measure": measure, "first": first, "second": second, "verdict": pair.verdict}
            | pair.difference._asdict()
            for (scenario, measure, first, second), pair in found.comparisons.items()
        ],
        "aggregates": aggregates(found.groups),
    }
    write_text(place.path / JSON, json.dumps(content, indent=1) + "\n")


def tables(found: Found) -> dict[str, list[Table]]:
    """By scenario, a column for each configuration; and who is better than whom."""
    made: dict[str, list[Table]] = {}
    for scenario in scenarios_of(found.groups):
        rows = []
        for measure, (row, factor, decimals) in ROWS.items():
            cells = [_cell(found.intervals[name, scenario, measure], factor, decimals) for name in found.groups]
            if any(cell != Cell() for cell in cells):
                rows.append(Row(row.name, row.unit, cells))
        columns = [Column(f"{name} ({_count(group)})") for name, group in found.groups.items()]
        made[scenario] = [Table(columns, rows, title=scenario, caption=CAPTION)]
        lines = [
            Row(f"{first} than {second}", ROWS[measure][0].heading, [Cell(words=pair.verdict), _difference(pair, measure)])
            for (where, measure, first, second), pair in found.comparisons.items()
            if where == scenario
        ]
        if lines:
            heads = [Column("is", align="left"), Column("difference")]
            note = "paired bootstrap over the seeds and episodes that both have"
            made[scenario].append(Table(heads, lines, title=f"{scenario}: better, worse, cannot tell", caption=note))
    return made


def comparisons(groups: Mapping[str, Sequence[RunRecord]]) -> dict[tuple[str, str, str, str], Comparison]:
    """By scenario, measure and pair of configurations; of very many configurations, each against the first alone."""
    names = list(groups)
    pairs = list(itertools.combinations(names, 2))
    if len(names) > MOST_COMPARED:
        pairs = [(names[0], name) for name in names[1:]]
    found = {}
    for scenario, measure, (first, second) in itertools.product(scenarios_of(groups), COMPARED, pairs):
        one, two = ({record.seed: record for record in groups[name]} for name in (first, second))
        common = [seed for seed in one if seed in two]
        values = [matrix([each[seed] for seed in common], scenario, measure) for each in (one, two)]
        if common and all(each is not None and np.isfinite(each).all() for each in values):
            found[scenario, measure, first, second] = compare(*values)  # type: ignore[arg-type]
    return found


def scenarios_of(groups: Mapping[str, Sequence[RunRecord]]) -> list[str]:
    """All scenarios that were flown, in order."""
    return [*dict.fromkeys(name for group in groups.values() for record in group for name in record.flights)]


def matrix(records: Sequence[RunRecord], scenario: str, measure: str) -> FloatArray | None:
    """A measure of some runs, (runs, episodes), NaN where there is no number; None: it was not measured."""
    rows = [record.flights.get(scenario, {}).get(measure) for record in records]
    if any(row is None for row in rows) or len({len(row or ()) for row in rows}) != 1:
        return None
    return np.array(rows, dtype=np.float64)


def _over_seeds(values: FloatArray | None, measure: str) -> Interval | None:
    return None if values is None else over_seeds(values, measure)


def _summary(found: Found, configuration: str) -> dict[str, Any]:
    def entry(interval: Interval | None) -> dict[str, float] | None:
        return None if interval is None else interval._asdict()

    names = scenarios_of({"": found.groups[configuration]})
    return {name: {measure: entry(found.intervals[configuration, name, measure]) for measure in MEASURES} for name in names}


def _rows(record: RunRecord) -> list[dict[str, Any]]:
    common = record.model_dump(include={"configuration", "seed", "state", "timesteps", "agent", "weights", "message"})
    common["run"] = record.name
    if not record.flights:
        return [common]
    lines = []
    for scenario, measures in record.flights.items():
        line = {**common, "scenario": scenario, "episodes": len(next(iter(measures.values())))}
        for measure in measures:
            values = matrix([record], scenario, measure)
            if values is not None and np.isfinite(values).any():
                line[measure] = f"{np.nanmedian(values) if measure == ERROR else np.nanmean(values):.9g}"
        lines.append(line)
    return lines


def _cell(interval: Interval | None, factor: float, decimals: int) -> Cell:
    if interval is None:
        return Cell()
    return Cell(factor * interval.value, (factor * interval.low, factor * interval.high), decimals)


def _difference(pair: Comparison, measure: str) -> Cell:
    _, factor, decimals = ROWS[measure]
    return _cell(pair.difference, factor, decimals)


def _count(group: Sequence[RunRecord]) -> str:
    return f"{len(group)} seed" + ("s" if len(group) > 1 else "")
