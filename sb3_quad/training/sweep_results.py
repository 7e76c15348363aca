"""The results of a sweep: ``results.csv``, and the tables of terminal and ``report.md``."""

from pathlib import Path
from typing import TypeAlias

import numpy as np
import pandas as pd

from sb3_quad.base.files import write_text
from sb3_quad.base.types import StrDict
from sb3_quad.evaluation import metric_tables
from sb3_quad.evaluation.flights import Flights
from sb3_quad.evaluation.metric_tables import estimate_text
from sb3_quad.evaluation.statistics import over_seeds
from sb3_quad.evaluation.tables import Table

# The rows of the measures.
ROWS = {
    "success": metric_tables.SUCCESS,
    "survival": metric_tables.SURVIVAL,
    "reward": metric_tables.REWARD,
    "final_error": metric_tables.MEDIAN,
}
# All are means, except for the final error, which is a median.
STATISTICS = {**dict.fromkeys(ROWS, "mean"), "final_error": "median"}
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
    """Return the measures of all episodes, NaN where there is no number."""
    final_error = np.where(flights.survival, flights.final_error, np.nan)
    return {
        "success": flights.success.tolist(),
        "survival": flights.survival.tolist(),
        "reward": flights.reward.tolist(),
        "final_error": final_error.tolist(),
    }


def write_results(folder: Path, runs: RunFlights) -> list[Table]:
    """Write ``results.csv``, a line for each run and scenario, and ``report.md``.

    :param runs: the finished runs, at least one.
    :return: the tables of the report.
    :raises ConfigError: a folder that cannot be written, a full disk.
    """
    parts = {}
    for run in sorted(runs):
        for scenario, measures in runs[run].items():
            # A row for each episode, NaN where there is no number.
            part = pd.DataFrame(measures, columns=[*ROWS], dtype=np.float64)
            parts[(*run, scenario)] = part
    flights = pd.concat(parts, names=LEVELS)
    means = flights.groupby(level=LEVELS[:3], sort=False).agg(STATISTICS)
    write_text(folder / "results.csv", means.to_csv(float_format="%.9g"))
    tables = []
    report = f"# {folder.name}\n"
    for scenario, group in flights.groupby(level="scenario", sort=False):
        table = compare(str(scenario), group.droplevel("scenario"))
        report += f"\n## {table.title}\n\n{table.markdown()}\n\n{table.caption}\n"
        tables.append(table)
    write_text(folder / "report.md", report)
    return tables


def compare(scenario: str, flights: pd.DataFrame) -> Table:
    """Return a table with a column for each configuration, and with the differences from the first.

    :param flights: the measures of ``ROWS`` by configuration, seed and episode.
    """
    columns = []
    for name, runs in flights.groupby(level="configuration", sort=False):
        columns.append(f"{name} (n = {runs.index.unique('seed').size})")
    rows = []
    for measure, row in ROWS.items():
        statistic = np.nanmedian if STATISTICS[measure] == "median" else np.nanmean
        cells = []
        differences = []
        first = None
        for _, runs in flights[measure].groupby(level="configuration", sort=False):
            # A row for each seed, a column for each episode.
            values = runs.droplevel("configuration").unstack()
            cells.append(estimate_text(row, over_seeds(values.to_numpy(), statistic)))
            if first is None:
                first = values
            paired = (values - first).dropna(how="all")
            differences.append(estimate_text(row, over_seeds(paired.to_numpy())))
        # No row for what the environment does not report.
        if {*cells} != {"–"}:
            rows.append([row.heading, *cells])
            if measure in COMPARED and len(columns) > 1:
                name = f"{row.name}, more than {columns[0]}"
                rows.append([row._replace(name=name).heading, *differences])
    return Table(["", *columns], rows, scenario, CAPTION)
