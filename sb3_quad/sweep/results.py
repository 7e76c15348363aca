"""What a sweep found: ``results.csv``, ``results.json``, and the tables that the terminal and the
page show.

Intervals are bootstraps over seeds and episodes. A resample takes as many seeds as there are, with
replacement, and as many episodes; the episodes are the same in every run, so that seeds and
episodes are crossed (Owen, The pigeonhole bootstrap, Annals of Applied Statistics 1, 2007). Few
seeds give intervals that are too narrow (Agarwal et al., Deep Reinforcement Learning at the Edge of
the Statistical Precipice, NeurIPS 2021): with one they tell of episodes alone.
"""

import itertools
import json
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sb3_quad.base import __version__
from sb3_quad.base.arrays import FloatArray
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import write_csv, write_text
from sb3_quad.evaluation.learning_curves import Curve, read_curve
from sb3_quad.evaluation.metric_tables import estimate_cell
from sb3_quad.evaluation.statistics import RESAMPLES, Estimate
from sb3_quad.evaluation.tables import Cell, Column, Row, Table
from sb3_quad.report.curves import plot_curves
from sb3_quad.report.page import Section, write_page
from sb3_quad.report.plots import Plot
from sb3_quad.sweep.folder import (
    ERROR,
    MEASURES,
    REWARD,
    SUCCESS,
    SURVIVAL,
    TIME,
    Plan,
    RunRecord,
    SweepFolder,
)

ROWS = {  # by measure: its row, factor and decimals
    SUCCESS: (Row("success", "%"), 100.0, 2),
    SURVIVAL: (Row("survival", "%"), 100.0, 2),
    REWARD: (Row("mean reward"), 1.0, 2),
    ERROR: (Row("final error, median", "m"), 1.0, 3),
    TIME: (Row("mean time until there, or stable", "s"), 1.0, 2),
}
STATISTICS = {measure: np.nanmedian if measure == ERROR else np.nanmean for measure in MEASURES}
COMPARED = (SUCCESS, REWARD)
CAPTION = "means over seeds; in brackets: 95 % intervals, by a bootstrap over seeds and episodes"


@dataclass(frozen=True)
class SweepResults:
    """What the finished runs of a sweep reached.

    :param groups: by configuration, its finished runs, in the order of the seeds; only
        configurations that have any.
    :param estimates: by configuration, scenario and measure; None: not measured.
    :param comparisons: by scenario, measure and pair of configurations, the first less the second.
    """

    plan: Plan
    records: Mapping[str, RunRecord]
    groups: dict[str, list[RunRecord]]
    estimates: dict[tuple[str, str, str], Estimate | None]
    comparisons: dict[tuple[str, str, str, str], Estimate]

    @property
    def finished(self) -> int:
        """How many runs are finished."""
        return sum(len(group) for group in self.groups.values())


def evaluate(plan: Plan, records: Mapping[str, RunRecord]) -> SweepResults:
    """Means, intervals and comparisons of all runs that are finished."""
    groups: dict[str, list[RunRecord]] = {}
    for run in plan.runs:
        if run.name in records and records[run.name].state == "finished":
            groups.setdefault(run.configuration, []).append(records[run.name])
    estimates = {
        (name, scenario, measure): over_seeds(
            _matrix(groups[name], scenario, measure), STATISTICS[measure]
        )
        for name, scenario, measure in itertools.product(groups, _scenarios(groups), MEASURES)
    }
    return SweepResults(plan, records, groups, estimates, _compare(groups))


