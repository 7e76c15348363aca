"""The results of a sweep: ``results.csv``, ``results.json``, and the tables of terminal and page.

Intervals are bootstraps over seeds and episodes. A resample takes as many seeds as there are, with
replacement, and as many episodes; the episodes are the same in every run, so that seeds and
episodes are crossed (Owen, The pigeonhole bootstrap, Annals of Applied Statistics 1, 2007). Few
seeds give intervals that are too narrow (Agarwal et al., Deep Reinforcement Learning at the Edge of
the Statistical Precipice, NeurIPS 2021): with one seed they cover the choice of episodes alone.
"""

import itertools
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sb3_quad.base import __version__
from sb3_quad.base.arrays import FloatArray
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import write_text
from sb3_quad.base.types import StrDict
from sb3_quad.base.validate import Frozen
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
COMPARED = (SUCCESS, REWARD)
CAPTION = "means over seeds; in brackets: 95 % intervals, by a bootstrap over seeds and episodes"
# The levels that tell apart the rows of a table of episodes.
LEVELS = ("configuration", "seed", "scenario", "episode")
COLUMNS = (
    *("run", "configuration", "seed", "state", "scenario", "episodes"),
    *MEASURES,
    *("timesteps", "agent", "weights", "message"),
)


class Comparison(Estimate):
    """The difference of two configurations, the first less the second."""

    scenario: str
    measure: str
    first: str
    second: str
    verdict: str
    """whether the first is better or worse"""


class ConfigurationResults(Frozen):
    """The results of the finished runs of a configuration."""

    seeds: list[int]
    scenarios: dict[str, dict[str, Estimate | None]] = {}
    """by scenario and measure; None: not measured"""


class SweepResults(Frozen):
    """The content of ``results.json``."""

    sweep: str | None
    package_version: str = __version__
    runs: int
    finished: int
    failed: dict[str, str]
    """by the name of a run, why it failed"""
    configurations: dict[str, ConfigurationResults]
    """only those that have finished runs"""
    comparisons: list[Comparison] = []


def write_results(
    place: SweepFolder, sweep: Sweep, results: Mapping[str, RunResult]
) -> SweepResults:
    """Write ``results.csv``, a line for each run and scenario, and ``results.json``.

    :param results: of all runs that ended, by name.
    :return: means, intervals and comparisons of all runs that are finished.
    :raises ConfigError: a folder that cannot be written, a full disk.
    """
    lines: list[StrDict] = []
    parts = {("", 0, ""): _episodes({})}
    # In the order of the plan, not in that in which runs ended.
    ended = [results[run.name] for run in sweep.runs if run.name in results]
    for result in ended:
        line = {"run": result.name, **result.model_dump(exclude={"flights"})}
        for scenario, measures in result.flights.items():
            part = _episodes(measures)
            parts[result.configuration, result.seed, scenario] = part
            statistics = {**part.mean(), ERROR: part[ERROR].quantile()}
            lines.append({**line, "scenario": scenario, "episodes": len(part), **statistics})
        # The table holds every run that ended, also those that failed.
        if not result.flights:
            lines.append(line)
    table = pd.DataFrame(lines, columns=COLUMNS)
    write_text(place.path / "results.csv", table.to_csv(index=False, float_format="%.9g"))
    configurations = {}
    finished = [result for result in ended if result.state == "finished"]
    for result in finished:
        entry = ConfigurationResults(seeds=[])
        configurations.setdefault(result.configuration, entry).seeds.append(result.seed)
    summary = SweepResults(
        sweep=sweep.spec.name,
        runs=len(sweep.runs),
        finished=len(finished),
        failed={result.name: result.message for result in ended if result.state == "failed"},
        configurations=configurations,
    )
    _estimate(summary, pd.concat(parts, names=LEVELS))
    write_text(place.path / "results.json", summary.model_dump_json(indent=1) + "\n")
    return summary


def _episodes(measures: Mapping[str, Sequence[float | None]]) -> Any:
    """Return a table with a row for each episode and a column for each measure, NaN where there is
    no number.
    """
    return pd.DataFrame(measures, columns=MEASURES, dtype=np.float64)


