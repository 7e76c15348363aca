"""Controllers on the same fresh episodes of a task, in one table."""

from collections.abc import Iterable, Mapping
from typing import Any

from sb3_quad.base.seeds import row_seeds
from sb3_quad.evaluation.flights import fly_settings
from sb3_quad.evaluation.metric_tables import CAPTION, metric_cells, metric_rows
from sb3_quad.evaluation.metrics import summarise
from sb3_quad.evaluation.scenarios.load import load_suite
from sb3_quad.evaluation.tables import Column, Table
from sb3_quad.simulation.settings import FlightSettings
from sb3_quad.simulation.tasks import in_words

THESIS_VEHICLE = "itm"  # the thesis has no metrics of another one
SCENARIOS = {"target_tracking": "tracking", "state_recovery": "recovery"}  # of its suite, by task


def task_table(
    controllers: Mapping[str, Any],
    settings: FlightSettings,
    n: int,
    seed: int,
    thesis_columns: Iterable[str] = (),
) -> Table:
    """The table of some controllers over the same episodes of a task.

    :param settings: how all of them fly.
    :param n: how many episodes.
    :param thesis_columns: columns of the thesis to add if they fly the thesis's vehicle.
    """
    seeds = row_seeds(seed, n)
    measured = [
        metric_cells(summarise(fly_settings(each, settings, seeds)))
        for each in controllers.values()
    ]
    task = in_words(settings.task)
    scenario = load_suite("thesis").scenario(
        SCENARIOS.get(task, SCENARIOS["target_tracking"])
    )  # whose rows others have, too
    of_thesis = task in SCENARIOS and settings.vehicle == THESIS_VEHICLE
    shown = [name for name in thesis_columns if of_thesis and name in scenario.reference]
    columns = [*map(Column, controllers), *(Column(name, source="thesis") for name in shown)]
    rows = metric_rows(scenario, measured, [scenario.reference[name] for name in shown])
    title = f"{task}: {n} fresh episodes, the same for all" + (
        "" if settings.noise else ", true state"
    )
    return Table(columns, rows, title=title, caption=CAPTION)
