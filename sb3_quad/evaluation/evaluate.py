"""A suite for any number of controllers: flown scenario by scenario, summarised, and written into a
folder.
"""

import hashlib
import multiprocessing
import os
import threading
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

import torch

from sb3_quad.agents.agent_settings import settings_of_model
from sb3_quad.agents.resolve import resolve_expert
from sb3_quad.base import __version__
from sb3_quad.base.errors import ConfigError, SB3QuadError, WorkerDied, refuse_unknown
from sb3_quad.base.files import locked, make_folder, refuse_existing, write_arrays
from sb3_quad.base.process import ignore_interrupts
from sb3_quad.base.types import Arrays, Report, StrMapping
from sb3_quad.envs import registration
from sb3_quad.envs.vehicles.vehicle import Vehicle, first_vehicle
from sb3_quad.evaluation.controllers import ControllerSpec, controller_record
from sb3_quad.evaluation.fleets import FLEETS
from sb3_quad.evaluation.flightlog import Recorder, episode_arrays
from sb3_quad.evaluation.flights import Flights, fly_settings
from sb3_quad.evaluation.hooks import Hook
from sb3_quad.evaluation.metrics import summarise
from sb3_quad.evaluation.results import (
    FLIGHTS,
    RESULTS,
    WRITTEN,
    ControllerRecord,
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
RECORDED = 8  # flights of each job whose trajectories are kept
Progress = Callable[[int, int, str], None]  # jobs done, jobs in all, the last one done


class Job(NamedTuple):
    """A controller in a scenario.

    :param reward: your own, as a function or ``package.module:function``; None: none.
    """

    spec: ControllerSpec
    scenario: Scenario
    backend: str
    reward: OwnReward

    @property
    def name(self) -> tuple[str, str]:
        """Scenario and controller, as in :class:`~sb3_quad.evaluation.results.Entry`."""
        return self.scenario.name, self.spec.label


def evaluate(
    suite: Suite,
    controllers: Sequence[ControllerSpec],
    folder: str,
    backend: str = "batch",
    workers: int = 1,
    overwrite: bool = False,
    progress: Progress = lambda done, total, name: None,
    report: Report = lambda line: None,
    reward: OwnReward = None,
) -> Results:
    """Fly all scenarios of a suite with all controllers, on the same episodes.

    A controller that cannot be loaded, or fails in a scenario, becomes a :class:`Failure`; the
    others still fly. Repeat an interrupted call and it resumes. Only factories, or all controllers
    if there is a reward of your own, fly again, since their code may have changed.

    :param folder: folder of the results; it is not made if no controller can be loaded.
    :param workers: processes that fly at the same time; with one, this process flies.
    :param overwrite: remove the results in the folder, instead of refusing it, and start from
        scratch.
    :param report: gets a line for each agent that flies another vehicle than it was trained on, or
        does not say on which.
    :param reward: a reward of your own, see :func:`~sb3_quad.evaluation.flights.fly`, or
        ``package.module:function``.
    :raises ConfigError: an unknown backend; a reward that cannot be imported; a folder that holds
        results of another call, that cannot be written, or that another process is writing to.
    :raises WorkerDied: a worker that ended before its task; what the others have flown is written.
    """
    refuse_unknown("backend", [backend], FLEETS)
    if backend == "pybullet":
        # Here a missing PyBullet is a single error, rather than one for each controller.
        from sb3_quad.envs.rendering import bullet_client  # noqa: F401
    if workers < 1:
        raise ConfigError(f"workers {workers}: must be at least 1")
    # An error in it shows now, rather than as a failure of each controller.
    load_reward(reward)

    records, failures = _load_controllers(suite, controllers, report)
    # Go scenario by scenario, so that even an interrupted suite compares all controllers.
    jobs = [
        Job(spec, scenario, backend, reward) for scenario in suite.scenarios for spec in records
    ]
    reward_as_named = reward_name(reward)
    results = Results(
        suite=suite.name,
        description=suite.description,
        source=suite.source,
        reward=reward_as_named,
        package_version=__version__,
        controllers=[*records.values()],
        scenarios=suite.scenarios,
        entries=[],
        failures=failures,
        digest=_digest(suite, records, backend, reward_as_named),
    )
    place = Path(folder)
    # Without a controller there is nothing to write, and no folder.
    if jobs:
        make_folder(place, "results folder", "-o")
        with locked(place, "folder"):
            results.entries.extend(_resume(place, results.digest, jobs, overwrite))
            return _fly_missing(place, results, jobs, workers, progress)
    return results


def _load_controllers(
    suite: Suite, specs: Sequence[ControllerSpec], report: Report
) -> tuple[dict[ControllerSpec, ControllerRecord], list[Failure]]:
    """Load the controllers; report those that fly another vehicle than they were trained on."""
    records = {}
    failures = []
    flown = {}
    for spec in specs:
        try:
            record = controller_record(spec)
            vehicles = [_vehicle(spec, scenario) for scenario in suite.scenarios]
            # Several scenarios give the same notice, or an empty one: report it once.
            notices = dict.fromkeys(map(spec.notice, vehicles))
        except SB3QuadError as error:
            failures.append(_failure((None, spec.label), error))
            continue
        records[spec] = record
        for notice in filter(None, notices):
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
    return records, failures


def _fly_missing(
    place: Path,
    results: Results,
    jobs: Sequence[Job],
    workers: int,
    progress: Progress,
) -> Results:
    """Fly the jobs without an entry, and write everything into the folder."""
    # Workers finish in any order; the entries are in that of the suite.
    order = [job.name for job in jobs]
    done = {entry.name for entry in results.entries}
    missing = [job for job in jobs if job.name not in done]
    progress(len(done), len(jobs), "")
    # Closed, so that the workers end at once if an outcome cannot be written.
    with closing(_fly_jobs(missing, workers)) as flown:
        for number, (job, outcome) in enumerate(flown, len(done) + 1):
            if isinstance(outcome, Failure):
                results.failures.append(outcome)
            else:
                entry, arrays = outcome
                write_arrays(place / entry.flights, compressed=True, **arrays)
                results.entries.append(entry)
                results.entries.sort(key=lambda entry: order.index(entry.name))
                # Write after each job, so that an interrupted evaluation can resume.
                results.write(place, finished=False)
            progress(number, len(jobs), f"{job.spec.label}: {job.scenario.heading}")
    if results.entries:
        write_episodes(place, results.entries)
        results.write(place, finished=True)
    return results


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


def fly_job(job: Job) -> tuple[Entry, Arrays] | Failure:
    """Fly a job and summarise it.

    :return: the entry, and the arrays of its flights (``flightlog.py``); or the failure of the
        controller.
    """
    start = time.perf_counter()
    own = job.spec.own
    try:
        scenario = job.scenario.flown_by(own and own.vehicle)
        controller = resolve_expert(job.spec.spec, scenario.nominal_vehicle(), "controller")
        observed = job.spec.observed
        # A model from a factory says only now what it observes.
        known = settings_of_model(controller)
        if known is not None:
            observed = known.carried
        recorder = Recorder(RECORDED)
        reward = load_reward(job.reward)
        flights = fly_scenario(controller, scenario, job.backend, [recorder], observed, reward)
    except SB3QuadError as error:
        return _failure(job.name, error)
    entry = Entry(
        controller=job.spec.label,
        scenario=scenario.name,
        seed=scenario.seed,
        backend=job.backend,
        seconds=round(time.perf_counter() - start, 3),
        date=time.strftime("%Y-%m-%d", time.gmtime()),
        metrics=summarise(flights),
        physical_limit=scenario.physical_limit,
        flights=f"{FLIGHTS}/{file_name(job.spec.label)}/{scenario.name}.npz",
    )
    return entry, {**episode_arrays(flights, scenario.episode_seeds()), **recorder.arrays()}


def _fly_jobs(
    jobs: Sequence[Job], workers: int
) -> Generator[tuple[Job, tuple[Entry, Arrays] | Failure], None, None]:
    """Fly jobs and yield each when it is done: in this process, or in workers.

    :raises WorkerDied: a worker that ended by a crash, or because memory was short.
    """
    if min(workers, len(jobs)) <= 1:
        for job in jobs:
            yield job, fly_job(job)
        return
    # Threads do not survive a fork.
    context = multiprocessing.get_context("spawn")
    alive, end = context.Pipe(duplex=False)
    pool = ProcessPoolExecutor(workers, context, _begin_worker, (alive,))
    submitted = {pool.submit(fly_job, job): job for job in jobs}
    try:
        for future in as_completed(submitted):
            yield submitted[future], future.result()
    except BrokenProcessPool:
        raise WorkerDied(
            "a worker process ended unexpectedly (out of memory?); "
            "repeat the command with fewer --workers to fly what is left"
        ) from None
    finally:
        end.close()
        pool.shutdown(cancel_futures=True)


def _begin_worker(alive: Connection) -> None:
    """Prepare a worker, which ends when the other end of ``alive`` is closed: by the process that
    started it, or because that was killed.
    """
    ignore_interrupts()
    torch.set_num_threads(1)
    threading.Thread(target=_end_with_starter, args=[alive], daemon=True).start()


def _end_with_starter(alive: Connection) -> None:
    with suppress(EOFError):
        alive.recv()
    os._exit(1)


def _vehicle(spec: ControllerSpec, scenario: Scenario) -> Vehicle:
    """The vehicle that a controller flies in a scenario: the scenario's, otherwise its own."""
    if scenario.vehicle is not None or spec.own is None:
        return scenario.nominal_vehicle()
    return first_vehicle(spec.own.vehicle)


def _resume(folder: Path, digest: str, jobs: Sequence[Job], overwrite: bool) -> list[Entry]:
    """Return the entries that an interrupted call of the same evaluation has left.

    A finished evaluation has flown all jobs, so that its table can be shown again. Jobs that may
    not repeat exactly are left out, and a finished evaluation with such jobs counts as other
    results.

    :raises ConfigError: the folder holds other results that are not to be overwritten, or damaged
        ones.
    """
    if not (folder / RESULTS).is_file():
        for name in WRITTEN:
            refuse_existing(folder / name, overwrite)
        return []
    before = load_results(folder)
    if overwrite:
        # Start from scratch: all numbers in a folder are those of one command.
        for name in WRITTEN:
            (folder / name).unlink(missing_ok=True)
        # Only files of the results; users may keep other files beside them.
        made = [folder / entry.flights for entry in before.entries]
        for file in (folder / FLIGHTS).glob("*/*.npz"):
            if file in made:
                file.unlink()
        return []
    # Code outside of this package may have changed: that of a factory or of a user's reward.
    kept = {job.name for job in jobs if job.spec.kind != "factory" and job.reward is None}
    if before.digest != digest or (before.finished and len(kept) < len(jobs)):
        raise ConfigError(
            f"{folder}: holds results already; give another folder with -o,"
            " or remove them with --overwrite"
        )
    return [entry for entry in before.entries if entry.name in kept]


def _digest(
    suite: Suite, records: Mapping[ControllerSpec, ControllerRecord], backend: str, reward: str
) -> str:
    """Hash all inputs of the flights, the sources of this package included (SHA-256)."""
    digest = hashlib.sha256()
    # The environments lie next to the package in a checkout, inside it when installed.
    for folder in (Path(__file__).parents[1], Path(registration.__file__).parent):
        for path in sorted([*folder.rglob("*.py"), *folder.rglob("*.yaml")]):
            digest.update(path.read_bytes())
    own = [(spec.own, spec.own and first_vehicle(spec.own.vehicle)) for spec in records]
    digest.update(repr((suite, records, own, backend, reward)).encode())
    for scenario in suite.scenarios:
        if scenario.reference and scenario.reference.file:
            digest.update(Path(scenario.reference.file).read_bytes())
    return digest.hexdigest()


def _failure(name: tuple[str | None, str], error: SB3QuadError) -> Failure:
    """Return the record of an error, in one line.

    :param name: name of the job; without a scenario, the controller did not load.
    """
    scenario, controller = name
    return Failure(controller=controller, scenario=scenario, message=" ".join(str(error).split()))
