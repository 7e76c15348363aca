"""Controllers on the same episodes of some tasks, in one table for each task."""

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Group

from sb3_quad.agents.resolve import resolve_expert
from sb3_quad.algorithms.labelling import action_of
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.seeds import seed_for
from sb3_quad.base.types import StrDict, StrMapping
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.simulation.tasks import Task, in_words
from sb3_quad.envs.vehicles.vehicle import first_vehicle, load_vehicle
from sb3_quad.evaluation.controllers import known_settings
from sb3_quad.evaluation.flights import episode_seeds, fly_settings, warn_of_differences
from sb3_quad.evaluation.metric_tables import CAPTION, metric_cells, metric_rows
from sb3_quad.evaluation.metrics import Metrics, summarise
from sb3_quad.evaluation.scenarios import THESIS_SCENARIOS
from sb3_quad.evaluation.scenarios.load import load_suite
from sb3_quad.evaluation.scenarios.scenario import Suite
from sb3_quad.evaluation.tables import Table

THESIS_VEHICLE = "itm"  # the thesis has metrics of no other one


class Comparison(dict[str, dict[str, Metrics]]):
    """The metrics by label and task; ``str``, ``rich`` and notebooks show them as tables.

    ``tables`` has the table of each task.
    """

    tables: list[Table]

    def __str__(self) -> str:
        return "\n".join(map(str, self.tables))

    def __rich__(self) -> Group:
        return Group(*self.tables)

    def _repr_markdown_(self) -> str:
        # Notebooks render this; a table in Markdown has no title.
        return "\n\n".join(f"**{table.title}**\n\n{table.markdown()}" for table in self.tables)


def compare(
    controllers: StrMapping,
    tasks: Any = ("target_tracking", "state_recovery"),
    n_episodes: int = 240,
    seed: int | None = None,
    thesis_columns: Sequence[str] = (),
    **env_kwargs: Any,
) -> Comparison:
    """Fly several controllers through the same episodes of some tasks and compare their metrics.

    Each agent flies as it was trained: with the vehicle, the noise and the observation that its zip
    or ``model.flight_settings`` names. Experts, functions and agents that name none fly the vehicle
    and the noise of the first agent that names them. Experts see the true state. A warning names
    those that fly another vehicle than they know.

    >>> from sb3_quad.evaluation.compare import compare
    >>> result = compare({"PID": "pid", "agent": "itm-recovery"}, ["state_recovery"], n_episodes=48)
    >>> result["agent"]["state_recovery"].survival.value
    1.0
    >>> print(result)  # doctest: +SKIP
    state_recovery: 48 fresh episodes, the same for all
    ┏━━━━━━━━━━━━━┳━━━━━━━━━━━━━━━━━━━━━┳━━━━━━━━━━━━━━━━━━━━━━━┓
    ┃             ┃                 PID ┃                 agent ┃
    ...

    :param controllers: controllers by label: the name of an expert (``"pid"``) or of an agent that
        comes with the package (``"itm-robust"``), the path of a zip, ``"package.module:factory"``,
        an SB3 model, an expert, or a function from observations (n, 18) to actions (n, 4).
    :param tasks: names,
        :class:`~sb3_quad.envs.simulation.tasks.Task` or mixtures ``{name: weight}``, or
        only one of these.
    :param n_episodes: episodes of each task.
    :param seed: seed of the episodes, as for :func:`~sb3_quad.evaluation.flights.fly`; None: one
        that no training flies.
    :param thesis_columns: columns of the thesis to add if its vehicle flies one of its tasks:
        ``"expert"``, ``"IL-agent"``, ``"RL-agent"``.
    :param env_kwargs: fields of
        :class:`~sb3_quad.envs.simulation.settings.FlightSettings` that apply to all
        controllers, such as ``vehicle`` or ``noise``.
    :return: ``result[label][task]`` are :class:`~sb3_quad.evaluation.metrics.Metrics`, each with
        its 95 % interval; ``print(result)`` shows the tables.
    :raises ConfigError: no controllers, an unknown name or keyword, several tasks of one name, a
        zip that cannot be read.
    :raises ControllerError: a controller that fails in flight.
    """
    if not isinstance(controllers, Mapping) or not controllers:
        raise ConfigError(
            "compare: give a mapping of labels to controllers, such as {'PID': 'pid'}"
        )
    if isinstance(tasks, (str, Mapping, Task)):
        tasks = [tasks]
    names = [in_words(task) for task in tasks]
    if len({*names}) < len(names):
        raise ConfigError(f"compare: tasks {', '.join(names)}: name each differently")
    if seed is None:
        seed = seed_for("table")
    seeds = episode_seeds(seed, n_episodes)
    suite = load_suite("thesis")
    settings, pilots = _load(controllers, env_kwargs)
    for label, how in settings.items():
        warn_of_differences(label, pilots[label], how)

    comparison = Comparison()
    comparison.tables = []
    for name, task in zip(names, tasks, strict=True):
        metrics = {}
        for label, own in settings.items():
            how = own.with_changes(task=task)
            metrics[label] = summarise(fly_settings(pilots[label], how, seeds))
            comparison.setdefault(label, {})[name] = metrics[label]
        comparison.tables.append(
            _task_table(name, metrics, settings, suite, thesis_columns, n_episodes)
        )
    return comparison


