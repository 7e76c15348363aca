"""What a worker does: train a run of a sweep as ``train`` does, or what is left of it, and fly its agent."""

import hashlib
import shutil
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_quad.base.cores import use_cpus
from sb3_quad.base.errors import ConfigError, SB3QuadError
from sb3_quad.base.files import one_line
from sb3_quad.base.imports import import_packages, require
from sb3_quad.base.seeds import row_seeds, seed_for
from sb3_quad.base.validate import validate
from sb3_quad.controllers.zips import load_model, saved_data
from sb3_quad.evaluation.controllers import ControllerSpec, build
from sb3_quad.evaluation.flights import Flights, fly_settings
from sb3_quad.evaluation.scenario_flights import fly_scenario
from sb3_quad.evaluation.scenarios.scenario import Suite
from sb3_quad.executors.travel import pack, unpack, with_files
from sb3_quad.simulation.settings import FlightSettings
from sb3_quad.sweep.expand import Run
from sb3_quad.sweep.records import MEASURES, REWARD, Numbers, RunRecord
from sb3_quad.training.config import build_config
from sb3_quad.training.environments import make_environments
from sb3_quad.training.job import TrainingJob
from sb3_quad.training.pipeline import STATUS_FILE, resume_pipeline, run_pipeline
from sb3_quad.training.runs import RunFolder, file_name
from sb3_quad.training.trainer import resume, train

EPISODES = 240  # of each task, where no suite is named
TASKS = ("state_recovery", "target_tracking")
LOG = "log.txt"  # what the training reports, in the run's folder


class Flying(NamedTuple):
    """What the agents fly; without a suite, fresh episodes of both tasks."""

    suite: Suite | None
    episodes: int
    seed: int


class Trained(NamedTuple):
    """A training that ended."""

    agent: Path
    job: TrainingJob
    timesteps: int
    seconds: float


def work(run: Run, folder: str, flying: Flying) -> RunRecord:
    """Train a run in its folder, or what is left of it, and fly its agent; of a run that fails, why."""
    use_cpus(1)
    name: dict[str, Any] = {"name": run.name, "configuration": run.configuration, "seed": run.seed}
    place = Path(folder)
    try:
        place.mkdir(parents=True, exist_ok=True)
        import_packages(run.gym_packages, "gym_packages:")
        trained = _train_pipeline(run, place) if run.pipeline is not None else _train_single(run, place)
        if trained is None:
            return RunRecord(**name, state="interrupted")
        flights = _fly(trained, flying)
    except KeyboardInterrupt:
        return RunRecord(**name, state="interrupted")
    except (Exception, SystemExit) as error:  # of a callback or environment of the user's, too; the other runs go on
        kind = "" if isinstance(error, SB3QuadError) else f"{type(error).__name__}: "
        return RunRecord(**name, state="failed", message=kind + one_line(error))
    return RunRecord(
        **name,
        state="finished",
        agent=trained.agent.relative_to(place).as_posix(),
        weights=digest(trained.agent),
        timesteps=trained.timesteps,
        seconds=round(trained.seconds, 1),
        flights=flights,
    )


def work_elsewhere(
    run: Run, flying: Flying, files: Mapping[str, bytes], begun: bytes, home: str, storage: str | None
) -> tuple[RunRecord, bytes | str]:
    """As :func:`work`, on a machine that does not see the sweep's folder.

    :param files: that the run's settings name.
    :param begun: the run's folder so far, packed.
    :param home: where that folder lies on the machine that asks.
    :param storage: where the packed folder is left; None: it is returned.
    """
    with TemporaryDirectory(prefix="sb3_quad-run-") as temporary:
        place, near = Path(temporary, "run"), Path(temporary, "files")
        unpack(begun, place)
        _rename(place, home, str(place))
        there = validate(Run, with_files(run.model_dump(mode="json"), files, near), f"run {run.name}")
        record = work(there, str(place), flying)
        _rename(place, str(place), home)
        for number, path in enumerate(files):
            _rename(place, str(near / f"{number}_{Path(path).name}"), path)
        content = pack(place)
    return record, content if storage is None else _store(content, storage, run.name)


def standing(run: Run, folder: Path) -> str:
    """How far a run is that has no record yet, in words; empty if it has not begun."""
    if run.pipeline is not None:
        return "goes on in its pipeline" if _pipeline_folder(run, folder) is not None else ""
    found = _run_folder(run, folder)
    if found is None:
        return ""
    if _is_trained(run, found):
        return "is trained, and only flown"
    return "goes on from its snapshot" if found.resume_state.is_file() else "begins again"


def digest(agent: Path) -> str:
    """The SHA-256 of the parameters in an agent's zip."""
    parameters = load_model(agent).policy.state_dict()
    content = b"".join(name.encode() + tensor.numpy().tobytes() for name, tensor in sorted(parameters.items()))
    return hashlib.sha256(content).hexdigest()


