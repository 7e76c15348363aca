"""A suite for any number of controllers: what is not in the folder yet is flown, the rest is kept."""

import hashlib
import itertools
import json
import multiprocessing
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from functools import cached_property
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import torch

from sb3_quad import __version__
from sb3_quad.base.errors import ConfigError, ControllerError, SB3QuadError, unknown
from sb3_quad.base.files import locked
from sb3_quad.base.signals import ignore_interrupts
from sb3_quad.evaluation.controllers import ControllerSpec, build, describe
from sb3_quad.evaluation.fleets import FLEETS
from sb3_quad.evaluation.flightlog import episode_arrays
from sb3_quad.evaluation.folder import RESULTS, flights_path, load_results, read_entries, write_entry, write_results
from sb3_quad.evaluation.records import SCHEMA_VERSION, ControllerRecord, Entry, Failure, Results
from sb3_quad.evaluation.scenario_flights import find_limit, fly_scenario
from sb3_quad.evaluation.summary import summarise
from sb3_quad.scenarios.scenario import DEFAULT_VEHICLE, Scenario, Suite
from sb3_quad.vehicles.vehicle import load_vehicle

Progress = Callable[[int, int, str], None]  # jobs done, jobs in all, what was done last
_SILENT = {"title", "description", "reference", "group", "cell"}  # fields of a scenario that change no flight


@dataclass(frozen=True)
class Job:
    """A controller in a scenario.

    :param scenario: as the suite has it.
    :param folder: path of the folder that its :class:`Entry` is left in.
    """

    spec: ControllerSpec
    record: ControllerRecord
    scenario: Scenario
    backend: str
    folder: str

    @cached_property
    def scenario_key(self) -> str:
        """A hash of all that the flights depend on but the controller: equal keys, equal episodes."""
        scenario = self.scenario
        vehicles = [vehicle.model_dump(mode="json") for vehicle in (scenario.nominal_vehicle(), scenario.flown_vehicle())]
        content = scenario.model_dump(mode="json", exclude=_SILENT)
        content["vehicle"] = content["vehicle"] or DEFAULT_VEHICLE
        return _digest([SCHEMA_VERSION, __version__, self.backend, content, vehicles])

    @cached_property
    def key(self) -> str:
        """A hash of all that the flights depend on: equal keys, equal flights."""
        parts: list[Any] = [self.scenario_key, self.record.content, self.record.scaling, self.record.offset]
        if self.spec.own is not None:  # a zip holds it, or what lies beside it
            vehicle = load_vehicle(self.spec.own.vehicle) if self.scenario.vehicle is None else None
            parts += [self.spec.observed, vehicle and vehicle.model_dump(mode="json")]
        return _digest(parts)

    @property
    def flown(self) -> Scenario:
        """The scenario, on the vehicle that this controller flies there.

        :raises ConfigError: it is impossible for that vehicle.
        """
        return self.scenario.flown_by(self.spec.own and self.spec.own.vehicle)


def evaluate(
    suite: Suite,
    controllers: Sequence[ControllerSpec],
    folder: str,
    backend: str = "batch",
    workers: int = 1,
    overwrite: bool = False,
    progress: Progress = lambda done, total, name: None,
    report: Callable[[str], None] = lambda line: None,
) -> Results:
    """Fly all scenarios of a suite by all controllers, on the same episodes.

    A controller that cannot be loaded, or fails in a scenario, becomes a :class:`Failure`; the others fly on. What an
    interrupted call has done is kept and not flown again.

    :param folder: of the results.
    :param overwrite: replace earlier results of these controllers that were flown otherwise, instead of refusing.
    :param report: told in one line of each agent that flies another vehicle than it was trained on, or does not say on which.
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
            failures.append(_failure(spec.label, None, error))
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
            for job, outcome in run_jobs(missing, workers):
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


def run_job(job: Job) -> Entry | Failure:
    """Fly, sum up, write; of a controller that fails, its :class:`Failure`."""
    label, scenario = job.record.label, job.scenario
    start = time.perf_counter()
    try:
        scenario = job.flown
        controller = build(job.spec, scenario.nominal_vehicle(), job.record.offset)
        own = job.spec.observed
        flights, trajectories = fly_scenario(controller, scenario, job.backend, recorded=None, own=own)
        limit = find_limit(controller, scenario, job.backend, own)
    except SB3QuadError as error:
        return _failure(label, scenario.name, error)
    entry = Entry(
        controller=label,
        scenario=scenario.name,
        key=job.key,
        scenario_key=job.scenario_key,
        seed=scenario.seed,
        backend=job.backend,
        seconds=round(time.perf_counter() - start, 3),
        date=time.strftime("%Y-%m-%d", time.gmtime()),
        figures=summarise(flights),
        hit_limit=limit,
        flights=flights_path(label, scenario.name),
    )
    write_entry(Path(job.folder), entry, {**episode_arrays(flights, scenario.episode_seeds()), **trajectories})
    return entry


def run_jobs(jobs: Sequence[Job], workers: int) -> Iterator[tuple[Job, Entry | Failure]]:
    """Do jobs, one after another or by worker processes, and hand out each as it is done.

    A job whose worker process ends, as a crash or too little memory makes it, becomes a :class:`Failure`.

    :raises SB3QuadError: a folder that cannot be written.
    """
    if workers <= 1 or len(jobs) <= 1:
        yield from ((job, run_job(job)) for job in jobs)
        return
    context = multiprocessing.get_context("spawn")
    watched, held = context.Pipe(duplex=False)  # what holds it open is closed below, or ends with this process
    waiting, idle, at_work = deque(jobs), list[ProcessPoolExecutor](), dict[Future[Any], tuple[Job, ProcessPoolExecutor]]()
    try:
        while waiting or at_work:
            while waiting and len(at_work) < workers:
                pool = idle.pop() if idle else ProcessPoolExecutor(1, context, _begin_worker, (watched,))
                job = waiting.popleft()
                at_work[pool.submit(run_job, job)] = job, pool
            future = wait(at_work, return_when=FIRST_COMPLETED).done.pop()
            job, pool = at_work.pop(future)
            try:
                outcome = future.result()
                idle.append(pool)
            except BrokenProcessPool:  # one process a pool, so that the job is known, and no other is lost
                pool.shutdown()
                ended = ControllerError("its worker process ended unexpectedly (out of memory?)")
                outcome = _failure(job.record.label, job.scenario.name, ended)
            yield job, outcome
    finally:
        for pool in idle:
            pool.shutdown()
        held.close()
        for _, pool in at_work.values():
            pool.shutdown(cancel_futures=True)
        watched.close()


def _begin_worker(watched: Connection) -> None:
    ignore_interrupts()  # the process that started the workers ends them
    threading.Thread(target=_end_with_evaluation, args=(watched,), daemon=True).start()
    torch.set_num_threads(1)


def _end_with_evaluation(watched: Connection) -> None:
    """End this worker as soon as the evaluation that it works for is left, also by being killed."""
    watched.poll(None)
    os._exit(1)


def _failure(controller: str, scenario: str | None, error: SB3QuadError) -> Failure:
    return Failure(controller=controller, scenario=scenario, message=" ".join(str(error).split()))


def _digest(content: Any) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