def over_seeds(
    values: FloatArray, statistic: Callable[..., FloatArray] = np.nanmean
) -> Estimate | None:
    """The mean over seeds of a statistic of a run's episodes; of the difference of two
    configurations, a paired bootstrap.

    :param values: of a measure, (seeds, episodes), NaN where there is none.
    :return: None if a run has no number at all.
    """
    if not np.isfinite(values).any(axis=1).all():
        return None
    random = np.random.default_rng(0)
    seeds, episodes = (random.integers(0, n, (RESAMPLES, n)) for n in values.shape)
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore", RuntimeWarning
        )  # a resample may miss the few episodes that have a number
        runs = np.stack(
            [statistic(row[episodes], axis=1) for row in values], axis=1
        )  # (resamples, seeds)
        means = np.nanmean(np.take_along_axis(runs, seeds, axis=1), axis=1)
    low, high = np.nanpercentile(means, [2.5, 97.5])
    value = float(statistic(values, axis=1).mean())
    return Estimate(
        value=value, low=min(value, float(low)), high=max(value, float(high)), n=values.size
    )


def _compare(
    groups: Mapping[str, Sequence[RunRecord]],
) -> dict[tuple[str, str, str, str], Estimate]:
    found = {}
    for scenario, measure, pair in itertools.product(
        _scenarios(groups), COMPARED, itertools.combinations(groups, 2)
    ):
        first, second = ({record.seed: record for record in groups[name]} for name in pair)
        common = [seed for seed in first if seed in second]
        one, two = (
            _matrix([each[seed] for seed in common], scenario, measure) for each in (first, second)
        )
        difference = over_seeds(one - two) if common and one.shape == two.shape else None
        if difference is not None:
            found[scenario, measure, pair[0], pair[1]] = difference
    return found


def verdict(difference: Estimate) -> str:
    """Whether the first of two is better or worse: whether the interval of the difference leaves
    out zero.
    """
    return "better" if difference.low > 0 else "worse" if difference.high < 0 else "cannot tell"


def write_results(place: SweepFolder, found: SweepResults) -> None:
    """Write ``results.csv``, a line for each run and scenario, and ``results.json``.

    :raises ConfigError: a folder that cannot be written, a full disk.
    """
    records = [found.records[run.name] for run in found.plan.runs if run.name in found.records]
    columns = [
        "run",
        "configuration",
        "seed",
        "state",
        "scenario",
        "episodes",
        *MEASURES,
        "timesteps",
        "agent",
        "weights",
    ]
    write_csv(
        place.path / "results.csv",
        [*columns, "message"],
        (row for record in records for row in _rows(record)),
    )
    content = {
        "sweep": found.plan.spec.name,
        "package_version": __version__,
        "runs": len(found.plan.runs),
        "finished": found.finished,
        "failed": {
            name: record.message
            for name, record in found.records.items()
            if record.state == "failed"
        },
        "configurations": {
            name: {"seeds": [record.seed for record in group], "scenarios": _summary(found, name)}
            for name, group in found.groups.items()
        },
        "comparisons": [
            {
                "scenario": scenario,
                "measure": measure,
                "first": first,
                "second": second,
                "verdict": verdict(difference),
            }
            | difference.model_dump()
            for (scenario, measure, first, second), difference in found.comparisons.items()
        ],
    }
    write_text(place.path / "results.json", json.dumps(content, indent=1) + "\n")


def tables(found: SweepResults) -> dict[str, list[Table]]:
    """By scenario, a column for each configuration; and who is better than whom."""
    columns = [
        Column(f"{name} ({len(group)} seed{'s' * (len(group) > 1)})")
        for name, group in found.groups.items()
    ]
    made: dict[str, list[Table]] = {}
    for scenario in _scenarios(found.groups):
        rows = []
        for measure, (row, _, _) in ROWS.items():
            cells = [
                _cell(found.estimates[name, scenario, measure], measure) for name in found.groups
            ]
            if any(cell != Cell() for cell in cells):
                rows.append(Row(row.name, row.unit, cells))
        made[scenario] = [Table(columns, rows, title=scenario, caption=CAPTION)]
        lines = [
            Row(
                f"{one} than {two}",
                ROWS[measure][0].heading,
                [Cell(words=verdict(difference)), _cell(difference, measure)],
            )
            for (where, measure, one, two), difference in found.comparisons.items()
            if where == scenario
        ]
        if lines:
            heads = [Column("is", align="left"), Column("difference")]
            note = "paired bootstrap over the seeds and episodes that both have"
            made[scenario].append(
                Table(heads, lines, title=f"{scenario}: better, worse, cannot tell", caption=note)
            )
    return made


