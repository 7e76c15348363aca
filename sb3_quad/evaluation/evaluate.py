"""A suite for any number of controllers: flown scenario by scenario, summarised, and written into a
folder.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from sb3_quad.agents.resolve import resolve_expert
from sb3_quad.base import __version__
from sb3_quad.base.errors import ConfigError, SB3QuadError, refuse_unknown
from sb3_quad.base.files import locked, make_folder, refuse_existing, write_arrays, write_text
from sb3_quad.base.types import Arrays, Report, StrMapping
from sb3_quad.envs.vehicles.vehicle import Vehicle, first_vehicle
from sb3_quad.evaluation.controllers import ControllerSpec, controller_record, known_settings
from sb3_quad.evaluation.fleets import FLEETS
from sb3_quad.evaluation.flightlog import Recorder, episode_arrays
from sb3_quad.evaluation.flights import Flights, fly_settings
from sb3_quad.evaluation.hooks import Hook
from sb3_quad.evaluation.metrics import summarise
from sb3_quad.evaluation.results import (
    FLIGHTS,
    RESULTS,
    WRITTEN,
    Entry,
    Failure,
    Results,
    file_name,
    load_results,
    write_episodes,
)
from sb3_quad.evaluation.reward import OwnReward, Reward, load_reward, reward_name
from sb3_quad.evaluation.scenarios.sample import sample_plan
from sb3_quad.evaluation.scenarios.scenario import DEFAULT_VEHICLE, Scenario, Suite

PART_SIZES = {"batch": 4096, "pybullet": 240}  # episodes flown at the same time
RECORDED = 8  # flights of a controller in a scenario whose trajectories are kept
Progress = Callable[[int, int, str], None]  # flown, all to be flown, the last one


def evaluate(
    suite: Suite,
    controllers: Sequence[ControllerSpec],
    folder: str,
    backend: str = "batch",
    overwrite: bool = False,
    progress: Progress = lambda done, total, name: None,
    report: Report = lambda line: None,
    reward: OwnReward = None,
) -> Results:
    """Fly all scenarios of a suite with all controllers, on the same episodes.

    A controller that fails in a scenario becomes a :class:`Failure`; the others still fly. Repeat
    an interrupted call and it resumes, unless code or files that it does not know may have changed
    in between: those of factories, of a reward of your own, and of references.

    :param folder: folder of the results.
    :param overwrite: remove the results in the folder, instead of refusing it, and start from
        scratch.
    :param report: gets a line for each agent that flies another vehicle than it was trained on, or
        does not say on which.
    :param reward: a reward of your own, see :func:`~sb3_quad.evaluation.flights.fly`, or
        ``package.module:function``.
    :raises ConfigError: an unknown backend; a controller or reward that cannot be loaded; a folder
        that holds results of another call, that cannot be written, or that another process is
        writing to.
    """
    refuse_unknown("backend", [backend], FLEETS)
    if backend == "pybullet":
        # Here a missing PyBullet is a single error, rather than one for each controller.
        from sb3_quad.envs.rendering import bullet_client  # noqa: F401
    own_reward = load_reward(reward)
    results = Results(
        suite=suite.name,
        description=suite.description,
        source=suite.source,
        backend=backend,
        reward=reward_name(reward),
        package_version=__version__,
        controllers=[controller_record(spec) for spec in controllers],
        scenarios=suite.scenarios,
    )
    _report_vehicles(suite, controllers, report)
    place = Path(folder)
    make_folder(place, "results folder", "-o")
    with locked(place, "folder"):
        results.entries.extend(_flown_before(place, results, overwrite))
        # Go scenario by scenario, so that even an interrupted suite compares all controllers.
        jobs = [(scenario, spec) for scenario in suite.scenarios for spec in controllers]
        for number, (scenario, spec) in enumerate(jobs):
            progress(number, len(jobs), f"{spec.label}: {scenario.heading}")
            if results.entry(spec.label, scenario.name) is not None:
                continue
            try:
                entry, arrays = _fly(spec, scenario, backend, own_reward)
            except SB3QuadError as error:
                message = " ".join(str(error).split())
                failure = Failure(controller=spec.label, scenario=scenario.name, message=message)
                results.failures.append(failure)
                continue
            write_arrays(place / entry.flights, compressed=True, **arrays)
            results.entries.append(entry)
            # Write after each one, so that an interrupted evaluation can resume.
            write_text(place / RESULTS, results.model_dump_json(indent=2))
        progress(len(jobs), len(jobs), "")
        if results.entries:
            write_episodes(place, results.entries)
            write_text(place / RESULTS, results.model_dump_json(indent=2))
    return results


def _report_vehicles(suite: Suite, specs: Sequence[ControllerSpec], report: Report) -> None:
    """Report who flies another vehicle than it was trained on, or than the others.

    :raises ConfigError: an agent that cannot fly a vehicle.
    """
    flown = {}
    for spec in specs:
        vehicles = [_vehicle(spec, scenario) for scenario in suite.scenarios]
        # Several scenarios give the same notice, or an empty one: report it once.
        for notice in filter(None, dict.fromkeys(map(spec.notice, vehicles))):
            report(notice)
        # All fly the vehicle that a scenario names.
        for scenario, vehicle in zip(suite.scenarios, vehicles, strict=True):
            if scenario.vehicle is None:
                flown[spec.label] = vehicle.name
    if any(scenario.published and scenario.vehicle is None for scenario in suite.scenarios):
        flown["the published one"] = DEFAULT_VEHICLE
    if len({*flown.values()}) > 1:
        who = ", ".join(map(" flies ".join, flown.items()))
        report(f"not all fly the same vehicle: {who}; --vehicle gives all of them one")


def _vehicle(spec: ControllerSpec, scenario: Scenario) -> Vehicle:
    """The vehicle that a controller flies in a scenario: the scenario's, otherwise its own."""
    if scenario.vehicle is not None or spec.own is None:
        return scenario.nominal_vehicle()
    return first_vehicle(spec.own.vehicle)


