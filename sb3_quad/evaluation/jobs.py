"""One controller in one scenario: flown, summed up, kept in the folder; by this process or by workers."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Any

import numpy as np

from sb3_quad.base.errors import SB3QuadError
from sb3_quad.evaluation.controllers import ControllerSpec, build
from sb3_quad.evaluation.flightlog import episode_arrays
from sb3_quad.evaluation.folder import ResultFolder
from sb3_quad.evaluation.hits import find_limit
from sb3_quad.evaluation.records import SCHEMA_VERSION, ControllerRecord, Entry, Failure
from sb3_quad.evaluation.scenario_flights import fly_scenario
from sb3_quad.evaluation.summary import summarise
from sb3_quad.scenarios.scenario import Scenario

_SILENT = {"title", "description", "reference", "group", "cell"}  # fields that change no flight


@dataclass(frozen=True)
class Job:
    """A controller in a scenario.

    :param key: of the :class:`Entry` it leaves.
    :param folder: path of the folder it is left in.
    """

    spec: ControllerSpec
    record: ControllerRecord
    scenario: Scenario
    backend: str
    scenario_key: str
    key: str
    folder: str


def make_job(spec: ControllerSpec, record: ControllerRecord, scenario: Scenario, backend: str, folder: str) -> Job:
    """The job, and the keys that tell whether its flights are there already."""
    own = scenario_key(scenario, backend)
    key = _digest([own, record.content, record.scaling, record.offset])
    return Job(spec, record, scenario, backend, own, key, folder)


def scenario_key(scenario: Scenario, backend: str) -> str:
    """A hash of all that the flights depend on but the controller: equal keys, equal episodes."""
    from sb3_quad import __version__

    vehicles = [vehicle.model_dump(mode="json") for vehicle in (scenario.nominal_vehicle(), scenario.flown_vehicle())]
    content = scenario.model_dump(mode="json", exclude=_SILENT)
    return _digest([SCHEMA_VERSION, __version__, backend, content, vehicles])


def run_job(job: Job) -> Entry | Failure:
    """Fly, sum up, write; a controller that fails leaves a :class:`Failure`."""
    folder, scenario = ResultFolder(job.folder), job.scenario
    start = time.perf_counter()
    try:
        controller = build(job.spec, scenario.vehicle, job.record.offset)
        flights, trajectories = fly_scenario(controller, scenario, job.backend, recorded=None)
        limit = find_limit(controller, scenario, job.backend) if scenario.hit_search is not None else None
    except SB3QuadError as error:
        return Failure(controller=job.record.label, scenario=scenario.name, message=" ".join(str(error).split()))
    entry = Entry(
        controller=job.record.label,
        scenario=scenario.name,
        key=job.key,
        scenario_key=job.scenario_key,
        seed=scenario.seed,
        backend=job.backend,
        seconds=round(time.perf_counter() - start, 3),
        figures=summarise(flights),
        hit_limit=limit,
        flights=folder.flights_path(job.record.label, scenario.name),
    )
    seeds = np.arange(scenario.seed, scenario.seed + scenario.episodes)
    folder.write_entry(entry, {**episode_arrays(flights, seeds), **trajectories})
    return entry


def run_jobs(jobs: Sequence[Job], workers: int) -> Iterator[tuple[Job, Entry | Failure]]:
    """Do jobs, one after another or by worker processes, and hand out each as it is done.

    :raises SB3QuadError: a folder that cannot be written.
    """
    if workers <= 1 or len(jobs) <= 1:
        for job in jobs:
            yield job, run_job(job)
        return
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(min(workers, len(jobs)), context, _begin_worker)
    try:
        waiting = {pool.submit(run_job, job): job for job in jobs}
        for future in as_completed(waiting):
            yield waiting[future], future.result()
    except BrokenProcessPool:
        raise SB3QuadError("a worker process ended unexpectedly (out of memory?); try --workers 1") from None
    finally:
        pool.shutdown(cancel_futures=True)


def _begin_worker() -> None:
    import torch

    from sb3_quad.base.signals import ignore_interrupts

    ignore_interrupts()  # the process that started the workers ends them
    torch.set_num_threads(1)


def _digest(content: Any) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