def _load(
    controllers: StrMapping, env_kwargs: StrMapping
) -> tuple[dict[str, FlightSettings], StrDict]:
    """Return the flight settings of each controller, except for the task, and the controllers."""
    shared: StrDict = {}
    own = {}
    pilots = {}
    for label, controller in controllers.items():
        action = env_kwargs.get("action", "thrusts")
        vehicle = env_kwargs.get("vehicle", "itm")
        pilot = resolve_expert(controller, vehicle, "controller", action=action)
        known = known_settings(controller, pilot)
        if known is None:
            continue
        pilots[label] = pilot
        # On another vehicle, the agent still has its rotors where it knows them.
        own[label] = {**known.in_any_task(), "rotor_layout": known.layout}
        # The first agent decides for all controllers that do not say how they fly.
        if not shared:
            names = ("vehicle", "vehicles", "noise", "action")
            shared = {name: getattr(known, name) for name in names}
    settings = {}
    for label, controller in controllers.items():
        given = own.get(label, shared)
        action = action_of(controller, given.get("action", "thrusts"))
        how = FlightSettings(**{**given, "action": action}).with_changes(**env_kwargs)
        if label not in pilots:
            pilots[label] = resolve_expert(
                controller, how.vehicle, "controller", how.rotor_layout, how.action
            )
        settings[label] = how
    return settings, pilots


def _task_table(
    task: str,
    metrics: Mapping[str, Metrics],
    settings: Mapping[str, FlightSettings],
    suite: Suite,
    thesis_columns: Sequence[str],
    n_episodes: int,
) -> Table:
    """Return the table of some controllers that flew the same episodes of a task.

    :param suite: the thesis's suite, which has the rows and the published metrics.
    """
    vehicles = {label: first_vehicle(how.vehicle) for label, how in settings.items()}
    first = next(iter(vehicles.values()))
    # Tasks of your own have the rows of target tracking.
    scenario = suite.scenario(THESIS_SCENARIOS.get(task, "tracking"))
    reference = settings[next(iter(settings))].reference
    if reference is not None:
        # Nothing is published for moving targets.
        scenario = scenario.model_copy(update={"reference": reference, "published": {}})
    names = []
    if task in THESIS_SCENARIOS and first.flies_as(load_vehicle(THESIS_VEHICLE)):
        names = [name for name in thesis_columns if name in scenario.published]
    published = [scenario.published[name] for name in names]
    rows = metric_rows(scenario, [*map(metric_cells, metrics.values())], published)
    title = f"{task}: {n_episodes} fresh episodes, the same for all"
    caption = CAPTION
    if any(vehicle != first for vehicle in vehicles.values()):
        for label, vehicle in vehicles.items():
            caption += f"; {label} flies {vehicle.name}"
    heads = ["", *metrics, *(f"thesis: {name}" for name in names)]
    return Table(heads, rows, title, caption)
