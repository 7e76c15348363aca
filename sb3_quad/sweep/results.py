"""The results of a sweep: ``results.csv``, ``results.json``, and the tables of terminal and page.

Intervals are bootstraps over seeds and episodes. A resample draws as many seeds as there are, with
replacement, and as many episodes; the episodes are the same in every run, so seeds and episodes are
crossed (Owen, The pigeonhole bootstrap, Annals of Applied Statistics 1, 2007). Few seeds lead to
intervals that are too narrow (Agarwal et al., Deep Reinforcement Learning at the Edge of the
Statistical Precipice, NeurIPS 2021): with one seed they cover only the choice of episodes.
"""

import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from itertools import combinations
from pathlib import Path

import numpy as np
import pandas as pd

from sb3_quad.base import __version__
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import write_text
from sb3_quad.base.types import FloatArray, StrDict
from sb3_quad.base.validate import Frozen
from sb3_quad.evaluation import metric_tables
from sb3_quad.evaluation.learning_curves import Curve, read_curve
from sb3_quad.evaluation.metric_tables import estimate_cell
from sb3_quad.evaluation.plots import plot_curves, save_figure
from sb3_quad.evaluation.statistics import RESAMPLES, Estimate
from sb3_quad.evaluation.tables import Cell, Column, Row, Table
from sb3_quad.sweep.folder import RunResult, Sweep

# The rows of the measures.
ROWS = {
    "success": metric_tables.SUCCESS,
    "survival": metric_tables.SURVIVAL,
    "reward": metric_tables.REWARD,
    "final_error": metric_tables.MEDIAN,
    "time": Row("mean time until there, or stable", "s"),
}
COMPARED = ("success", "reward")
CAPTION = "means over n seeds; in brackets: 95 % intervals, by a bootstrap over seeds and episodes"
PAIRED = "paired bootstrap over the seeds and episodes that both have"
# The levels that distinguish the rows of a table of episodes
LEVELS = ("configuration", "seed", "scenario", "episode")
COLUMNS = (
    *("run", "configuration", "seed", "state", "scenario", "episodes"),
    *ROWS,
    *("timesteps", "agent", "message"),
)


class SweepResults(Frozen):
    """The content of ``results.json``."""

    sweep: str | None
    package_version: str = __version__
    runs: int
    finished: int
    failed: dict[str, str]
    """why a run failed, by its name"""
    configurations: dict[str, list[int]]
    """the seeds of a configuration's finished runs, if it has any, by its name"""
    estimates: list[StrDict] = []
    """means over the finished runs of a configuration, by scenario and measure: fields of Estimate
    """
    comparisons: list[StrDict] = []
    """differences of two configurations, the first minus the second: fields of Estimate, and as
    verdict whether the first is better or worse
    """


def write_results(
    folder: Path, sweep: Sweep, results: Mapping[str, RunResult]
) -> tuple[SweepResults, list[Table]]:
    """Write ``results.csv``, a line for each run and scenario, ``results.json``, and the report.

    :param results: results of all runs that ended, by name.
    :return: means, intervals and comparisons of all runs that are finished, and their tables.
    :raises ConfigError: a folder that cannot be written, a full disk.
    """
    lines = []
    parts = {}
    failed = {}
    configurations: dict[str, list[int]] = {}
    # In the order of the plan, not in that of the ends of runs.
    for run in sweep.runs:
        if run.name not in results:
            continue
        result = results[run.name]
        line = {"run": run.name, **dict(run), **dict(result)}
        # The table has every run that ended, even if it failed.
        if result.state == "failed":
            failed[run.name] = result.message
            lines.append(line)
            continue
        configurations.setdefault(run.configuration, []).append(run.seed)
        for scenario, measures in result.flights.items():
            # A row for each episode, NaN where there is no number.
            part = pd.DataFrame(measures, columns=[*ROWS], dtype=np.float64)
            parts[run.configuration, run.seed, scenario] = part
            line |= {"scenario": scenario, "episodes": len(part), **part.mean()}
            # All are means, except for the final error, which is a median.
            lines.append({**line, "final_error": part["final_error"].quantile()})
    write_text(
        folder / "results.csv",
        pd.DataFrame(lines, columns=COLUMNS).to_csv(index=False, float_format="%.9g"),
    )
    summary = SweepResults(
        sweep=sweep.spec.name,
        runs=len(sweep.runs),
        finished=sum(map(len, configurations.values())),
        failed=failed,
        configurations=configurations,
    )
    tables = []
    if parts:
        tables = _compare(summary, pd.concat(parts, names=LEVELS))
        _write_report(folder, summary, tables, _curves(folder, sweep, results))
    write_text(folder / "results.json", summary.model_dump_json(indent=1) + "\n")
    return summary, tables