def _flown_before(folder: Path, results: Results, overwrite: bool) -> list[Entry]:
    """Return the entries that an interrupted call of the same evaluation has left.

    :raises ConfigError: the folder holds other results that are not to be overwritten, or damaged
        ones.
    """
    if not (folder / RESULTS).is_file():
        for name in WRITTEN:
            refuse_existing(folder / name, overwrite)
        return []
    before = load_results(folder)
    if overwrite:
        for name in WRITTEN:
            (folder / name).unlink(missing_ok=True)
        # Only files of the results; users may keep other files beside them.
        made = [folder / entry.flights for entry in before.entries]
        for file in (folder / FLIGHTS).glob("*/*.npz"):
            if file in made:
                file.unlink()
        return []
    # Code and files outside of this package may have changed in between.
    may_differ = [results.reward != ""]
    may_differ += [record.kind == "factory" for record in results.controllers]
    for scenario in results.scenarios:
        may_differ.append(scenario.reference is not None and scenario.reference.file is not None)
    inputs = before.model_copy(update={"entries": [], "failures": []})
    if any(may_differ) or inputs.model_dump_json() != results.model_dump_json():
        raise ConfigError(
            f"{folder}: holds results already; give another folder with -o,"
            " or remove them with --overwrite"
        )
    return before.entries


def fly_scenario(
    controller: Any,
    scenario: Scenario,
    backend: str = "batch",
    hooks: Sequence[Hook] = (),
    own: StrMapping | None = None,
    reward: Reward | None = None,
) -> Flights:
    """Fly a scenario's episodes; the same ones for every controller and either backend.

    :param controller: as for :func:`~sb3_quad.evaluation.flights.fly`, like ``reward``.
    :param hooks: are called during the first flights, at most ``PART_SIZES``.
    :param own: settings that go with the controller: its ``FlightSettings.observed``.
    :raises ConfigError: an unknown backend, or a controller of an unknown kind.
    :raises ControllerError: a controller or reward that fails in flight.
    """
    seeds = scenario.episode_seeds()
    settings = scenario.settings.with_changes(**(own or {}))
    parts = []
    size = PART_SIZES.get(backend, 1)
    for first in range(0, len(seeds), size):
        part = seeds[first : first + size]
        parts.append(
            fly_settings(
                controller,
                settings,
                part,
                backend,
                scenario.tolerances,
                hooks,
                sample_plan(scenario, part),
                reward=reward,
            )
        )
        hooks = ()
    return Flights.concatenate(parts)


def _fly(
    spec: ControllerSpec, scenario: Scenario, backend: str, reward: Reward | None
) -> tuple[Entry, Arrays]:
    """Fly a controller through a scenario.

    :return: its entry, and the arrays of its flights (``flightlog.py``).
    """
    flown = scenario.flown_by(spec.own and spec.own.vehicle)
    controller = resolve_expert(spec.spec, flown.nominal_vehicle(), "controller")
    # A model from a factory says only now what it observes.
    known = known_settings(spec.spec, controller)
    recorder = Recorder(RECORDED)
    flights = fly_scenario(
        controller, flown, backend, [recorder], known and known.carried, reward
    )
    entry = Entry(
        controller=spec.label,
        scenario=scenario.name,
        metrics=summarise(flights),
        physical_limit=flown.physical_limit,
        flights=f"{FLIGHTS}/{file_name(spec.label)}/{scenario.name}.npz",
    )
    return entry, {**episode_arrays(flights, flown.episode_seeds()), **recorder.arrays()}
