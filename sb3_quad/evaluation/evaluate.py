"""A suite for any number of controllers: scenario by scenario flown, summed up and written."""

import hashlib
import itertools
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import as_completed
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from sb3_quad.base.arrays import Arrays
from sb3_quad.base.errors import ConfigError, SB3QuadError, WorkerDied, unknown
from sb3_quad.base.files import locked, write_arrays
from sb3_quad.base.validate import read_record
from sb3_quad.base.version import __version__
from sb3_quad.envs import registration
from sb3_quad.evaluation.controllers import ControllerSpec, build, describe
from sb3_quad.evaluation.fleets import FLEETS
from sb3_quad.evaluation.flightlog import episode_arrays
from sb3_quad.evaluation.metrics import summarise
from sb3_quad.evaluation.results import (
    RESULTS,
    UNFINISHED,
    ControllerRecord,
    Entry,
    Failure,
    Results,
    Unfinished,
    flights_path,
    load_results,
    write_record,
    write_results,
)
from sb3_quad.evaluation.scenario_flights import find_limit, fly_scenario
from sb3_quad.evaluation.scenarios.scenario import DEFAULT_VEHICLE, Scenario, Suite
from sb3_quad.executors import Executor, start_executor
from sb3_quad.vehicles.vehicle import Vehicle, load_vehicle

Progress = Callable[[int, int, str], None]  # jobs done, jobs in all, what was done last
_TEXTS = {"title", "description", "reference", "group", "cell"}  # fields of a scenario that change no flight


@dataclass(frozen=True)
class Job:
    """A controller in a scenario, as the suite has it."""

    spec: ControllerSpec
    record: ControllerRecord
    scenario: Scenario
    backend: str

    @property
    def name(self) -> tuple[str, str]:
        """As of :class:`~sb3_quad.evaluation.results.Entry`."""
        return self.scenario.name, self.record.label


class Outcome(NamedTuple):
    """A job that is done, and the arrays of its flights (``flightlog.py``)."""

    entry: Entry
    arrays: Arrays


def evaluate(
    suite: Suite,
    controllers: Sequence[ControllerSpec],
    folder: str,
    backend: str = "batch",
    workers: int = 1,
    overwrite: bool = False,
    progress: Progress = lambda done, total, name: None,
    report: Callable[[str], None] = lambda line: None,
    executor: str = "local",
    address: str | None = None,
) -> Results:
    """Fly all scenarios of a suite by all controllers, on the same episodes.

    A controller that cannot be loaded, or fails in a scenario, becomes a :class:`Failure`; the others fly on. Results of other
    controllers and scenarios in the folder are kept. An interrupted call goes on when it is repeated, but for factories, whose
    code may have changed.

    :param folder: of the results.
    :param workers: that fly side by side; with one, and no Ray, this process flies.
    :param overwrite: replace results of other controllers or scenarios of these names, instead of refusing; begin anew.
    :param report: gets a line for each agent that flies another vehicle than it was trained on, or does not say on which.
    :param executor: of the workers, see :func:`~sb3_quad.executors.start_executor`, as is ``address``.
    :return: all results in the folder; where nothing has been flown, it is not written.
    :raises ConfigError: an unknown backend; other controllers or scenarios of these names in the folder; a folder that
        cannot be written, or that another process is writing to.
    """
    if backend not in FLEETS:
        raise ConfigError(unknown("backend", backend, FLEETS))
    if workers < 1:
        raise ConfigError(f"workers {workers}: must be at least 1")
    if Path(folder).is_file():
        raise ConfigError(f"{folder}: is a file; the results need a folder, give another with -o")
    failures: list[Failure] = []
    records: dict[ControllerSpec, ControllerRecord] = {}
    for spec in controllers:
        try:
            vehicles = [_vehicle(spec, each) for each in suite.scenarios]
            records[spec] = describe(spec, vehicles[0])
            for line in dict.fromkeys(filter(None, map(spec.notice, vehicles))):
                report(line)
        except SB3QuadError as error:
            failures.append(_failure(spec.label, None, error))
    _report_vehicles(suite, list(records), report)
    jobs = [Job(spec, record, each, backend) for each in suite.scenarios for spec, record in records.items()]
    with _claimed(Path(folder), make=bool(jobs)) as place:
        before = load_results(place) if (place / RESULTS).is_file() else None
        kept = [] if before is None else _kept(place, before, jobs, overwrite)
        asked = {
            (scenario, spec.label) for spec in controllers for scenario in (None, *(each.name for each in suite.scenarios))
        }
        earlier = [] if before is None else before.failures
        failures[:0] = [each for each in earlier if (each.scenario, each.controller) not in asked]
        evaluation = _digest(jobs)
        done = {} if overwrite else _interrupted(place, evaluation, jobs)
        missing = [job for job in jobs if job.name not in done]
        if before is not None and len(kept) < len(before.entries):  # what is flown anew is no result any more
            write_results(place, _joined(before, suite, records.values(), [*kept, *done.values()], failures))
        try:
            progress(len(done), len(jobs), "")
            alone = executor == "local" and min(workers, len(missing)) <= 1
            with nullcontext() if alone else start_executor(executor, workers, address) as working:
                for number, (job, outcome) in enumerate(_fly_jobs(missing, working), len(done) + 1):
                    if isinstance(outcome, Failure):
                        failures.append(outcome)
                    else:
                        write_arrays(place / outcome.entry.flights, compressed=True, **outcome.arrays)
                        done[job.name] = outcome.entry
                        write_record(place / UNFINISHED, Unfinished(evaluation=evaluation, entries=list(done.values())))
                    progress(number, len(jobs), f"{job.record.label}: {job.scenario.heading}")
            (place / UNFINISHED).unlink(missing_ok=True)
        finally:  # an interrupt, too, leaves what is done in order
            results = _joined(before, suite, records.values(), [*kept, *done.values()], failures)
            if results.entries or before is not None:
                write_results(place, results)
    return results


