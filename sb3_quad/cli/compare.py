"""Controllers on the same episodes of a task, in a table."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sb3_quad.evaluation.tables import Table
    from sb3_quad.training.job import TrainingJob

FRESH_EPISODES = 240
THESIS_VEHICLE = "itm"  # the thesis has no metrics of another one


def task_table(
    controllers: Mapping[str, Any], task: str, n: int, seed: int, title: str, beside: Iterable[str] = (), **keywords: Any
) -> Table:
    """The table of some controllers over the same episodes of a task.

    :param n: how many episodes.
    :param title: what follows the task's name and the number of fresh episodes.
    :param beside: the columns of the thesis that stand beside them.
    :param keywords: further arguments of :func:`~sb3_quad.evaluation.flights.fly`, such as ``vehicle``.
    """
    from sb3_quad.evaluation.metric_tables import TASK_SCENARIOS, comparison
    from sb3_quad.evaluation.summary import fly_all
    from sb3_quad.scenarios.load import load_suite

    columns = fly_all(controllers, task, n, seed, **keywords)
    scenario = load_suite("thesis").scenario(TASK_SCENARIOS[task])
    return comparison(f"{task}: {n} fresh episodes, {title}", columns, scenario, beside)


def agent_and_expert(job: TrainingJob, model: Any) -> Table:
    """The table of the agent of a job and of its expert over the same episodes, which no training has seen.

    :param job: of an environment of this package.
    """
    from sb3_quad.base.seeds import seed_for
    from sb3_quad.experts.resolve import resolve_expert
    from sb3_quad.training.trainer import for_evaluation

    config = for_evaluation(job)
    keywords: dict[str, Any] = dict(config.flight_kwargs)
    for given, name in (("task_kwargs", "task_kwargs"), ("max_episode_steps", "max_steps")):
        if given in config.env_kwargs:
            keywords[name] = config.env_kwargs[given]
    expert = resolve_expert(config.expert or "pid", keywords.get("vehicle", "itm"))
    controllers = {"agent": model, "expert": expert}
    agent = "IL-agent" if config.algo == "dagger" else "RL-agent"
    beside = (agent, "expert") if keywords.get("vehicle", THESIS_VEHICLE) == THESIS_VEHICLE else ()
    seed = seed_for("table", job.seed)
    return task_table(controllers, str(config.task), FRESH_EPISODES, seed, "the same for both", beside, **keywords)