def _estimate(summary: SweepResults, flights: Any) -> None:
    """Add the means over seeds of all configurations, and compare all pairs of them.

    :param flights: a table of episodes by ``LEVELS``.
    """
    for scenario, group in flights.groupby(level="scenario", sort=False):
        names = group.index.unique("configuration")
        for measure in MEASURES:
            statistic = np.nanmedian if measure == ERROR else np.nanmean
            # A row for each run, a column for each episode.
            values = group[measure].unstack()
            for name in names:
                estimates = summary.configurations[name].scenarios.setdefault(scenario, {})
                estimates[measure] = over_seeds(values.loc[name].to_numpy(), statistic)
            if measure not in COMPARED:
                continue
            for first, second in itertools.combinations(names, 2):
                # Differences are paired: only the seeds that both have, and the same episodes.
                paired = (values.loc[first] - values.loc[second]).dropna(how="all")
                difference = over_seeds(paired.to_numpy())
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


def over_seeds(
    values: FloatArray, statistic: Callable[..., FloatArray] = np.nanmean
) -> Estimate | None:
    """Estimate the mean over seeds of a statistic of a run's episodes; of the difference of two
    configurations, a paired bootstrap.

    :param values: of a measure, (seeds, episodes), NaN without a number.
    :return: None if a run has no number at all, or if there is no run.
    """
    # Without a number from some run, there is no mean over seeds.
    if values.size == 0 or np.isnan(values).all(axis=1).any():
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
    value = float(statistic(values, axis=1).mean())
    low, high = np.nanpercentile(means, [2.5, 97.5])
    return Estimate(value=value, low=min(value, low), high=max(value, high), n=values.size)


def verdict(difference: Estimate) -> str:
    """Return whether the first of two is better or worse: whether the interval of the difference
    leaves out zero.
    """
    if difference.low > 0:
        return "better"
    return "worse" if difference.high < 0 else "cannot tell"


def tables(summary: SweepResults) -> dict[str, list[Table]]:
    """Return by scenario a table with a column for each configuration, and one that compares
    them.
    """
    entries = summary.configurations
    columns = []
    for name, entry in entries.items():
        seeds = "1 seed" if len(entry.seeds) == 1 else f"{len(entry.seeds)} seeds"
        columns.append(Column(f"{name} ({seeds})"))
    by_scenario: dict[str, list[Table]] = {}
    for scenario in itertools.chain.from_iterable(entry.scenarios for entry in entries.values()):
        # A measure that no configuration has gets no row.
        rows = []
        for measure, (row, _, _) in ROWS.items():
            cells = []
            for entry in entries.values():
                cells.append(_cell(entry.scenarios.get(scenario, {}).get(measure), measure))
            if any(cell.number for cell in cells):
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
    parts = []
    for scenario, flown in shown.items():
        parts.append(Section(f"scenario-{len(parts)}", scenario, "", flown, facts=flown[0].caption))
    plots = _curves(place, summary)
    if plots:
        description = "Mean over seeds, with their range."
        parts.append(Section("curves", "Learning curves", description, plots=plots))
    facts = f"{summary.finished} of {summary.runs} runs are finished."
    return write_page(place.path, f"Sweep: {summary.sweep}", facts, parts)


def _curves(place: SweepFolder, summary: SweepResults) -> list[Plot]:
    """Plot the evaluations along the way; of pipelines, one plot for each algorithm and environment
    of a stage.
    """
    # A run folder is <algo>/<Env>_<number>; its stages have curves of their own.
    curves: dict[str, dict[str, list[Curve]]] = {}
    for name, entry in summary.configurations.items():
        for seed in entry.seeds:
            folder = place.path / "runs" / name / f"seed_{seed}"
            for path in sorted(folder.glob("*/*/evaluations.npz")):
                kind = f"{path.parts[-3]} {path.parts[-2].rpartition('_')[0]}"
                curves.setdefault(kind, {}).setdefault(name, []).append(read_curve(path.parent))
    plots = []
    for kind, groups in curves.items():
        try:
            figure = plot_curves(groups, {}, kind)
        except ConfigError:
            # No evaluation of this kind has success or reward.
            continue
        caption = f"{kind}: success and reward along the training."
        plots.append(Plot(f"curves_{len(plots)}", caption, figure))
    return plots