def _train_single(run: Run, place: Path) -> Trained | None:
    config = build_config(run.algo, run.env, run.settings)
    job = validate(TrainingJob, {**run.job, "seed": run.seed, "log_folder": str(place), "config": config}, run.name)
    report, found = _log(place), _run_folder(run, place)
    if found is not None and _is_trained(run, found):
        return Trained(found.result, job, int(saved_data(found.model)["num_timesteps"]), 0.0)
    if found is not None and (found.resume_state.is_file() or found.not_begun):
        result = resume(str(found.path), report)
    else:
        if found is not None:  # an error ended it, and left no snapshot
            shutil.rmtree(found.path)
        result = train(job, report)
    if result.exit_code != 0:
        return None
    return Trained(result.run.result, job, result.model.num_timesteps, result.seconds)


def _train_pipeline(run: Run, place: Path) -> Trained | None:
    assert run.pipeline is not None
    report, found = _log(place), _pipeline_folder(run, place)
    if found is not None:
        result = resume_pipeline(found, report)
    else:
        result = run_pipeline(run.pipeline, {**run.job, "seed": run.seed, "log_folder": str(place)}, run.stem, report)
    if result.exit_code != 0:
        return None
    stages = list(result.stages.values())
    timesteps, seconds = sum(stage.timesteps for stage in stages), sum(stage.seconds for stage in stages)
    return Trained(Path(stages[-1].agent), result.job, timesteps, seconds)


def _run_folder(run: Run, place: Path) -> RunFolder | None:
    name = file_name(run.env)
    folders = [RunFolder(path, name) for path in sorted((place / run.algo).glob(f"{name}_*"))]
    return next((folder for folder in folders if folder.config.is_file() and folder.arguments.is_file()), None)


def _is_trained(run: Run, folder: RunFolder) -> bool:
    if folder.resume_state.is_file() or not folder.model.is_file():
        return False
    return int(saved_data(folder.model)["num_timesteps"]) >= build_config(run.algo, run.env, run.settings).n_timesteps


def _pipeline_folder(run: Run, place: Path) -> Path | None:
    return next((path.parent for path in sorted((place / run.stem).glob(f"{run.stem}_*/{STATUS_FILE}"))), None)


def _log(place: Path) -> Any:
    def report(line: str) -> None:
        with (place / LOG).open("a", encoding="utf-8") as file:
            file.write(f"{line}\n")

    return report


def _fly(trained: Trained, flying: Flying) -> dict[str, dict[str, Numbers]]:
    """The numbers of an agent's flights, by scenario and measure."""
    job = trained.job
    if job.config.task is None:  # an environment of others has rewards, and no scenarios
        if flying.suite is not None:
            raise ConfigError(f"evaluation: suites are for this package's environments, not for {job.config.env_id}")
        config = job.for_evaluation()
        with closing(make_environments(config, 1, seed_for("table", flying.seed))) as env:
            model = load_model(trained.agent)
            rewards, _ = evaluate_policy(model, env, flying.episodes, return_episode_rewards=True)
        return {config.env_id: {REWARD: tuple(np.asarray(rewards, dtype=np.float64).tolist())}}
    if flying.suite is None:
        seeds, how = row_seeds(seed_for("table", flying.seed), flying.episodes), job.flight_settings.in_any_task()
        model = load_model(trained.agent)
        return {task: _numbers(fly_settings(model, FlightSettings(task=task, **how), seeds)) for task in TASKS}
    spec, found = ControllerSpec("agent", str(trained.agent)), {}
    for each in flying.suite.scenarios:
        scenario = each.flown_by(spec.own and spec.own.vehicle)
        controller = build(spec, scenario.nominal_vehicle())
        found[each.name] = _numbers(fly_scenario(controller, scenario, own=spec.observed)[0])
    return found


def _numbers(flights: Flights) -> dict[str, Numbers]:
    error = np.where(flights.survival, flights.final_error, np.nan)
    arrival = flights.time_to[min(flights.time_to)] if flights.time_to else np.full(flights.n, np.nan)
    time = np.where(np.isfinite(flights.sideways), arrival, flights.stabilised)  # who starts at the target has no way to it
    columns = (flights.success, flights.survival, flights.reward, error, time)
    return {
        name: tuple(float(value) if np.isfinite(value) else None for value in column)
        for name, column in zip(MEASURES, columns, strict=True)
    }


def _rename(place: Path, before: str, after: str) -> None:
    """Have the settings in a run's folder name another folder."""
    for path in place.rglob("*.yml"):
        text = path.read_text(encoding="utf-8")
        if before in text:
            path.write_text(text.replace(before, after), encoding="utf-8")


def _store(content: bytes, storage: str, name: str) -> str:
    fsspec = require("fsspec", "ray", "storage")
    url = f"{storage.rstrip('/')}/{name}.tar"
    with fsspec.open(url, "wb", auto_mkdir=True) if "://" not in storage else fsspec.open(url, "wb") as file:
        file.write(content)
    return url


def fetch(stored: bytes | str) -> bytes:
    """A run's packed folder, from where :func:`work_elsewhere` left it."""
    if isinstance(stored, bytes):
        return stored
    with require("fsspec", "ray", "storage").open(stored, "rb") as file:
        return bytes(file.read())
