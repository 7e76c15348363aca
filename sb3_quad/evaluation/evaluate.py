"""A suite for any number of controllers: scenario by scenario flown, summed up and written into a
folder of its own.
"""

import hashlib
import importlib
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import as_completed
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sb3_quad.base import __version__
from sb3_quad.base.arrays import Arrays
from sb3_quad.base.errors import ConfigError, SB3QuadError, WorkerDied, unknown
from sb3_quad.base.files import locked, make_folder, refuse_existing, write_arrays, write_text
from sb3_quad.controllers.resolve import resolve_expert
from sb3_quad.envs import registration
from sb3_quad.evaluation.controllers import ControllerSpec, describe
from sb3_quad.evaluation.fleets import FLEETS
from sb3_quad.evaluation.flightlog import Recorder, episode_arrays
from sb3_quad.evaluation.flights import Flights, fly_settings
from sb3_quad.evaluation.metrics import summarise
from sb3_quad.evaluation.results import (
    FLIGHTS,
    RESULTS,
    WRITTEN,
    ControllerRecord,
    Entry,
    Failure,
    Results,
    flights_path,
    load_results,
    write_episodes,
)
from sb3_quad.evaluation.scenarios.sample import sample_plan
from sb3_quad.evaluation.scenarios.scenario import DEFAULT_VEHICLE, Scenario, Suite
from sb3_quad.executors import Executor, start_executor
from sb3_quad.vehicles.vehicle import Vehicle, first_vehicle

PART_SIZES = {"batch": 4096, "pybullet": 240}  # episodes side by side
RECORDED_FIXED, RECORDED_RANDOM = 24, 8  # flights whose trajectories are kept, at most
Progress = Callable[[int, int, str], None]  # jobs done, jobs in all, what was done last


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

    A controller that cannot be loaded, or fails in a scenario, becomes a :class:`Failure`; the
    others fly on. An interrupted call goes on when it is repeated, but for factories, whose code
    may have changed.

    :param folder: of the results; where no controller can be loaded, it is not made.
    :param workers: that fly side by side; with one, and no Ray, this process flies.
    :param overwrite: remove the results that the folder holds, instead of refusing it; begin anew.
    :param report: gets a line for each agent that flies another vehicle than it was trained on, or
        does not say on which.
    :param executor: of the workers, see :func:`~sb3_quad.executors.start_executor`, as is
        ``address``.
    :raises ConfigError: an unknown backend; a folder that holds results of another call, that
        cannot be written, or that another process is writing to.
    """
    if backend not in FLEETS:
        raise ConfigError(unknown("backend", backend, FLEETS))
    if backend == "pybullet":  # once, rather than for each controller
        importlib.import_module("sb3_quad.base.bullet")
    if workers < 1:
        raise ConfigError(f"workers {workers}: must be at least 1")
    place, failures = Path(folder), list[Failure]()
    records: dict[ControllerSpec, ControllerRecord] = {}
    for spec in controllers:
        try:
            vehicles = [_vehicle(spec, each) for each in suite.scenarios]
            record, notices = describe(spec), dict.fromkeys(map(spec.notice, vehicles))
            for line in filter(None, notices):
                report(line)
            records[spec] = record
        except SB3QuadError as error:
            failures.append(_failure(spec.label, None, error))
    _report_vehicles(suite, list(records), report)
    jobs = [
        Job(spec, record, each, backend)
        for each in suite.scenarios
        for spec, record in records.items()
    ]
    digest, done = _digest(jobs), dict[tuple[str, str], Entry]()

    def results(finished: bool = True) -> Results:
        return Results(
            suite=suite.name,
            description=suite.description,
            source=suite.source,
            package_version=__version__,
            controllers=list(records.values()),
            scenarios=list(suite.scenarios),
            entries=[done[job.name] for job in jobs if job.name in done],
            failures=failures,
            digest=digest,
            finished=finished,
        )

    if not jobs:
        return results()
    make_folder(place, "results folder", "-o")
    with locked(place, "folder"):
        done |= _begin(place, digest, jobs, overwrite)
        missing = [job for job in jobs if job.name not in done]
        progress(len(done), len(jobs), "")
        alone = executor == "local" and min(workers, len(missing)) <= 1
        with nullcontext() if alone else start_executor(executor, workers, address) as working:
            for number, (job, outcome) in enumerate(_fly_jobs(missing, working), len(done) + 1):
                if isinstance(outcome, Failure):
                    failures.append(outcome)
                else:
                    done[job.name], arrays = outcome
                    write_arrays(place / done[job.name].flights, compressed=True, **arrays)
                    write_text(place / RESULTS, results(finished=False).model_dump_json(indent=2))
                progress(number, len(jobs), f"{job.record.label}: {job.scenario.heading}")
        found = results()  # in the order of the suite, whoever was done first
        if done:
            write_episodes(place, found.entries)
            write_text(place / RESULTS, found.model_dump_json(indent=2))
    return found


def fly_scenario(
    controller: Any,
    scenario: Scenario,
    backend: str = "batch",
    recorded: int | None = 0,
    own: Mapping[str, Any] | None = None,
) -> tuple[Flights, Arrays]:
    """Fly a scenario's episodes; the same ones for every controller and either backend.

    :param controller: as of :func:`~sb3_quad.evaluation.flights.fly`.
    :param recorded: flights to sample; None: all of a scenario that is the same each time, the
        first few of others.
    :param own: changes to how it is flown that go with the controller: its
        ``FlightSettings.observed``.
    :return: the metrics, and the trajectories (``flightlog.py``) of the first ``recorded`` flights.
    :raises ConfigError: an unknown backend, or a controller that cannot be asked.
    :raises ControllerError: a controller that fails in flight.
    """
    seeds = scenario.episode_seeds()
    if recorded is None:
        recorded = RECORDED_FIXED if scenario.is_fixed else RECORDED_RANDOM
    size, settings = PART_SIZES.get(backend, 1), scenario.flown_as.with_changes(**(own or {}))
    parts, recorder = [], Recorder(recorded)
    for first in range(0, len(seeds), size):
        part = slice(first, first + size)
        plan = sample_plan(scenario, seeds[part])
        hooks = [recorder] if recorded and first == 0 else []
        parts.append(
            fly_settings(
                controller, settings, seeds[part], backend, scenario.tolerances, hooks, plan
            )
        )
    return Flights.concatenate(parts), recorder.arrays() if recorded else {}


def fly_job(job: Job) -> tuple[Entry, Arrays] | Failure:
    """Fly and sum up; the arrays are those of the flights (``flightlog.py``). Of a controller that
    fails, its Failure.
    """
    start = time.perf_counter()
    try:
        scenario, seen = (
            job.scenario.flown_by(job.spec.own and job.spec.own.vehicle),
            job.spec.observed,
        )
        controller = resolve_expert(job.spec.spec, scenario.nominal_vehicle(), "controller")
        flights, trajectories = fly_scenario(
            controller, scenario, job.backend, recorded=None, own=seen
        )
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
        physical_limit=scenario.physical_limit,
        flights=flights_path(job.record.label, scenario.name),
    )
    return entry, {**episode_arrays(flights, scenario.episode_seeds()), **trajectories}


def _fly_jobs(jobs: Sequence[Job], executor: "Executor | None") -> Iterator[tuple[Job, Any]]:
    """Fly jobs, and hand out each as it is done: one after another here, or side by side in an
    executor's workers.

    A job whose worker process ends, as a crash or too little memory makes it, becomes a
    :class:`Failure`.
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
    return first_vehicle(own) if scenario.vehicle is None else scenario.nominal_vehicle()


