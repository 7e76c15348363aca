"""A suite for any number of controllers: what is not in the folder yet is flown, the rest is kept."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from pydantic import ValidationError

from sb3_quad.base.errors import ConfigError, SB3QuadError, unknown
from sb3_quad.evaluation.controllers import ControllerSpec, describe, measured
from sb3_quad.evaluation.fleets import FLEETS
from sb3_quad.evaluation.folder import ResultFolder
from sb3_quad.evaluation.jobs import Job, make_job, run_jobs
from sb3_quad.evaluation.records import ControllerRecord, Failure, Results
from sb3_quad.scenarios.load import explain
from sb3_quad.scenarios.scenario import Scenario, Suite
from sb3_quad.vehicles.vehicle import is_vehicle_file, load_vehicle

Progress = Callable[[int, int, str], None]  # jobs done, jobs in all, what was done last


def evaluate(
    suite: Suite,
    controllers: Sequence[ControllerSpec],
    folder: str,
    backend: str = "batch",
    workers: int = 1,
    overwrite: bool = False,
    progress: Progress = lambda done, total, name: None,
) -> Results:
    """Fly all scenarios of a suite by all controllers, on the same episodes.

    A controller that cannot be loaded, or fails in a scenario, becomes a :class:`Failure`; the others fly on. What an
    interrupted call has done is kept and not flown again.

    :param folder: of the results.
    :param overwrite: replace earlier results of these controllers that were flown otherwise, instead of refusing.
    :return: all results in the folder, those of earlier calls included.
    :raises ConfigError: an unknown backend; results in the folder of the same names that were flown otherwise; a folder that
        cannot be written.
    """
    if backend not in FLEETS:
        raise ConfigError(unknown("backend", backend, FLEETS))
    if workers < 1:
        raise ConfigError(f"workers {workers}: must be at least 1")
    store = ResultFolder(folder)
    before = store.read_results()
    records, failures = _load(controllers, suite.scenarios[0].vehicle)
    jobs = [
        make_job(spec, records[spec.label], scenario, backend, folder)
        for scenario in suite.scenarios
        for spec in controllers
        if spec.label in records
    ]
    missing = _missing(store, jobs, overwrite)
    try:
        done = len(jobs) - len(missing)
        progress(done, len(jobs), "")
        for job, outcome in run_jobs(missing, workers):
            done += 1
            if isinstance(outcome, Failure):
                failures.append(outcome)
            progress(done, len(jobs), f"{job.record.label}: {job.scenario.heading}")
    finally:  # an interrupt, too, leaves what is done in order
        results = _collect(store, before, suite, list(records.values()), failures, {spec.label for spec in controllers})
        if results.entries or results.failures:
            store.write_results(results)
    return results


def with_changes(
    suite: Suite,
    names: Sequence[str] = (),
    episodes: int | None = None,
    seed: int | None = None,
    vehicle: str | None = None,
) -> Suite:
    """A suite with some of its scenarios, other numbers of episodes or seeds, or another vehicle.

    :param names: of scenarios, or of those whose cells ``vary`` makes; none: all.
    :param vehicle: name, or path of a YAML file, that flies all scenarios; forces and torques stay what they are, in N and
        N m, and reference figures, which are of another vehicle, go.
    :raises ConfigError: an unknown name, a number out of range, a scenario that is impossible for the vehicle.
    """
    known = [name for scenario in suite.scenarios for name in (scenario.name, scenario.group) if name is not None]
    for name in names:
        if name not in known:
            raise ConfigError(unknown("scenario", name, sorted(set(known))))
    if (episodes is not None and episodes < 1) or (seed is not None and not 0 <= seed < 2**32):
        raise ConfigError(f"episodes {episodes}, seed {seed}: at least one episode, a seed of 0 to {2**32 - 1}")
    changes = {key: value for key, value in (("episodes", episodes), ("seed", seed)) if value is not None}
    kept = [each for each in suite.scenarios if not names or each.name in names or each.group in names]
    scenarios = tuple(_changed(scenario, changes) for scenario in kept)
    if vehicle is not None:
        scenarios = tuple(_flown_by(vehicle, scenario) for scenario in scenarios)
    return suite.model_copy(update={"scenarios": scenarios})


def _changed(scenario: Scenario, changes: dict[str, int]) -> Scenario:
    search = scenario.hit_search
    if search is not None and "episodes" in changes:
        search = search.model_copy(update={"episodes": min(search.episodes, changes["episodes"])})
    return scenario.model_copy(update={**changes, "hit_search": search})


def _flown_by(vehicle: str, scenario: Scenario) -> Scenario:
    load_vehicle(vehicle)  # whatever is wrong with it
    name = str(Path(vehicle).absolute()) if is_vehicle_file(vehicle) else vehicle
    try:
        return Scenario.model_validate({**scenario.model_dump(), "vehicle": name, "reference": {}})
    except ValidationError as error:
        raise ConfigError(f"scenario {scenario.name}, flown by {vehicle}: {explain(error, Scenario)}") from None


def _load(controllers: Sequence[ControllerSpec], vehicle: str) -> tuple[dict[str, ControllerRecord], list[Failure]]:
    records, failures = {}, []
    for spec in controllers:
        try:
            records[spec.label] = measured(spec, describe(spec), vehicle)
        except SB3QuadError as error:
            failures.append(Failure(controller=spec.label, scenario=None, message=" ".join(str(error).split())))
    return records, failures


def _missing(store: ResultFolder, jobs: Sequence[Job], overwrite: bool) -> list[Job]:
    """The jobs whose flights are not there.

    :raises ConfigError: flights of the same names are there that were flown otherwise.
    """
    there = {(entry.controller, entry.scenario): entry for entry in store.entries()}
    asked = {(job.record.label, job.scenario.name) for job in jobs}
    keys = {job.scenario.name: job.scenario_key for job in jobs}
    for name, entry in there.items():
        other = entry.scenario_key != keys.get(entry.scenario, entry.scenario_key)
        if other and not (overwrite and name in asked):
            raise ConfigError(
                f"{store.path}: holds flights of {entry.controller} in {entry.scenario} with other seeds, numbers or another"
                " scenario; give another folder with -o" + ("" if name not in asked else ", or replace them with --overwrite")
            )
    missing = []
    for job in jobs:
        found = there.get((job.record.label, job.scenario.name))
        if found is not None and found.key == job.key:
            continue
        if found is not None and not overwrite:
            raise ConfigError(
                f"{store.path}: holds flights of another controller called {job.record.label}; label this one"
                f" (name={job.spec.spec}), give another folder with -o, or replace them with --overwrite"
            )
        missing.append(job)
    return missing


def _collect(
    store: ResultFolder,
    before: Results | None,
    suite: Suite,
    records: list[ControllerRecord],
    failures: list[Failure],
    asked: set[str],
) -> Results:
    from sb3_quad import __version__

    scenarios = {scenario.name: scenario for scenario in suite.scenarios}
    controllers = {record.label: record for record in records}
    kept: list[Failure] = []
    if before is not None:
        flown_now = set(scenarios)
        scenarios = {scenario.name: scenario for scenario in before.scenarios} | scenarios
        controllers = {record.label: record for record in before.controllers} | controllers
        kept = [each for each in before.failures if each.controller not in asked or each.scenario not in {None, *flown_now}]
    order = {name: number for number, name in enumerate(scenarios)}
    entries = [entry for entry in store.entries() if entry.scenario in order and entry.controller in controllers]
    labels = list(controllers)
    return Results(
        suite=suite.name,
        description=suite.description,
        source=suite.source,
        package_version=__version__,
        controllers=list(controllers.values()),
        scenarios=list(scenarios.values()),
        entries=sorted(entries, key=lambda entry: (order[entry.scenario], labels.index(entry.controller))),
        failures=kept + failures,
    )
