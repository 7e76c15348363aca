"""Which agent a run hands over: the best of its evaluations, and none below the one that it started
from.
"""

from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from sb3_quad.base.files import read_arrays
from sb3_quad.base.types import AnyArray, StrDict
from sb3_quad.callbacks.best_model import RATES, score
from sb3_quad.training.runs import RunFolder

# Two standard errors: chance alone exceeds them in one comparison of forty.
BEYOND_CHANCE = 2.0
# The array of each rate that a stage may require.
REQUIRED = {"success_rate": "successes", "survival_rate": "survivals"}


class HandOver(NamedTuple):
    """The agent that a run hands over.

    :param agent: its zip.
    :param rates: its rates by the names of ``REQUIRED``, where the environment reports them.
    :param reward: its mean reward as trained, where a wrapper changes the task's.
    :param is_start: whether no evaluation was better than that of the agent it started from.
    :param problem: how far the run ended below its start, if it did beyond chance; else empty.
    """

    agent: Path
    rates: dict[str, float]
    reward: float | None = None
    is_start: bool = False
    problem: str = ""


def hand_over(run: RunFolder, best_by: str, wanted: Literal["best", "last"] = "best") -> HandOver:
    """Return the agent that a finished run hands over, by its evaluations.

    :param best_by: what decides, as in the run's settings.
    :param wanted: ``last``: the last agent, unless it is below the start beyond chance.
    :raises ConfigError: evaluations that cannot be read.
    """
    if not run.evaluations.is_file():
        return HandOver(run.model, {})
    arrays = read_arrays(run.evaluations)
    rows: list[StrDict] = []
    for values in zip(*arrays.values(), strict=True):
        rows.append(dict(zip(arrays, values, strict=True)))
    scores = [score(row, RATES.get(best_by, "")) for row in rows]
    has_start = rows[0]["timesteps"] == 0
    problem = ""
    if has_start and is_below(rows[-1]["results"], rows[0]["results"]):
        rewards = [f"{np.mean(row['results']):.2f}" for row in (rows[-1], rows[0])]
        problem = "mean reward {} at the end, {} at the start".format(*rewards)
    if wanted == "last" and not problem:
        return HandOver(run.model, _rates(rows[-1]), _changed_reward(rows[-1]))
    best = scores.index(max(scores))
    is_start = has_start and best == 0
    return HandOver(
        run.best_model,
        _rates(rows[best]),
        _changed_reward(rows[best]),
        is_start,
        problem if is_start else "",
    )


def is_below(rewards: AnyArray, others: AnyArray) -> bool:
    """Whether rewards are below others of the same episodes, (n,) each, beyond chance."""
    differences = np.asarray(rewards) - np.asarray(others)
    error = 0.0
    if differences.size > 1:
        error = differences.std(ddof=1) / np.sqrt(differences.size)
    return bool(differences.mean() < -BEYOND_CHANCE * error)


def _rates(row: StrDict) -> dict[str, float]:
    rates = {name: float(np.mean(row.get(array, np.nan))) for name, array in REQUIRED.items()}
    return {name: rate for name, rate in rates.items() if np.isfinite(rate)}


def _changed_reward(row: StrDict) -> float | None:
    if not np.isfinite(row.get("task_results", np.nan)).all():
        return None
    return float(np.mean(row["results"]))
