"""The results of a sweep: ``results.csv``, ``results.json``, and the tables of terminal and page.

Intervals are bootstraps over seeds and episodes. A resample takes as many seeds as there are, with
replacement, and as many episodes; the episodes are the same in every run, so that seeds and
episodes are crossed (Owen, The pigeonhole bootstrap, Annals of Applied Statistics 1, 2007). Few
seeds give intervals that are too narrow (Agarwal et al., Deep Reinforcement Learning at the Edge of
the Statistical Precipice, NeurIPS 2021): with one seed they cover the choice of episodes alone.
"""

import itertools
import json
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic_core import to_jsonable_python

from sb3_quad.base import __version__
from sb3_quad.base.arrays import FloatArray
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import write_csv, write_text
from sb3_quad.evaluation import metric_tables
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
    RunResult,
    Sweep,
    SweepFolder,
)

# By measure: its row, the factor from values to cells, and their decimals.
ROWS = {
    SUCCESS: (metric_tables.SUCCESS, 100.0, 2),
    SURVIVAL: (metric_tables.SURVIVAL, 100.0, 2),
    REWARD: (metric_tables.REWARD, 1.0, 2),
    ERROR: (metric_tables.MEDIAN, 1.0, 3),
    TIME: (Row("mean time until there, or stable", "s"), 1.0, 2),
}
STATISTICS = dict.fromkeys(MEASURES, np.nanmean) | {ERROR: np.nanmedian}
COMPARED = (SUCCESS, REWARD)
CAPTION = "means over seeds; in brackets: 95 % intervals, by a bootstrap over seeds and episodes"
COLUMNS = (
    *("run", "configuration", "seed", "state", "scenario", "episodes"),
    *MEASURES,
    *("timesteps", "agent", "weights", "message"),
)


class Comparison(Estimate, use_attribute_docstrings=True):
    """The difference of two configurations, the first less the second."""

    scenario: str
    measure: str
    first: str
    second: str
    verdict: str
    """whether the first is better or worse"""


@dataclass(frozen=True)
class SweepResults:
    """The results of the finished runs of a sweep.

    :param results: of all runs that ended, by name.
    :param groups: by configuration, its finished runs, in the order of the seeds; only
        configurations that have any.
    :param estimates: by configuration, scenario and measure; None: not measured.
    """

    sweep: Sweep
    results: Mapping[str, RunResult]
    groups: dict[str, list[RunResult]]
    estimates: dict[str, dict[str, dict[str, Estimate | None]]]
    comparisons: list[Comparison]

    @property
    def finished(self) -> int:
        """The number of finished runs."""
        return sum(map(len, self.groups.values()))

    @property
    def scenarios(self) -> list[str]:
        """All scenarios that were flown, in order."""
        return [*dict.fromkeys(itertools.chain.from_iterable(self.estimates.values()))]


def summarize(sweep: Sweep, results: Mapping[str, RunResult]) -> SweepResults:
    """Return means, intervals and comparisons of all runs that are finished."""
    # In the order of the plan, not in that in which runs ended.
    groups: dict[str, list[RunResult]] = {}
    for run in sweep.runs:
        result = results.get(run.name)
        if result is not None and result.state == "finished":
            groups.setdefault(run.configuration, []).append(result)
    # All runs of a configuration fly the same scenarios.
    estimates: dict[str, dict[str, dict[str, Estimate | None]]] = {}
    for name, group in groups.items():
        estimates[name] = {}
        for scenario in group[0].flights:
            estimates[name][scenario] = {
                measure: over_seeds(_matrix(group, scenario, measure), STATISTICS[measure])
                for measure in MEASURES
            }
    summary = SweepResults(sweep, results, groups, estimates, [])
    _compare(summary)
    return summary


