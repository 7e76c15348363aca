"""Doing the runs of a sweep by an executor, and what a worker does of it: train as ``train`` does,
and fly the agent.
"""

import hashlib
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import closing
from pathlib import Path

import numpy as np
import yaml
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_quad.base.errors import ConfigError, SB3QuadError, WorkerDied
from sb3_quad.base.files import one_line, write_text
from sb3_quad.base.imports import import_packages
from sb3_quad.base.process import StopSignals, use_cpus
from sb3_quad.base.seeds import row_seeds, seed_for
from sb3_quad.controllers.zips import load_model
from sb3_quad.evaluation.controllers import ControllerSpec
from sb3_quad.evaluation.evaluate import fly_scenario
from sb3_quad.evaluation.flights import Flights, fly_settings
from sb3_quad.evaluation.scenarios.scenario import Suite
from sb3_quad.executors import Executor, as_they_end
from sb3_quad.simulation.settings import FlightSettings
from sb3_quad.sweep.expand import Run
from sb3_quad.sweep.folder import MEASURES, REWARD, Numbers, Plan, RunRecord, SweepFolder
from sb3_quad.sweep.spec import Evaluation
from sb3_quad.training.config import TrainingJob
from sb3_quad.training.environments import make_environments
from sb3_quad.training.pipeline import (
    STATUS_FILE,
    Pipeline,
    PipelineResult,
    resume_pipeline,
    run_pipeline,
)

EPISODES = 240  # of each task, where no suite is named
TASKS = ("state_recovery", "target_tracking")
TRIES = 2  # of a run whose worker process dies
Show = Callable[[int, int, str], None]  # runs that ended, runs in all, what they are called
LOG = "log.txt"  # what the training reports, in the run's folder


def execute(
    place: SweepFolder,
    plan: Plan,
    executor: Executor,
    signals: StopSignals,
    show: Show,
    report: Callable[[str], None],
) -> dict[str, RunRecord]:
    """Do all runs that are not finished.

    A run whose worker process ends is tried once more, from its snapshot; one that fails is left,
    and the others go on. After a signal, the runs under way save and end.

    :param report: told of each event in one line.
    :return: the records of all runs that ended, those of earlier calls included, by name.
    :raises ConfigError: a folder that cannot be written, a full disk.
    """
    known = place.records(plan.runs)
    records = {name: record for name, record in known.items() if record.state == "finished"}
    calls, tries = dict["Future[RunRecord]", Run](), Counter[str]()

    def submit(run: Run) -> None:
        calls[executor.submit(work, run, str(place.run(run)), plan.suite, plan.spec.evaluation)] = (
            run
        )
        tries[run.name] += 1

    def next_step(run: Run) -> str:
        return (
            "goes on where it was left"
            if pipeline_folder(place.run(run)) is not None
            else "begins again"
        )

    for run in plan.runs:
        if run.name in records:
            continue
        if run.name in known:
            report(f"{run.name}: failed before ({known[run.name].message}); {next_step(run)}")
        elif pipeline_folder(place.run(run)) is not None:
            report(f"{run.name}: {next_step(run)}")
        submit(run)
    show(len(records), len(plan.runs), "runs")
    for run, future in as_they_end(executor, calls, signals, report):
        try:
            record = future.result()
        except WorkerDied as died:
            if signals.received is not None:
                continue
            if tries[run.name] < TRIES:
                report(f"{run.name}: {died}; {next_step(run)}")
                submit(run)
                continue
            record = RunRecord(**run.identity, state="failed", message=str(died))
        if record.state == "interrupted":
            report(f"{run.name}: interrupted; {next_step(run)} with --resume")
            continue
        place.add(record)
        records[run.name] = record
        how = (
            f"failed: {record.message}"
            if record.state == "failed"
            else f"finished in {record.seconds:.1f} s"
        )
        report(f"{run.name}: {how} ({len(records)} of {len(plan.runs)})")
        show(len(records), len(plan.runs), "runs")
    return records


