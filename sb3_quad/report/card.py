"""The card of a trained policy: what was measured, how it was made, how it is loaded; in Markdown, as model hubs show it."""

from collections.abc import Mapping
from typing import Any

import jinja2

from sb3_quad.base.seeds import seed_for
from sb3_quad.evaluation.flights import Flights, fly
from sb3_quad.evaluation.metric_tables import MEDIAN, QUANTILE, REWARD, SUCCESS, SURVIVAL, metric_cells, time_row
from sb3_quad.evaluation.metrics import Metrics, summarise
from sb3_quad.evaluation.tables import Cell, Column, Row, Table, text_table
from sb3_quad.simulation.frames import ObservationSettings
from sb3_quad.simulation.settings import in_words

N_RECOVERIES = 4  # times as many recoveries as targets at each distance
DISTANCES = (10.0, 15.0, 20.0)  # m
RECOVERY, NEAR = "state recovery", time_row(0.1)
SHOWN = (SUCCESS, SURVIVAL, REWARD, NEAR, MEDIAN, QUANTILE)


def measure(policy: Any, n_episodes: int, **settings: Any) -> dict[str, Metrics]:
    """The rows of the table, by name: recoveries, then targets at each distance.

    :param n_episodes: at each distance.
    :param settings: ``vehicle``, ``noise`` and ``observation_std``, as :func:`~sb3_quad.evaluation.flights.fly` takes them.
    """
    parts = [fly(policy, "state_recovery", n_episodes, seed_for("card", k), **settings) for k in range(N_RECOVERIES)]
    rows = {RECOVERY: summarise(Flights.concatenate(parts))}
    for distance in DISTANCES:
        task = {"target_distance": distance}
        seed = seed_for("card", int(1000 * distance))
        flown = fly(policy, "target_tracking", n_episodes, seed, task_kwargs=task, **settings)
        rows[f"targets {distance:.0f} m away"] = summarise(flown)
    return rows


def write_card(
    name: str, measured: Mapping[str, Metrics], command: str, facts: Mapping[str, str], settings: Mapping[str, Any]
) -> str:
    """The card of a policy, Markdown.

    :param measured: what :func:`measure` gave with ``settings``.
    :param command: what was typed to train it.
    :param facts: further rows on its training, such as seed, commit and versions.
    """
    rows = []
    for task, metrics in measured.items():
        cells = dict(metric_cells(metrics))
        if task == RECOVERY:  # begins at its target
            cells[NEAR] = Cell(words="–")
        rows.append(Row(task, "", [cells[row] for row in SHOWN]))
    columns = [Column(row.heading) for row in SHOWN]
    seen = ObservationSettings.model_validate(
        {key: settings[key] for key in ObservationSettings.model_fields if key in settings}
    )
    loader = jinja2.PackageLoader("sb3_quad.report", "templates")
    options: Any = {"undefined": jinja2.StrictUndefined, "keep_trailing_newline": True}
    template = jinja2.Environment(loader=loader, **options).get_template("card.md.j2")
    return template.render(
        name=name,
        frames=", ".join(f"{key}={value!r}" for key, value in seen.model_dump(exclude_defaults=True).items()),
        vehicle=f"the vehicle `{settings['vehicle']}`" if settings.get("vehicles") is None else str(settings["vehicles"]),
        noise=in_words(settings["noise"]),
        recoveries=f"{measured[RECOVERY].n:,}",
        targets=f"{next(metrics.n for task, metrics in measured.items() if task != RECOVERY):,}",
        table=Table(columns, rows).markdown(),
        command=command,
        facts=text_table("", ("", ""), facts.items()).markdown(),
    )