def over_seeds(
    values: FloatArray, statistic: Callable[..., FloatArray] = np.nanmean
) -> Estimate | None:
    """Estimate the mean over seeds of a statistic of a run's episodes; of the difference of two
    configurations, a paired bootstrap.

    :param values: of a measure, (seeds, episodes), NaN without a number.
    :return: None if a run has no number at all.
    """
    # Without a number from some run, there is no mean over seeds.
    if not np.isfinite(values).any(axis=1).all():
        return None
    # The same resamples each time: equal values give equal intervals.
    random = np.random.default_rng(0)
    seeds, episodes = (random.integers(0, n, (RESAMPLES, n)) for n in values.shape)
    with warnings.catch_warnings():
        # A resample may miss the few episodes that have a number.
        warnings.simplefilter("ignore", RuntimeWarning)
        # (resamples, seeds)
        runs = np.stack([statistic(row[episodes], axis=1) for row in values], axis=1)
        means = np.nanmean(np.take_along_axis(runs, seeds, axis=1), axis=1)
    # The interval holds the value, even if every resample misses it.
    low, high = np.nanpercentile(means, [2.5, 97.5])
    value = float(statistic(values, axis=1).mean())
    return Estimate(
        value=value, low=min(value, float(low)), high=max(value, float(high)), n=values.size
    )


def _compare(summary: SweepResults) -> None:
    """Add the comparisons of all pairs of configurations, on the seeds that both have."""
    pairs = list(itertools.combinations(summary.groups, 2))
    for scenario, measure, (first, second) in itertools.product(summary.scenarios, COMPARED, pairs):
        # The same seeds and the same episodes, so that differences are paired.
        by_seed = {result.seed: result for result in summary.groups[second]}
        ours = [result for result in summary.groups[first] if result.seed in by_seed]
        theirs = [by_seed[result.seed] for result in ours]
        values = _matrix(ours, scenario, measure)
        others = _matrix(theirs, scenario, measure)
        if not ours or values.shape != others.shape:
            continue
        difference = over_seeds(values - others)
        if difference is not None:
            comparison = Comparison(
                **difference.model_dump(),
                scenario=scenario,
                measure=measure,
                first=first,
                second=second,
                verdict=verdict(difference),
            )
            summary.comparisons.append(comparison)


def verdict(difference: Estimate) -> str:
    """Return whether the first of two is better or worse: whether the interval of the difference
    leaves out zero.
    """
    if difference.low > 0:
        return "better"
    return "worse" if difference.high < 0 else "cannot tell"


def write_results(place: SweepFolder, summary: SweepResults) -> None:
    """Write ``results.csv``, a line for each run and scenario, and ``results.json``.

    :raises ConfigError: a folder that cannot be written, a full disk.
    """
    # The table holds every run that ended, also those that failed.
    results = summary.results
    ended = [results[run.name] for run in summary.sweep.runs if run.name in results]
    lines = itertools.chain.from_iterable(map(_lines, ended))
    write_csv(place.path / "results.csv", COLUMNS, lines)
    failed = {name: result.message for name, result in results.items() if result.state == "failed"}
    configurations = {}
    for name, group in summary.groups.items():
        seeds = [result.seed for result in group]
        configurations[name] = {"seeds": seeds, "scenarios": summary.estimates[name]}
    content = {
        "sweep": summary.sweep.spec.name,
        "package_version": __version__,
        "runs": len(summary.sweep.runs),
        "finished": summary.finished,
        "failed": failed,
        "configurations": configurations,
        "comparisons": summary.comparisons,
    }
    text = json.dumps(to_jsonable_python(content), indent=1)
    write_text(place.path / "results.json", f"{text}\n")


def _lines(result: RunResult) -> Iterator[dict[str, Any]]:
    """Yield the lines of a run in ``results.csv``: one for each scenario, or one without."""
    line = {**result.model_dump(exclude={"name", "flights"}), "run": result.name}
    if not result.flights:
        yield line
    for scenario, measures in result.flights.items():
        statistics = {}
        for measure in measures:
            values = _matrix([result], scenario, measure)
            if np.isfinite(values).any():
                statistics[measure] = f"{STATISTICS[measure](values):.9g}"
        episodes = max(map(len, measures.values()))
        yield {**line, "scenario": scenario, "episodes": episodes, **statistics}


