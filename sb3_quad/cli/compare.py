"""Controllers on the same episodes of a task, in a table."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.table import Table

    from sb3_quad.training.job import TrainingJob

FRESH_EPISODES = 240
THESIS_VEHICLE = "itm"  # beside another one the thesis has no figures


def task_table(
    pilots: Mapping[str, Any], task: str, n_episodes: int, seed: int, title: str, beside: Iterable[str] = (), **keywords: Any
) -> Table:
    """The table of some controllers over the same episodes of a task.

    :param title: what follows the task's name and the number of fresh episodes.
    :param beside: the columns of the thesis that stand beside them.
    :param keywords: further arguments of :func:`~sb3_quad.evaluation.flights.fly`, such as ``vehicle``.
    """
    from sb3_quad.evaluation.flights import fly
    from sb3_quad.evaluation.summary import summarise
    from sb3_quad.evaluation.tables import TASK_SCENARIOS, comparison
    from sb3_quad.scenarios.load import load_suite

    columns = {name: summarise(fly(pilot, task, n_episodes, seed, **keywords)) for name, pilot in pilots.items()}
    scenario = load_suite("thesis").scenario(TASK_SCENARIOS[task])
    return comparison(f"{task}: {n_episodes} fresh episodes, {title}", columns, scenario, beside)


def agent_and_expert(job: TrainingJob, model: Any) -> Table:
    """The table of the agent of a job and of its expert over the same episodes, which no training has seen.

    :param job: of an environment of this package.
    """
    from sb3_quad.experts.resolve import resolve_expert
    from sb3_quad.training.trainer import FRESH_SEED, for_evaluation

    config = for_evaluation(job)
    given = config.env_kwargs
    keywords: dict[str, Any] = dict(config.flight_kwargs)
    if "task_kwargs" in given:
        keywords["task_kwargs"] = given["task_kwargs"]
    if "max_episode_steps" in given:
        keywords["max_steps"] = given["max_episode_steps"]
    expert = resolve_expert(config.expert or "pid", keywords.get("vehicle", "itm"))
    pilots = {"agent": model, "expert": expert}
    agent = "IL-agent" if config.algo == "dagger" else "RL-agent"
    beside = (agent, "expert") if keywords.get("vehicle", THESIS_VEHICLE) == THESIS_VEHICLE else ()
    seed = job.seed + FRESH_SEED
    return task_table(pilots, str(config.task), FRESH_EPISODES, seed, "the same for both", beside, **keywords)