def _scenarios(groups: Mapping[str, Sequence[RunRecord]]) -> list[str]:
    """All scenarios that were flown, in order."""
    return [
        *dict.fromkeys(
            name for group in groups.values() for record in group for name in record.flights
        )
    ]


def _matrix(records: Sequence[RunRecord], scenario: str, measure: str) -> FloatArray:
    """A measure of some runs, (runs, episodes), NaN where there is no number; (runs, 0) if it was
    not measured.
    """
    return np.array(
        [record.flights.get(scenario, {}).get(measure, ()) for record in records], dtype=np.float64
    )


def _summary(found: SweepResults, configuration: str) -> dict[str, Any]:
    names = _scenarios({configuration: found.groups[configuration]})
    estimates = {
        name: {measure: found.estimates[configuration, name, measure] for measure in MEASURES}
        for name in names
    }
    return {
        name: {key: each and each.model_dump() for key, each in group.items()}
        for name, group in estimates.items()
    }


def _rows(record: RunRecord) -> list[dict[str, Any]]:
    common = record.model_dump(
        include={"configuration", "seed", "state", "timesteps", "agent", "weights", "message"}
    )
    common["run"] = record.name
    lines = []
    for scenario, measures in record.flights.items():
        line = {**common, "scenario": scenario, "episodes": len(next(iter(measures.values())))}
        for measure in measures:
            values = _matrix([record], scenario, measure)
            if np.isfinite(values).any():
                line[measure] = f"{STATISTICS[measure](values):.9g}"
        lines.append(line)
    return lines or [common]


def _cell(estimate: Estimate | None, measure: str) -> Cell:
    _, factor, decimals = ROWS[measure]
    return estimate_cell(estimate, factor, decimals, none="")


def write_report(
    place: SweepFolder, found: SweepResults, shown: Mapping[str, Sequence[Table]]
) -> Path:
    """Write the report of a sweep's finished runs: a section for each scenario and the learning
    curves.

    :param shown: the tables of :func:`~sb3_quad.sweep.results.tables`, by scenario.
    :return: the page.
    :raises ConfigError: a folder that cannot be written.
    """
    parts = [
        Section(f"scenario-{number}", scenario, "", flown, facts=flown[0].caption)
        for number, (scenario, flown) in enumerate(shown.items())
    ]
    plots = _curves(place, found)
    if plots:
        parts.append(
            Section("curves", "Learning curves", "Mean over seeds, with their range.", [], plots)
        )
    configurations = len({run.configuration for run in found.plan.runs})
    facts = f"{found.finished} of {len(found.plan.runs)} runs of {configurations} configurations are finished."
    return write_page(place.path, f"Sweep: {found.plan.spec.name}", facts, parts)


def _curves(place: SweepFolder, found: SweepResults) -> list[Plot]:
    """A plot of the evaluations along the way; of pipelines, one for each algorithm and environment
    of a stage.
    """
    curves: dict[str, dict[str, list[Curve]]] = {}
    for name, group in found.groups.items():
        for record in group:
            for path in sorted((place.path / "runs" / record.name).glob("*/*/evaluations.npz")):
                kind = f"{path.parent.parent.name} {path.parent.name.rpartition('_')[0]}"
                curves.setdefault(kind, {}).setdefault(name, []).append(read_curve(path.parent))
    plots = []
    for number, (kind, groups) in enumerate(curves.items()):
        try:
            figure = plot_curves(groups, {}, kind)
        except ConfigError:  # nothing of what is shown was measured
            continue
        plots.append(
            Plot(f"curves_{number}", f"{kind}: success and reward along the training.", figure)
        )
    return plots
