"""Executing the runs of a sweep, and the work of one run: train as ``train`` does, then fly the
agent.
"""

from contextlib import closing
from functools import partial
from pathlib import Path

import numpy as np
import yaml
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_quad.agents.agent_settings import env_kwargs
from sb3_quad.agents.zips import load_model
from sb3_quad.algorithms.statistics import STATISTICS, share_statistics
from sb3_quad.base.errors import ConfigError, WorkerDied
from sb3_quad.base.files import kind_and_line, write_text
from sb3_quad.base.imports import import_packages
from sb3_quad.base.process import StopSignals, use_cpus
from sb3_quad.base.seeds import seed_for
from sb3_quad.base.types import Report, StrDict
from sb3_quad.envs.simulation.settings import KEY
from sb3_quad.evaluation.controllers import ControllerSpec
from sb3_quad.evaluation.evaluate import Progress, fly_scenario
from sb3_quad.evaluation.flights import Flights, fly
from sb3_quad.evaluation.scenarios.scenario import Suite
from sb3_quad.executors import Executor, as_they_end
from sb3_quad.sweep.folder import RunResult, Sweep, read_results, write_result
from sb3_quad.sweep.runs import Run
from sb3_quad.sweep.spec import Evaluation, SweepSpec
from sb3_quad.training.config import TrainingJob
from sb3_quad.training.environments import make_environments
from sb3_quad.training.pipeline import (
    STATUS_FILE,
    Pipeline,
    PipelineResult,
    resume_pipeline,
    run_pipeline,
)

EPISODES = 240  # of each task, if no suite is named
TASKS = ("state_recovery", "target_tracking")
LOG = "log.txt"  # the reports of the training, in the run's folder


def execute(
    folder: Path,
    sweep: Sweep,
    executor: Executor,
    signals: StopSignals,
    show: Progress,
    report: Report,
) -> dict[str, RunResult]:
    """Execute all runs of a sweep's folder that are not finished.

    If a run fails, the others continue. After a signal, the current runs save and end.

    :param report: receives each event in one line.
    :return: the results of all runs that ended, including those of earlier calls, by name.
    :raises ConfigError: a folder that cannot be written, a full disk.
    """
    # Finished runs stay as they are; failed ones are tried again.
    results = {
        name: result for name, result in read_results(folder).items() if result.state == "finished"
    }
    calls = {}
    # All runs are submitted at once; the executor starts as many as it has workers.
    for run in sweep.runs:
        if run.name not in results:
            # Files in the folder of a run contain paths, which must be valid from anywhere.
            place = folder.absolute() / "runs" / run.name
            calls[executor.submit(work, run, place, sweep.spec, sweep.suite)] = run
    show(len(results), len(sweep.runs), "runs")
    for run, future in as_they_end(executor, calls, signals, report):
        try:
            result = future.result()
        except WorkerDied as died:
            # A signal may have ended a worker.
            if signals.received is not None:
                continue
            result = RunResult(name=run.name, state="failed", message=str(died))
        if result is None:
            continue
        write_result(folder, result)
        results[run.name] = result
        end = result.message or f"{result.seconds:.0f} s"
        report(f"{run.name}: {result.state}, {end} ({len(results)} of {len(sweep.runs)})")
        show(len(results), len(sweep.runs), "runs")
    return results


def work(run: Run, place: Path, spec: SweepSpec, suite: Suite | None) -> RunResult | None:
    """Train a run in its folder, or resume it, and fly its agent.

    :param suite: the scenarios of the agent; None: fresh episodes of both tasks, as many as
        ``spec.evaluation`` says.
    :return: the result, with the reason if the run failed; None: it was interrupted.
    """
    # One core for each run, so that the weights are the same on any machine.
    use_cpus(1)
    try:
        place.mkdir(parents=True, exist_ok=True)
        import_packages(spec.gym_packages, "gym_packages:")
        with (place / LOG).open("a", buffering=1, encoding="utf-8") as log:
            trained = _train(run, place, partial(print, file=log))
        if trained.exit_code != 0:
            return None
        stages = [*trained.stages.values()]
        agent = Path(stages[-1].agent)
        return RunResult(
            name=run.name,
            state="finished",
            agent=agent.relative_to(place).as_posix(),
            timesteps=sum(stage.timesteps for stage in stages),
            seconds=round(sum(stage.seconds for stage in stages), 1),
            flights=_fly(agent, trained.job, suite, spec.evaluation),
        )
    except KeyboardInterrupt:
        return None
    # Even after errors of a user's callback or environment, the other runs continue.
    except (Exception, SystemExit) as error:
        return RunResult(name=run.name, state="failed", message=kind_and_line(error))


def _train(run: Run, place: Path, report: Report) -> PipelineResult:
    begun = next(place.glob(f"*/*/{STATUS_FILE}"), None)
    if begun is not None:
        return resume_pipeline(begun.parent, report)
    stages = []
    for number, stage in enumerate(run.stages):
        # The settings are written here, because a user's file may have changed since.
        settings = place / f"stage_{number}.yml"
        write_text(settings, yaml.safe_dump({stage.env: stage.settings}, sort_keys=False))
        stages.append(stage.model_copy(update={"conf_file": str(settings), "settings": {}}))
    return run_pipeline(
        Pipeline(stages=stages),
        {**run.job, "seed": run.seed, "log_folder": str(place)},
        "pipeline",
        report,
    )


def _fly(agent: Path, job: TrainingJob, suite: Suite | None, evaluation: Evaluation) -> StrDict:
    """Return the numbers of an agent's flights, by scenario and measure."""
    model = load_model(agent)
    episodes = evaluation.episodes or EPISODES
    seed = seed_for("table", evaluation.seed or 0)
    if job.config.task is None or not hasattr(model, KEY):
        # A third-party environment has rewards but no scenarios, and neither has a wrapped one.
        if suite is not None:
            raise ConfigError(
                "evaluation: suites are for this package's environments without wrappers, "
                f"not for {job.config.env_id}"
            )
        config = job.for_evaluation()
        with closing(make_environments(config, 1, seed)) as env:
            share_statistics(getattr(model, STATISTICS, None), env)
            rewards, _ = evaluate_policy(model, env, episodes, return_episode_rewards=True)
        return {config.env_id: {"reward": np.ravel(rewards).tolist()}}
    flights = {}
    if suite is not None:
        spec = ControllerSpec("agent", str(agent))
        for scenario in suite.scenarios:
            flown = scenario.flown_by(spec.own and spec.own.vehicle)
            flights[scenario.name] = _numbers(fly_scenario(model, flown, own=spec.observed))
        return flights
    # Without a suite, the episodes are those of the closing table of train.
    for task in TASKS:
        flights[task] = _numbers(fly(model, task, episodes, seed, **env_kwargs(model)))
    return flights


def _numbers(flights: Flights) -> StrDict:
    """Return the measures of all episodes, NaN where there is no number."""
    # The time to the tightest tolerance.
    arrival = flights.time_to[min(flights.time_to)]
    # An episode that starts at its target has no way to it, and thus no cross-track error.
    has_way = np.isfinite(flights.cross_track_error)
    measures = {
        "success": flights.success,
        "survival": flights.survival,
        "reward": flights.reward,
        "final_error": np.where(flights.survival, flights.final_error, np.nan),
        "time": np.where(has_way, arrival, flights.recovery_time),
    }
    return {name: values.tolist() for name, values in measures.items()}