def work(run: Run, folder: str, suite: Suite | None, evaluation: Evaluation) -> RunRecord:
    """Train a run in its folder, or what is left of it, and fly its agent; of a run that fails,
    why.

    :param suite: what the agent flies; None: fresh episodes of both tasks, as many as
        ``evaluation`` says.
    """
    use_cpus(1)
    place = Path(folder)
    try:
        place.mkdir(parents=True, exist_ok=True)
        import_packages(run.gym_packages, "gym_packages:")
        result = _train(run, place)
        if result.exit_code != 0:
            return RunRecord(**run.identity, state="interrupted")
        agent = Path([*result.stages.values()][-1].agent)
        flights = _fly(agent, result.job, suite, evaluation)
    except KeyboardInterrupt:
        return RunRecord(**run.identity, state="interrupted")
    except (
        Exception,
        SystemExit,
    ) as error:  # of a callback or environment of the user's, too; the other runs go on
        kind = "" if isinstance(error, SB3QuadError) else f"{type(error).__name__}: "
        return RunRecord(**run.identity, state="failed", message=kind + one_line(error))
    return RunRecord(
        **run.identity,
        state="finished",
        agent=agent.relative_to(place).as_posix(),
        weights=digest(agent),
        timesteps=sum(stage.timesteps for stage in result.stages.values()),
        seconds=round(sum(stage.seconds for stage in result.stages.values()), 1),
        flights=flights,
    )


def digest(agent: Path) -> str:
    """The SHA-256 of the parameters in an agent's zip."""
    parameters = load_model(agent).policy.state_dict()
    content = b"".join(
        name.encode() + tensor.numpy().tobytes() for name, tensor in sorted(parameters.items())
    )
    return hashlib.sha256(content).hexdigest()


def pipeline_folder(place: Path) -> Path | None:
    """Where a run's training is, if it has begun."""
    return next((path.parent for path in sorted(place.glob(f"*/*/{STATUS_FILE}"))), None)


def _train(run: Run, place: Path) -> PipelineResult:

    def report(line: str) -> None:
        with (place / LOG).open("a", encoding="utf-8") as file:
            file.write(f"{line}\n")

    begun = pipeline_folder(place)
    if begun is not None:
        return resume_pipeline(begun, report)
    stages = []
    for number, stage in enumerate(
        run.stages
    ):  # with its settings in a file here: one of the user's may have changed
        settings = place / f"stage_{number}.yml"
        write_text(settings, yaml.safe_dump({stage.env: stage.settings}, sort_keys=False))
        stages.append(stage.model_copy(update={"conf_file": str(settings), "settings": {}}))
    job = {**run.job, "seed": run.seed, "log_folder": str(place)}
    return run_pipeline(Pipeline(stages=tuple(stages)), job, "pipeline", report)


def _fly(
    agent: Path, job: TrainingJob, suite: Suite | None, evaluation: Evaluation
) -> dict[str, dict[str, Numbers]]:
    """The numbers of an agent's flights, by scenario and measure."""
    model = load_model(agent)
    episodes, seed = evaluation.episodes or EPISODES, seed_for("table", evaluation.seed or 0)
    if job.config.task is None:  # an environment of others has rewards, and no scenarios
        if suite is not None:
            raise ConfigError(
                f"evaluation: suites are for this package's environments, not for {job.config.env_id}"
            )
        config = job.for_evaluation()
        with closing(make_environments(config, 1, seed)) as env:
            rewards, _ = evaluate_policy(model, env, episodes, return_episode_rewards=True)
        return {config.env_id: {REWARD: tuple(np.asarray(rewards, dtype=np.float64).tolist())}}
    if suite is None:
        seeds, how = row_seeds(seed, episodes), job.flight_settings.in_any_task()
        return {
            task: _numbers(fly_settings(model, FlightSettings(task=task, **how), seeds))
            for task in TASKS
        }
    spec, found = ControllerSpec("agent", str(agent)), {}
    for each in suite.scenarios:
        scenario = each.flown_by(spec.own and spec.own.vehicle)
        found[each.name] = _numbers(fly_scenario(model, scenario, own=spec.observed)[0])
    return found


def _numbers(flights: Flights) -> dict[str, Numbers]:
    error = np.where(flights.survival, flights.final_error, np.nan)
    arrival = (
        flights.time_to[min(flights.time_to)] if flights.time_to else np.full(flights.n, np.nan)
    )
    time = np.where(
        np.isfinite(flights.cross_track_error), arrival, flights.recovery_time
    )  # who starts at the target has no way to it
    columns = (flights.success, flights.survival, flights.reward, error, time)
    return {
        name: tuple(float(value) if np.isfinite(value) else None for value in column)
        for name, column in zip(MEASURES, columns, strict=True)
    }
