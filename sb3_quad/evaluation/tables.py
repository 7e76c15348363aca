"""Tables of flights: one column per pilot, and the thesis's figures beside them."""

from __future__ import annotations

import math
from collections.abc import Mapping

from rich.table import Table

from sb3_quad.evaluation.flights import TOLERANCES
from sb3_quad.evaluation.summary import Summary

SUCCESS, REWARD, PATH, MEDIAN, LARGEST = "success", "mean reward", "mean path", "final error, median", "final error, largest"


def time_row(tolerance: float) -> str:
    """The name of the row with the time to a tolerance."""
    return f"mean time to {tolerance:g} m"


# What the thesis measured (4.2.3, 4.3.1, 4.3.2), by task and pilot.
THESIS: Mapping[str, Mapping[str, Mapping[str, str]]] = {
    "target_tracking": {
        "expert": {SUCCESS: "100 %", REWARD: "-7.84", time_row(0.1): "7.75 s", PATH: "10.49 m"},
        "IL-agent": {REWARD: "-8.23", time_row(0.1): "never", PATH: "11.76 m"},
        "RL-agent": {REWARD: "-7.76", PATH: "10.61 m"},
    },
    "state_recovery": {
        "expert": {SUCCESS: "29.48 %"},
        "RL-agent": {SUCCESS: "88.25 %"},
        "PPO only": {SUCCESS: "82.5 %"},
    },
}


def rows(summary: Summary) -> dict[str, str]:
    """The figures of a summary as text, by the names of the rows."""
    cells = {SUCCESS: _percent(summary.success_rate), REWARD: f"{summary.mean_reward:.2f}"}
    for tolerance, (seconds, share) in summary.time_to.items():
        cells[time_row(tolerance)] = (
            "never" if share == 0 else f"{seconds:.2f} s" + ("" if share == 1 else f" ({_percent(share)} of flights)")
        )
    cells[PATH] = _metres(summary.mean_path, 2)
    cells[MEDIAN] = _metres(summary.median_final_error, 3)
    cells[LARGEST] = _metres(summary.max_final_error, 3)
    return cells


def comparison(title: str, columns: Mapping[str, Summary], thesis: Mapping[str, Mapping[str, str]] | None = None) -> Table:
    """A table of pilots side by side.

    :param columns: from the name of each pilot to its figures.
    :param thesis: columns of the thesis to put beside, from ``THESIS[task]``.
    """
    table = Table(title=title, title_justify="left")
    table.add_column("")
    cells = {name: rows(summary) for name, summary in columns.items()}
    cells |= {f"thesis: {name}": dict(figures) for name, figures in (thesis or {}).items()}
    for name in cells:
        table.add_column(name, justify="right")
    names = [SUCCESS, REWARD, *(time_row(tolerance) for tolerance in TOLERANCES), PATH, MEDIAN, LARGEST]
    if all(_starts_there(summary) for summary in columns.values()):
        names = [SUCCESS, REWARD, MEDIAN, LARGEST]  # where an episode starts at its target there is no way to it
    for row in names:
        table.add_row(row, *(column.get(row, "") for column in cells.values()))
    return table


def _starts_there(summary: Summary) -> bool:
    return all(seconds == 0.0 and share == 1.0 for seconds, share in summary.time_to.values())


def _percent(share: float) -> str:
    return f"{100 * share:.2f}".rstrip("0").rstrip(".") + " %"


def _metres(value: float, digits: int) -> str:
    return "" if math.isnan(value) else f"{value:.{digits}f} m"
