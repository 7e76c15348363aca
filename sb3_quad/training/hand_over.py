"""Which agent a run hands over: the best of its evaluations, and none below the one that it started
from.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from sb3_quad.base.types import AnyArray, StrDict
from sb3_quad.callbacks.best_model import RATES, read_rows, score
from sb3_quad.training.runs import RunFolder

# Standard errors: chance alone exceeds two in one comparison of forty.
BEYOND_CHANCE = 2.0


class HandOver(NamedTuple):
    """The agent that a run hands over.

    :param agent: its zip.
    :param row: its evaluation, as arrays by name; empty without one.
    :param is_start: whether no evaluation was better than that of the agent it started from.
    :param problem: how the run ended below its start, if it did beyond chance; else empty.
    """

    agent: Path
    row: StrDict
    is_start: bool = False
    problem: str = ""


def hand_over(run: RunFolder, best_by: str, wanted: str = "best") -> HandOver:
    """Return the agent that a finished run hands over, by its evaluations.

    :param best_by: what decides, as in the run's settings.
    :param wanted: ``best``; or ``last``: the last agent, unless it is below the start.
    :raises ConfigError: evaluations that cannot be read.
    """
    if not run.evaluations.is_file():
        return HandOver(run.model, {})
    rows = read_rows(run.evaluations)
    start, last = rows[0], rows[-1]
    has_start = start["timesteps"] == 0
    is_lower = has_start and is_below(last["results"], start["results"])
    if wanted == "last" and not is_lower:
        return HandOver(run.model, last)
    scores = [score(row, RATES.get(best_by, "")) for row in rows]
    best = scores.index(max(scores))
    if best > 0 or not has_start:
        return HandOver(run.best_model, rows[best])
    end, before = np.mean(last["results"]), np.mean(start["results"])
    problem = f"mean reward {end:.2f} at its end, {before:.2f} at its start" if is_lower else ""
    return HandOver(run.best_model, start, is_start=True, problem=problem)


def is_below(rewards: AnyArray, others: AnyArray) -> bool:
    """Whether rewards are below others of the same episodes, (n,) each, beyond chance."""
    differences = rewards - others
    # One episode has no deviation, and counts as it is.
    error = differences.std(ddof=1) / np.sqrt(len(differences)) if len(differences) > 1 else 0.0
    return bool(differences.mean() < -BEYOND_CHANCE * error)