def _report_vehicles(
    suite: Suite, specs: Sequence[ControllerSpec], report: Callable[[str], None]
) -> None:
    """Say so if the controllers, or the reference beside them, fly different vehicles where a
    scenario names none.
    """
    unfixed = [each for each in suite.scenarios if each.vehicle is None]
    vehicles = {spec.label: _vehicle(spec, unfixed[0]).name for spec in specs} if unfixed else {}
    if any(each.reference for each in unfixed):
        vehicles["the reference"] = DEFAULT_VEHICLE
    if len(set(vehicles.values())) > 1:
        each_flies = ", ".join(f"{label} flies {vehicle}" for label, vehicle in vehicles.items())
        report(f"not all fly the same vehicle: {each_flies}; --vehicle gives all of them one")


def _begin(
    folder: Path, digest: str, jobs: Sequence[Job], overwrite: bool
) -> dict[tuple[str, str], Entry]:
    """What the same evaluation has flown before it was interrupted, but for factories, whose code
    may have changed.

    One that was finished has flown all, so that its table can be shown again; with factories it is
    other results.

    :raises ConfigError: the folder holds other results, and they are not to be overwritten; or
        damaged ones.
    """
    if not (folder / RESULTS).is_file():
        for name in WRITTEN:
            refuse_existing(folder / name, overwrite)
        return {}
    before = load_results(folder)
    certain = {job.name for job in jobs if job.record.kind != "factory"}
    if (
        before.digest == digest
        and not overwrite
        and (len(certain) == len(jobs) or not before.finished)
    ):
        return {entry.name: entry for entry in before.entries if entry.name in certain}
    if not overwrite:
        raise ConfigError(
            f"{folder}: holds results already; give another folder with -o, or remove them with --overwrite"
        )
    for name in WRITTEN:
        (folder / name).unlink(missing_ok=True)
    shutil.rmtree(folder / FLIGHTS, ignore_errors=True)
    return {}


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
