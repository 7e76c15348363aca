"""The jobs of an evaluation: a controller in a scenario each, flown one after another or by an executor's workers."""

import hashlib
import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from sb3_quad.base.arrays import Arrays
from sb3_quad.base.errors import SB3QuadError, WorkerDied
from sb3_quad.base.version import __version__
from sb3_quad.evaluation.controllers import ControllerSpec, build
from sb3_quad.evaluation.flightlog import episode_arrays
from sb3_quad.evaluation.folder import flights_path, write_entry
from sb3_quad.evaluation.records import SCHEMA_VERSION, ControllerRecord, Entry, Failure
from sb3_quad.evaluation.scenario_flights import find_limit, fly_scenario
from sb3_quad.evaluation.scenarios.scenario import DEFAULT_VEHICLE, Scenario
from sb3_quad.evaluation.summary import summarise
from sb3_quad.executors import Executor, as_completed
from sb3_quad.executors.travel import files_of, with_files
from sb3_quad.simulation.memory import Memory
from sb3_quad.vehicles.vehicle import load_vehicle

_SILENT = {"title", "description", "reference", "group", "cell"}  # fields of a scenario that change no flight
YOUNGER = {*Memory.model_fields, "rotor_layout"}  # than results and their keys: left out of them where they are not set


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
            observed = {key: value for key, value in self.spec.observed.items() if key not in YOUNGER or value}
            parts += [observed, vehicle and vehicle.model_dump(mode="json")]
        return _digest(parts)

    @property
    def flown(self) -> Scenario:
        """The scenario, on the vehicle that this controller flies there.

        :raises ConfigError: it is impossible for that vehicle.
        """
        return self.scenario.flown_by(self.spec.own and self.spec.own.vehicle)


class Flown(NamedTuple):
    """A job that is done: its record, and the flights in numbers."""

    entry: Entry
    arrays: Arrays


def fly_job(job: Job) -> Flown | Failure:
    """Fly and sum up; of a controller that fails, its :class:`Failure`."""
    label, scenario = job.record.label, job.scenario
    start = time.perf_counter()
    try:
        scenario = job.flown
        controller = build(job.spec, scenario.nominal_vehicle(), job.record.offset)
        own = job.spec.observed
        flights, trajectories = fly_scenario(controller, scenario, job.backend, recorded=None, own=own)
        limit = find_limit(controller, scenario, job.backend, own)
    except SB3QuadError as error:
        return failure(label, scenario.name, error)
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
    return Flown(entry, {**episode_arrays(flights, scenario.episode_seeds()), **trajectories})


def run_job(job: Job) -> Entry | Failure:
    """As :func:`fly_job`, and write."""
    done = fly_job(job)
    if isinstance(done, Failure):
        return done
    write_entry(Path(job.folder), *done)
    return done.entry


def _without_path(job: Job) -> Job:
    """The job with the vehicle that its scenario names, rather than the name of a file."""
    if job.scenario.vehicle is None:
        return job
    return replace(job, scenario=job.scenario.model_copy(update={"vehicle": job.scenario.nominal_vehicle()}))


def _fly_elsewhere(job: Job, keys: tuple[str, str], files: dict[str, bytes]) -> Flown | Failure:
    """As :func:`fly_job`, on a machine that has only those files of the controller that travelled along.

    :param keys: of the job, by the paths that it had before.
    """
    with TemporaryDirectory() as folder:
        spec = replace(job.spec, spec=with_files(job.spec.spec, files, Path(folder)))
        done = fly_job(replace(job, spec=spec))
    if isinstance(done, Failure):
        return done
    return done._replace(entry=done.entry.model_copy(update=dict(zip(("key", "scenario_key"), keys, strict=True))))


def run_jobs(jobs: Sequence[Job], executor: Executor | None = None) -> Iterator[tuple[Job, Entry | Failure]]:
    """Do jobs, and hand out each as it is done.

    A job whose worker process ends, as a crash or too little memory makes it, becomes a :class:`Failure`.

    :param executor: None: they are done one after another, here.
    :raises SB3QuadError: a folder that cannot be written.
    """
    if executor is None:
        yield from ((job, run_job(job)) for job in jobs)
        return
    if executor.remote:
        submitted = {
            executor.submit(_fly_elsewhere, _without_path(job), (job.key, job.scenario_key), files_of(job.spec.spec)): job
            for job in jobs
        }
    else:
        submitted = {executor.submit(run_job, job): job for job in jobs}
    for task in as_completed(executor):
        job = submitted[task]
        try:
            outcome = task.result()
        except WorkerDied as ended:
            outcome = failure(job.record.label, job.scenario.name, ended)
        if isinstance(outcome, Flown):
            write_entry(Path(job.folder), *outcome)
            outcome = outcome.entry
        yield job, outcome


def failure(controller: str, scenario: str | None, error: SB3QuadError) -> Failure:
    """The record of an error, in one line; without a scenario, the controller could not be loaded."""
    return Failure(controller=controller, scenario=scenario, message=" ".join(str(error).split()))


def _digest(content: Any) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
