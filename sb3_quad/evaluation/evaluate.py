"""A suite for any number of controllers: what is not in the folder yet is flown, the rest is kept."""

import itertools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path

from sb3_quad.base.errors import ConfigError, SB3QuadError, unknown
from sb3_quad.base.files import locked
from sb3_quad.base.version import __version__
from sb3_quad.evaluation.controllers import ControllerSpec, describe
from sb3_quad.evaluation.fleets import FLEETS
from sb3_quad.evaluation.folder import RESULTS, load_results, read_entries, write_results
from sb3_quad.evaluation.jobs import Job, failure, run_jobs
from sb3_quad.evaluation.records import ControllerRecord, Failure, Results
from sb3_quad.evaluation.scenarios.scenario import DEFAULT_VEHICLE, Suite
from sb3_quad.executors import start_executor
from sb3_quad.vehicles.vehicle import load_vehicle

Progress = Callable[[int, int, str], None]  # jobs done, jobs in all, what was done last


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

    A controller that cannot be loaded, or fails in a scenario, becomes a :class:`Failure`; the others fly on. What an
    interrupted call has done is kept and not flown again.

    :param folder: of the results.
    :param workers: that fly side by side; with one, and no Ray, this process flies.
    :param overwrite: replace earlier results of these controllers that were flown otherwise, instead of refusing.
    :param report: told in one line of each agent that flies another vehicle than it was trained on, or does not say on which.
    :param executor: of the workers, see :func:`~sb3_quad.executors.start_executor`, as is ``address``.
    :return: all results in the folder, those of earlier calls included; where nothing has been flown, it is not written.
    :raises ConfigError: an unknown backend; results in the folder of the same names that were flown otherwise; a folder that
        cannot be written, or that another process is writing to.
    """
    if backend not in FLEETS:
        raise ConfigError(unknown("backend", backend, FLEETS))
    if workers < 1:
        raise ConfigError(f"workers {workers}: must be at least 1")
    if Path(folder).is_file():
        raise ConfigError(f"{folder}: is a file; the results need a folder, give another with -o")
    failures: list[Failure] = []
    loaded: list[tuple[ControllerSpec, ControllerRecord]] = []
    vehicles: dict[str, str] = {}  # by label, where a scenario names none
    for spec in controllers:
        try:
            own = load_vehicle(spec.own.vehicle if spec.own else DEFAULT_VEHICLE)
            flies = [own if each.vehicle is None else each.nominal_vehicle() for each in suite.scenarios]
            loaded.append((spec, describe(spec, flies[0])))
            vehicles[spec.label] = own.name
            for line in dict.fromkeys(map(spec.notice, flies)):
                if line:
                    report(line)
        except SB3QuadError as error:
            failures.append(failure(spec.label, None, error))
    unfixed = [each for each in suite.scenarios if each.vehicle is None]
    if any(each.reference for each in unfixed):
        vehicles["the reference"] = DEFAULT_VEHICLE
    if len(set(vehicles.values())) > 1 and unfixed:
        each_flies = ", ".join(f"{label} flies {vehicle}" for label, vehicle in vehicles.items())
        report(f"not all fly the same vehicle: {each_flies}; --vehicle gives all of them one")
    jobs = [Job(spec, record, each, backend, folder) for each in suite.scenarios for spec, record in loaded]
    asked, flown = {spec.label for spec in controllers}, {None, *(scenario.name for scenario in suite.scenarios)}
    with _claimed(Path(folder), bool(jobs)) as place:
        before = load_results(place) if (place / RESULTS).is_file() else None
        earlier = [] if before is None else before.failures
        failures[:0] = [each for each in earlier if each.controller not in asked or each.scenario not in flown]
        missing = _missing(place, jobs, overwrite)
        done = len(jobs) - len(missing)
        try:
            progress(done, len(jobs), "")
            alone = executor == "local" and min(workers, len(missing)) <= 1
            with nullcontext() if alone else start_executor(executor, workers, address) as working:
                for job, outcome in run_jobs(missing, working):
                    done += 1
                    if isinstance(outcome, Failure):
                        failures.append(outcome)
                    progress(done, len(jobs), f"{job.record.label}: {job.scenario.heading}")
        finally:  # an interrupt, too, leaves what is done in order
            results = _collect(place, before, suite, [record for _, record in loaded], failures)
            if results.entries or before is not None:
                write_results(place, results)
    return results


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


def _missing(folder: Path, jobs: Sequence[Job], overwrite: bool) -> list[Job]:
    """The jobs whose flights are not there.

    :raises ConfigError: flights of the same names are there that were flown otherwise.
    """
    there = {(entry.controller, entry.scenario): entry for entry in read_entries(folder)}
    asked = {(job.record.label, job.scenario.name): job for job in jobs}
    keys = {job.scenario.name: job.scenario_key for job in jobs}
    for name, entry in there.items():
        job = asked.get(name)
        if overwrite and job is not None:
            continue
        if entry.scenario_key != keys.get(entry.scenario, entry.scenario_key):
            raise ConfigError(
                f"{folder}: holds flights of {entry.controller} in {entry.scenario} with other seeds, numbers or another"
                " scenario; give another folder with -o" + ("" if job is None else ", or replace them with --overwrite")
            )
        if job is not None and entry.key != job.key:
            raise ConfigError(
                f"{folder}: holds flights of another controller called {entry.controller}; label this one"
                f" (name={job.spec.spec}), give another folder with -o, or replace them with --overwrite"
            )
    return [job for name, job in asked.items() if name not in there or there[name].key != job.key]


def _collect(
    folder: Path, before: Results | None, suite: Suite, records: list[ControllerRecord], failures: list[Failure]
) -> Results:
    """All that the folder holds by now; what was there before comes first."""
    scenarios = {each.name: each for each in [*(before.scenarios if before else []), *suite.scenarios]}
    controllers = {each.label: each for each in [*(before.controllers if before else []), *records]}
    entries = {(entry.scenario, entry.controller): entry for entry in read_entries(folder)}
    return Results(
        suite=suite.name,
        description=suite.description,
        source=suite.source,
        package_version=__version__,
        controllers=list(controllers.values()),
        scenarios=list(scenarios.values()),
        entries=[entries[key] for key in itertools.product(scenarios, controllers) if key in entries],
        failures=failures,
    )
