"""The results of a sweep: ``results.csv``, and the table for the terminal."""

from pathlib import Path
from typing import TypeAlias

import numpy as np
import pandas as pd

from sb3_quad.base.files import write_text
from sb3_quad.base.types import StrDict
from sb3_quad.evaluation import metric_tables
from sb3_quad.evaluation.flights import Flights
from sb3_quad.evaluation.metric_tables import Row, estimate_text
from sb3_quad.evaluation.statistics import over_seeds
from sb3_quad.evaluation.tables import Table

ROWS = {
    "success": metric_tables.SUCCESS,
    "survival": metric_tables.SURVIVAL,
    "reward": metric_tables.REWARD,
    "final_error": Row("mean final error", "m", decimals=3),
}
CAPTION = "means; in brackets: 95 % intervals, by a bootstrap over seeds and episodes"
# The levels that distinguish the rows of a table of episodes
LEVELS = ("configuration", "seed", "scenario", "episode")
RunFlights: TypeAlias = dict[tuple[str, int], StrDict]
"""By configuration and seed, by scenario and measure: a number for each episode, the same episodes
in every run. Success and survival are 0 or 1; reward is the sum; final_error is in m, NaN if it
crashed or left the range.
"""


def numbers(flights: Flights) -> StrDict:
    """Return the measures of all episodes."""
    measures = {name: getattr(flights, name).tolist() for name in ROWS}
    measures["final_error"] = np.where(flights.survival, flights.final_error, np.nan).tolist()
    return measures


def write_results(folder: Path, runs: RunFlights) -> Table:
    """Write ``results.csv``, a line for each run and scenario.

    :param runs: the finished runs, at least one.
    :return: a column for each configuration, rows for each scenario.
    :raises ConfigError: a folder that cannot be written, a full disk.
    """
    parts = {}
    for run in sorted(runs):
        for scenario, measures in runs[run].items():
            # Ray stores NaN as null.
            parts[(*run, scenario)] = pd.DataFrame(measures, dtype=np.float64)
    flights = pd.concat(parts, names=LEVELS)
    means = flights.groupby(level=LEVELS[:3], sort=False).mean()
    write_text(folder / "results.csv", means.to_csv(float_format="%.9g"))
    rows = []
    for scenario, group in flights.groupby(level="scenario", sort=False):
        for measure, row in ROWS.items():
            # A row for each run, a column for each episode.
            values = group[measure].unstack("episode")
            cells = []
            for _, runs_of_one in values.groupby(level="configuration", sort=False):
                cells.append(estimate_text(row, over_seeds(runs_of_one.to_numpy())))
            rows.append([f"{scenario}: {row.heading}", *cells])
    names = flights.index.unique("configuration")
    return Table(["", *map(str, names)], rows, caption=CAPTION)
