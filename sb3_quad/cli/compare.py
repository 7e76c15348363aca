"""Controllers on the same fresh episodes of a task, in a table."""

from collections.abc import Iterable, Mapping
from typing import Any

from sb3_quad.base.seeds import row_seeds, seed_for
from sb3_quad.cli.output import console
from sb3_quad.controllers.resolve import DEFAULT_EXPERT, resolve_expert
from sb3_quad.evaluation.flights import fly_settings
from sb3_quad.evaluation.metric_tables import CAPTION, metric_cells, metric_rows
from sb3_quad.evaluation.metrics import summarise
from sb3_quad.evaluation.scenarios.load import load_suite
from sb3_quad.evaluation.tables import Column, Table
from sb3_quad.simulation.settings import FlightSettings
from sb3_quad.training.job import TrainingJob

FRESH_EPISODES = 240
THESIS_VEHICLE = "itm"  # the thesis has no metrics of another one
SCENARIOS = {"target_tracking": "tracking", "state_recovery": "recovery"}  # of its suite, by task


def task_table(
    controllers: Mapping[str, Any], settings: FlightSettings, n: int, seed: int, beside: Iterable[str] = ()
) -> Table:
    """The table of some controllers over the same episodes of a task.

    :param settings: how all of them fly.
    :param n: how many episodes.
    :param beside: the columns of the thesis that stand beside them; none but of the vehicle that it flew.
    """
    seeds = row_seeds(seed, n)
    measured = [metric_cells(summarise(fly_settings(each, settings, seeds))) for each in controllers.values()]
    scenario = load_suite("thesis").scenario(SCENARIOS[settings.task])
    shown = [name for name in beside if name in scenario.reference and settings.vehicle == THESIS_VEHICLE]
    columns = [*map(Column, controllers), *(Column(name, source="thesis") for name in shown)]
    rows = metric_rows(scenario, measured, [scenario.reference[name] for name in shown])
    title = f"{settings.task}: {n} fresh episodes, the same for all" + ("" if settings.noise else ", true state")
    return Table(columns, rows, title=title, caption=CAPTION)


def print_tables(
    controllers: Mapping[str, Any], how: Mapping[str, Any], n: int, seed: int, beside: Iterable[str] = ()
) -> None:
    """Print a table as of :func:`task_table` for each task.

    :param how: the controllers fly in any task: vehicle, noise and scaling.
    """
    for task in SCENARIOS:
        console().print(task_table(controllers, FlightSettings(task=task, **how), n, seed, beside))


def agent_and_expert(job: TrainingJob, model: Any) -> Table:
    """The table of the agent of a job and of its expert over the same episodes, which no training has seen.

    :param job: of an environment of this package.
    """
    settings = job.flight_settings
    controllers = {"agent": model, "expert": resolve_expert(job.config.expert or DEFAULT_EXPERT, settings.vehicle)}
    agent = "IL-agent" if job.config.algo == "dagger" else "RL-agent"
    return task_table(controllers, settings, FRESH_EPISODES, seed_for("table", job.seed), (agent, "expert"))