def tables(summary: SweepResults) -> dict[str, list[Table]]:
    """Return by scenario a table with a column for each configuration, and one that compares
    them.
    """
    columns = []
    for name, group in summary.groups.items():
        seeds = "1 seed" if len(group) == 1 else f"{len(group)} seeds"
        columns.append(Column(f"{name} ({seeds})"))
    by_scenario = {}
    for scenario in summary.scenarios:
        # A measure that no configuration has gets no row.
        rows = []
        for measure, (row, _, _) in ROWS.items():
            cells = []
            for estimates in summary.estimates.values():
                cells.append(_cell(estimates.get(scenario, {}).get(measure), measure))
            if cells != [Cell()] * len(cells):
                rows.append(Row(row.name, row.unit, cells))
        by_scenario[scenario] = [Table(columns, rows, title=scenario, caption=CAPTION)]
        # A second table compares the configurations, if there are several.
        lines = []
        for comparison in summary.comparisons:
            if comparison.scenario == scenario:
                name = f"{comparison.first} than {comparison.second}"
                cells = [Cell(words=comparison.verdict), _cell(comparison, comparison.measure)]
                lines.append(Row(name, ROWS[comparison.measure][0].heading, cells))
        if lines:
            table = Table(
                [Column("is", align="left"), Column("difference")],
                lines,
                title=f"{scenario}: better, worse, cannot tell",
                caption="paired bootstrap over the seeds and episodes that both have",
            )
            by_scenario[scenario].append(table)
    return by_scenario


def _matrix(results: Sequence[RunResult], scenario: str, measure: str) -> FloatArray:
    """Return a measure of some runs, (runs, episodes), NaN where there is no number; (runs, 0) if
    it was not measured.
    """
    rows = [result.flights.get(scenario, {}).get(measure, ()) for result in results]
    return np.array(rows, dtype=np.float64)


def _cell(estimate: Estimate | None, measure: str) -> Cell:
    _, factor, decimals = ROWS[measure]
    return estimate_cell(estimate, factor, decimals, none="")


def write_report(
    place: SweepFolder, summary: SweepResults, shown: Mapping[str, Sequence[Table]]
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
    plots = _curves(place, summary)
    if plots:
        parts.append(
            Section("curves", "Learning curves", "Mean over seeds, with their range.", [], plots)
        )
    runs = summary.sweep.runs
    configurations = {run.configuration for run in runs}
    facts = (
        f"{summary.finished} of {len(runs)} runs of {len(configurations)} configurations "
        "are finished."
    )
    return write_page(place.path, f"Sweep: {summary.sweep.spec.name}", facts, parts)


def _curves(place: SweepFolder, summary: SweepResults) -> list[Plot]:
    """Plot the evaluations along the way; of pipelines, one plot for each algorithm and environment
    of a stage.
    """
    # A run folder is <algo>/<Env>_<number>; its stages have curves of their own.
    curves: dict[str, dict[str, list[Curve]]] = {}
    for name, group in summary.groups.items():
        for result in group:
            for path in sorted((place.path / "runs" / result.name).glob("*/*/evaluations.npz")):
                kind = f"{path.parts[-3]} {path.parts[-2].rpartition('_')[0]}"
                curves.setdefault(kind, {}).setdefault(name, []).append(read_curve(path.parent))
    plots = []
    for number, (kind, groups) in enumerate(curves.items()):
        try:
            figure = plot_curves(groups, {}, kind)
        except ConfigError:
            # No evaluation of this kind has success or reward.
            continue
        caption = f"{kind}: success and reward along the training."
        plots.append(Plot(f"curves_{number}", caption, figure))
    return plots
