"""The results of a sweep: ``results.csv``, and the tables for the terminal."""

from pathlib import Path
from typing import TypeAlias

import numpy as np
import pandas as pd

from sb3_quad.base.files import write_text
from sb3_quad.base.types import StrDict
from sb3_quad.evaluation import metric_tables
from sb3_quad.evaluation.flights import Flights
from sb3_quad.evaluation.metric_tables import estimate_cell
from sb3_quad.evaluation.statistics import over_seeds
from sb3_quad.evaluation.tables import Column, Table

# The rows of the measures.
ROWS = {
    "success": metric_tables.SUCCESS,
    "survival": metric_tables.SURVIVAL,
    "reward": metric_tables.REWARD,
    "final_error": metric_tables.MEDIAN,
}
COMPARED = ("success", "reward")
CAPTION = (
    "means over n seeds, and differences of the seeds and episodes that both have; in brackets: "
    "95 % intervals, by a bootstrap over seeds and episodes"
)
# The levels that distinguish the rows of a table of episodes
LEVELS = ("configuration", "seed", "scenario", "episode")
RunFlights: TypeAlias = dict[tuple[str, int], StrDict]
"""By configuration and seed, by scenario and measure: a number for each episode, the same episodes
in every run. Success and survival are 0 or 1; reward is the sum; final_error is in m, NaN if it
crashed or left the range.
"""


def numbers(flights: Flights) -> StrDict:
    """Return the measures of all episodes."""
    measures = {name: getattr(flights, name).astype(np.float64) for name in ROWS}
    measures["final_error"][~flights.survival] = np.nan
    return measures


def write_results(folder: Path, runs: RunFlights) -> list[Table]:
    """Write ``results.csv``, a line for each run and scenario.

    :param runs: the finished runs, at least one.
    :return: a table for each scenario.
    :raises ConfigError: a folder that cannot be written, a full disk.
    """
    parts = {}
    for run in sorted(runs):
        for scenario, measures in runs[run].items():
            parts[(*run, scenario)] = pd.DataFrame(measures)
    flights = pd.concat(parts, names=LEVELS)
    by_run = flights.groupby(level=LEVELS[:3], sort=False)
    # All are means, except for the final error, which is a median.
    means = by_run.mean().assign(final_error=by_run["final_error"].median())
    write_text(folder / "results.csv", means.to_csv(float_format="%.9g"))
    tables = []
    for scenario, group in flights.groupby(level="scenario", sort=False):
        tables.append(compare(str(scenario), group.droplevel("scenario")))
    return tables


def compare(scenario: str, flights: pd.DataFrame) -> Table:
    """Return a table with a column for each configuration, and with the differences from the first.

    :param flights: the measures of ``ROWS`` by configuration, seed and episode.
    """
    columns = []
    for name, runs in flights.groupby(level="configuration", sort=False):
        columns.append(Column(f"{name} (n = {runs.index.unique('seed').size})"))
    rows = []
    for measure, row in ROWS.items():
        statistic = np.nanmedian if measure == "final_error" else np.nanmean
        cells = []
        differences = []
        for name in flights.index.unique("configuration"):
            # A row for each seed, a column for each episode.
            values = flights.loc[name, measure].unstack()
            cells.append(estimate_cell(row, over_seeds(values.to_numpy(), statistic)))
            if not differences:
                first = values
            paired = (values - first).dropna(how="all")
            differences.append(estimate_cell(row, over_seeds(paired.to_numpy())))
        rows.append(row._replace(cells=cells))
        if measure in COMPARED and len(columns) > 1:
            name = f"{row.name}, more than {columns[0].name}"
            rows.append(row._replace(name=name, cells=differences))
    return Table(columns, rows, title=scenario, caption=CAPTION)