def fly_job(job: Job) -> Outcome | Failure:
    """Fly and sum up; of a controller that fails, its :class:`Failure`."""
    start = time.perf_counter()
    try:
        scenario, seen = job.scenario.flown_by(job.spec.own and job.spec.own.vehicle), job.spec.observed
        controller = build(job.spec, scenario.nominal_vehicle(), job.record.offset)
        flights, trajectories = fly_scenario(controller, scenario, job.backend, recorded=None, own=seen)
        limit = find_limit(controller, scenario, job.backend, seen)
    except SB3QuadError as error:
        return _failure(job.record.label, job.scenario.name, error)
    entry = Entry(
        controller=job.record.label,
        scenario=scenario.name,
        seed=scenario.seed,
        backend=job.backend,
        seconds=round(time.perf_counter() - start, 3),
        date=time.strftime("%Y-%m-%d", time.gmtime()),
        metrics=summarise(flights),
        hit_limit=limit,
        flights=flights_path(job.record.label, scenario.name),
    )
    return Outcome(entry, {**episode_arrays(flights, scenario.episode_seeds()), **trajectories})


def _fly_jobs(jobs: Sequence[Job], executor: Executor | None) -> Iterator[tuple[Job, Outcome | Failure]]:
    """Fly jobs, and hand out each as it is done: one after another here, or side by side in an executor's workers.

    A job whose worker process ends, as a crash or too little memory makes it, becomes a :class:`Failure`.
    """
    if executor is None:
        yield from ((job, fly_job(job)) for job in jobs)
        return
    submitted = {executor.submit(fly_job, job): job for job in jobs}
    for future in as_completed(submitted):
        job = submitted[future]
        try:
            yield job, future.result()
        except WorkerDied as ended:
            yield job, _failure(job.record.label, job.scenario.name, ended)


def _vehicle(spec: ControllerSpec, scenario: Scenario) -> Vehicle:
    """What a controller flies in a scenario: the scenario's vehicle, else its own."""
    own = spec.own.vehicle if spec.own else DEFAULT_VEHICLE
    return load_vehicle(own) if scenario.vehicle is None else scenario.nominal_vehicle()


def _report_vehicles(suite: Suite, specs: Sequence[ControllerSpec], report: Callable[[str], None]) -> None:
    """Say so if the controllers, or the reference beside them, fly different vehicles where a scenario names none."""
    unfixed = [each for each in suite.scenarios if each.vehicle is None]
    vehicles = {spec.label: _vehicle(spec, unfixed[0]).name for spec in specs} if unfixed else {}
    if any(each.reference for each in unfixed):
        vehicles["the reference"] = DEFAULT_VEHICLE
    if len(set(vehicles.values())) > 1:
        each_flies = ", ".join(f"{label} flies {vehicle}" for label, vehicle in vehicles.items())
        report(f"not all fly the same vehicle: {each_flies}; --vehicle gives all of them one")


