"""The jobs of an evaluation: a controller in a scenario each, flown one after another or by worker processes."""

import hashlib
import json
import multiprocessing
import os
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import cached_property
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import torch

from sb3_quad import __version__
from sb3_quad.base.errors import ControllerError, SB3QuadError
from sb3_quad.base.signals import ignore_interrupts
from sb3_quad.evaluation.controllers import ControllerSpec, build
from sb3_quad.evaluation.flightlog import episode_arrays
from sb3_quad.evaluation.folder import flights_path, write_entry
from sb3_quad.evaluation.records import SCHEMA_VERSION, ControllerRecord, Entry, Failure
from sb3_quad.evaluation.scenario_flights import find_limit, fly_scenario
from sb3_quad.evaluation.summary import summarise
from sb3_quad.scenarios.scenario import DEFAULT_VEHICLE, Scenario
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
                outcome = failure(job.record.label, job.scenario.name, ended)
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


def failure(controller: str, scenario: str | None, error: SB3QuadError) -> Failure:
    """The record of an error, in one line; without a scenario, the controller could not be loaded."""
    return Failure(controller=controller, scenario=scenario, message=" ".join(str(error).split()))


def _digest(content: Any) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
