"""A suite for any number of controllers: flown scenario by scenario, summarised, and written into a
folder.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from sb3_quad.agents.resolve import resolve_expert
from sb3_quad.base import __version__
from sb3_quad.base.errors import ConfigError, SB3QuadError
from sb3_quad.base.files import locked, make_folder, refuse_outside, write_arrays, write_text
from sb3_quad.base.types import Arrays, Report, StrMapping
from sb3_quad.evaluation.controllers import ControllerSpec, controller_record, known_settings
from sb3_quad.evaluation.flightlog import Recorder, episode_arrays
from sb3_quad.evaluation.flights import Flights, fly_settings
from sb3_quad.evaluation.hooks import Hook
from sb3_quad.evaluation.metrics import summarise
from sb3_quad.evaluation.results import (
    FIGURES,
    FLIGHTS,
    REPORT,
    RESULTS,
    Entry,
    Results,
    file_name,
    load_results,
)
from sb3_quad.evaluation.scenarios.sample import sample_plan
from sb3_quad.evaluation.scenarios.scenario import DEFAULT_VEHICLE, Scenario, Suite

RECORDED = 8  # flights of a controller in a scenario whose trajectories are kept
Progress = Callable[[int, int, str], None]  # flown, all to be flown, the last one


def evaluate(
    suite: Suite,
    controllers: Sequence[ControllerSpec],
    folder: str,
    progress: Progress = lambda done, total, name: None,
    report: Report = lambda line: None,
) -> Results:
    """Fly all scenarios of a suite with all controllers, on the same episodes.

    If a controller fails in a scenario, the others still fly, and ``failures`` says why. Repeat
    an interrupted call and it resumes, unless code or files that it does not know may have changed
    in between: those of factories and of references.

    :param folder: folder of the results.
    :param report: gets a line for each agent that flies another vehicle than it was trained on, or
        does not say on which.
    :raises ConfigError: a controller that cannot be loaded; a folder that holds results of another
        call, that cannot be written, or that another process is writing to.
    """
    results = Results(
        suite=suite.name,
        title=suite.title,
        description=suite.description,
        source=suite.source,
        package_version=__version__,
        controllers=[controller_record(spec) for spec in controllers],
        scenarios=suite.scenarios,
    )
    _report_vehicles(suite, controllers, report)
    place = Path(folder)
    make_folder(place, "results folder", "-o")
    with locked(place, "folder"):
        results.entries.extend(_flown_before(place, results))
        # Go scenario by scenario, so that even an interrupted suite compares all controllers.
        jobs = [(scenario, spec) for scenario in suite.scenarios for spec in controllers]
        for number, (scenario, spec) in enumerate(jobs):
            progress(number, len(jobs), f"{spec.label}: {scenario.heading}")
            if results.entry(spec.label, scenario.name) is not None:
                continue
            try:
                entry, arrays = _fly(spec, scenario)
            except SB3QuadError as error:
                message = " ".join(str(error).split())
                results.failures.append(f"{spec.label}, {scenario.name}: {message}")
            else:
                write_arrays(place / entry.flights, compressed=True, **arrays)
                results.entries.append(entry)
            # Write after each one, so that an interrupted evaluation can resume.
            if results.entries:
                write_text(place / RESULTS, results.model_dump_json(indent=2))
        progress(len(jobs), len(jobs), "")
    return results


def _report_vehicles(suite: Suite, specs: Sequence[ControllerSpec], report: Report) -> None:
    """Report who flies another vehicle than it was trained on, or than the others.

    :raises ConfigError: an agent that cannot fly a vehicle.
    """
    flown = {}
    for spec in specs:
        # Several scenarios give the same notice: report it once.
        notices = dict[str, None]()
        for scenario in suite.scenarios:
            vehicle = scenario.flown_by(spec.own).nominal_vehicle()
            notices[spec.notice(vehicle)] = None
            # All fly the vehicle that a scenario names.
            if scenario.vehicle is None:
                flown[spec.label] = vehicle.name
        for notice in filter(None, notices):
            report(notice)
    if any(scenario.published and scenario.vehicle is None for scenario in suite.scenarios):
        flown["the published one"] = DEFAULT_VEHICLE
    if len({*flown.values()}) > 1:
        who = ", ".join(map(" flies ".join, flown.items()))
        report(f"not all fly the same vehicle: {who}; --vehicle gives all of them one")


def _flown_before(folder: Path, results: Results) -> list[Entry]:
    """Return the entries that an interrupted call of the same evaluation has left.

    :raises ConfigError: the folder holds other results, or damaged ones.
    """
    for pattern in (FLIGHTS, f"{FLIGHTS}/*", FIGURES):
        for path in folder.glob(pattern):
            refuse_outside(path, str(folder), folder)
    if not (folder / RESULTS).is_file():
        if (folder / REPORT).exists():
            raise ConfigError(f"{folder / REPORT}: exists already; give another folder with -o")
        return []
    before = load_results(folder)
    # Code and files outside of this package may have changed in between.
    may_differ = [record.kind == "factory" for record in results.controllers]
    for scenario in results.scenarios:
        may_differ.append(scenario.reference is not None and scenario.reference.file is not None)
    inputs = before.model_copy(update={"entries": [], "failures": []})
    if any(may_differ) or inputs.model_dump_json() != results.model_dump_json():
        raise ConfigError(
            f"{folder}: holds results already; give another folder with -o, or remove it"
        )
    return before.entries


def fly_scenario(
    controller: Any,
    scenario: Scenario,
    hooks: Sequence[Hook] = (),
    own: StrMapping | None = None,
) -> Flights:
    """Fly a scenario's episodes; the same ones for every controller.

    :param controller: as for :func:`~sb3_quad.evaluation.flights.fly`.
    :param own: settings that go with the controller: its ``FlightSettings.observed``.
    :raises ConfigError: a controller of an unknown kind.
    :raises ControllerError: a controller that fails in flight.
    """
    seeds = scenario.episode_seeds()
    settings = scenario.settings.with_changes(**(own or {}))
    plan = sample_plan(scenario, seeds)
    return fly_settings(controller, settings, seeds, scenario.tolerances, hooks, plan)


def _fly(spec: ControllerSpec, scenario: Scenario) -> tuple[Entry, Arrays]:
    """Fly a controller through a scenario.

    :return: its entry, and the arrays of its flights (``flightlog.py``).
    """
    flown = scenario.flown_by(spec.own)
    action = flown.settings.action
    controller = resolve_expert(spec.spec, flown.nominal_vehicle(), "controller", action=action)
    # A model from a factory says only now what it observes.
    known = known_settings(spec.spec, controller)
    recorder = Recorder(RECORDED)
    carried = {} if known is None else known.carried
    flights = fly_scenario(controller, flown, hooks=[recorder], own=carried)
    entry = Entry(
        controller=spec.label,
        scenario=scenario.name,
        metrics=summarise(flights),
        physical_limit=flown.physical_limit,
        flights=f"{FLIGHTS}/{file_name(spec.label)}/{scenario.name}.npz",
    )
    return entry, {**episode_arrays(flights, flown.episode_seeds()), **recorder.arrays()}