@contextmanager
def _claimed(folder: Path, make: bool) -> Iterator[Path]:
    """A folder for this process alone, made if it is to be written to; one that stays empty is removed again.

    :raises ConfigError: another process has it; it cannot be made.
    """
    new = make and not folder.exists()
    if new:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"{folder}: cannot be written ({error.strerror or error})") from None
    try:
        with locked(folder, "folder") if folder.is_dir() else nullcontext():
            yield folder
    finally:
        if new:
            with suppress(OSError):
                folder.rmdir()


def _kept(folder: Path, before: Results, jobs: Sequence[Job], overwrite: bool) -> list[Entry]:
    """The entries in a folder that stay beside those of some jobs.

    :raises ConfigError: another controller or scenario of the same name is there.
    """
    records, scenarios = {job.record.label: job.record for job in jobs}, {job.scenario.name: job for job in jobs}
    kept = []
    for entry in before.entries:
        record, job = records.get(entry.controller), scenarios.get(entry.scenario)
        other = ""
        if job is not None and _flown(job.scenario, job.backend) != _flown(before.scenario(entry.scenario), entry.backend):
            other = f"of {entry.controller} in {entry.scenario} with other seeds, numbers or another scenario"
        elif record is not None and not record.is_same(before.controller(entry.controller)):
            other = f"of another controller called {entry.controller} (name={record.spec} calls this one otherwise)"
        if other and not (overwrite and record is not None):
            way_out = "give another folder with -o" + ("" if record is None else ", or replace them with --overwrite")
            raise ConfigError(f"{folder}: holds flights {other}; {way_out}")
        if not other and (record is None or job is None):
            kept.append(entry)
    return kept


def _flown(scenario: Scenario, backend: str) -> tuple[Any, str]:
    """What the episodes of a scenario depend on."""
    return scenario.model_dump(exclude=_TEXTS), backend


def _joined(
    before: Results | None,
    suite: Suite,
    records: Iterable[ControllerRecord],
    entries: Iterable[Entry],
    failures: Sequence[Failure],
) -> Results:
    """All that the folder holds by now; what was there before comes first."""
    scenarios = {each.name: each for each in [*(before.scenarios if before else []), *suite.scenarios]}
    controllers = {each.label: each for each in [*(before.controllers if before else []), *records]}
    flown = {entry.name: entry for entry in entries}
    return Results(
        suite=suite.name,
        description=suite.description,
        source=suite.source,
        package_version=__version__,
        controllers=list(controllers.values()),
        scenarios=list(scenarios.values()),
        entries=[flown[name] for name in itertools.product(scenarios, controllers) if name in flown],
        failures=list(failures),
    )


def _interrupted(folder: Path, evaluation: str, jobs: Sequence[Job]) -> dict[tuple[str, str], Entry]:
    """What an interrupted evaluation of the same digest has flown, but for factories, whose code may have changed."""
    path = folder / UNFINISHED
    unfinished = read_record(path, Unfinished) if path.is_file() else None
    if unfinished is None or unfinished.evaluation != evaluation:
        return {}
    certain = {job.name for job in jobs if job.record.kind != "factory"}
    return {entry.name: entry for entry in unfinished.entries if entry.name in certain}


def _digest(jobs: Sequence[Job]) -> str:
    """SHA-256 of all that the flights of some jobs depend on, the sources of this package included."""
    digest = hashlib.sha256()
    for folder in (Path(__file__).parents[1], Path(registration.__file__).parent):
        for path in sorted([*folder.rglob("*.py"), *folder.rglob("*.yaml")]):
            digest.update(path.read_bytes())
    for job in jobs:
        digest.update(repr((job, job.spec.own, _vehicle(job.spec, job.scenario))).encode())
    return digest.hexdigest()


def _failure(controller: str, scenario: str | None, error: SB3QuadError) -> Failure:
    """The record of an error, in one line; without a scenario, the controller could not be loaded."""
    return Failure(controller=controller, scenario=scenario, message=" ".join(str(error).split()))