def _compare(summary: SweepResults, flights: pd.DataFrame) -> list[Table]:
    """Add the means over seeds of all configurations, and compare all pairs of them.

    :param flights: a table of episodes by ``LEVELS``.
    :return: for each scenario a table with a column for each configuration, and a last one that
        compares them.
    """
    columns = [
        Column(f"{name} (n = {len(seeds)})") for name, seeds in summary.configurations.items()
    ]
    tables = []
    comparisons = []
    for scenario, group in flights.groupby(level="scenario", sort=False):
        rows = []
        for measure, row in ROWS.items():
            key = {"scenario": scenario, "measure": measure}
            statistic = np.nanmedian if measure == "final_error" else np.nanmean
            values = group[measure].unstack()
            runs = {}
            cells = []
            for name in summary.configurations:
                # A row for each run, a column for each episode.
                runs[name] = values.query("configuration == @name").droplevel(0)
                mean = over_seeds(runs[name].to_numpy(), statistic)
                cells.append(estimate_cell(row, mean))
                if mean is not None:
                    summary.estimates.append({**dict(mean), **key, "configuration": name})
            # No row for what the environment does not report.
            if any(cell.ends for cell in cells):
                rows.append(row._replace(cells=cells))
            if measure not in COMPARED:
                continue
            for first, second in combinations(runs, 2):
                # Differences are paired: only seeds that both have, and the same episodes.
                paired = (runs[first] - runs[second]).dropna(how="all")
                difference = over_seeds(paired.to_numpy())
                if difference is not None:
                    key |= {"first": first, "second": second, "verdict": verdict(difference)}
                    summary.comparisons.append({**dict(difference), **key})
                    cells = [Cell(words=key["verdict"]), estimate_cell(row, difference)]
                    comparisons.append(
                        Row(f"{scenario}, {row.heading}: {first} than {second}", cells=cells)
                    )
        tables.append(Table(columns, rows, title=scenario, caption=CAPTION))
    # There are comparisons if there are several configurations.
    if comparisons:
        columns = [Column("is", align="left"), Column("difference")]
        tables.append(
            Table(columns, comparisons, title="better, worse, cannot tell", caption=PAIRED)
        )
    return tables


def over_seeds(
    values: FloatArray, statistic: Callable[..., FloatArray] = np.nanmean
) -> Estimate | None:
    """Estimate the mean over seeds of a statistic of a run's episodes; for the difference of two
    configurations, this is a paired bootstrap.

    :param values: values of a measure, (seeds, episodes), NaN without a number.
    :return: None if a run has no number at all, or if there is no run.
    """
    # Without a number from some run, there is no mean over seeds.
    if values.size == 0 or np.isnan(values).all(axis=1).any():
        return None
    # The same resamples each time, so that equal values yield equal intervals.
    random = np.random.default_rng(0)
    seeds, episodes = (random.integers(0, n, (RESAMPLES, n)) for n in values.shape)
    with warnings.catch_warnings():
        # A resample may miss the few episodes that have a number.
        warnings.simplefilter("ignore", RuntimeWarning)
        # (resamples, seeds)
        runs = np.stack([statistic(row[episodes], axis=1) for row in values], axis=1)
        means = np.nanmean(np.take_along_axis(runs, seeds, axis=1), axis=1)
    # The interval includes the value, even if every resample misses it.
    value = float(statistic(values, axis=1).mean())
    low, high = np.nanpercentile(means, [2.5, 97.5])
    return Estimate(value=value, low=min(value, low), high=max(value, high), n=values.size)


def verdict(difference: Estimate) -> str:
    """Return whether the first of two is better or worse, which it is if the interval of the
    difference excludes zero.
    """
    if difference.low > 0:
        return "better"
    if difference.high < 0:
        return "worse"
    return "cannot tell"


def _curves(folder: Path, sweep: Sweep, results: Mapping[str, RunResult]) -> dict[str, list[Curve]]:
    """Read the learning curves of the finished runs, by configuration; for pipelines, those of the
    last stage.
    """
    curves: dict[str, list[Curve]] = {}
    for run in sweep.runs:
        if run.name not in results or results[run.name].state == "failed":
            continue
        stage = (folder / "runs" / run.name / results[run.name].agent).parent
        # A run without evaluations has no curve.
        if (stage / "evaluations.npz").is_file():
            curves.setdefault(run.configuration, []).append(read_curve(stage))
    return curves


def _write_report(
    folder: Path,
    summary: SweepResults,
    tables: Sequence[Table],
    curves: Mapping[str, Sequence[Curve]],
) -> None:
    """Write ``report.md`` of the finished runs, and their learning curves as a picture."""
    parts = [
        f"# Sweep: {summary.sweep}",
        f"{summary.finished} of {summary.runs} runs are finished.",
    ]
    for table in tables:
        parts += [f"## {table.title}", table.markdown(), table.caption]
    if curves:
        # A third-party environment may report neither success nor reward.
        with suppress(ConfigError):
            save_figure(plot_curves(curves), folder / "curves.png")
            parts.append("![learning curves](curves.png)")
    write_text(folder / "report.md", "\n\n".join(parts) + "\n")
