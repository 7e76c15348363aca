"""``train`` with a pipeline: its stages one after the other, and a table of all their agents at the end."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_quad.base.errors import ConfigError
from sb3_quad.cli.compare import THESIS_VEHICLE, task_table
from sb3_quad.cli.output import console

if TYPE_CHECKING:
    from sb3_quad.training.job import TrainingJob
    from sb3_quad.training.pipeline import PipelineResult

FRESH_EPISODES = 960
REFERENCE_ALGO, REFERENCE_ENV = "ppo", "QuadStateRecovery-v0"
THESIS_PILOTS = ("expert", "IL-agent", "RL-agent", "PPO only")


def run_stages(
    options: argparse.Namespace,
    conf_file: str,
    overrides: Mapping[str, Any],
    job: Mapping[str, Any],
    say: Callable[[str], None],
) -> int:
    """Train the stages of ``conf_file``, compare, tell where everything is. Returns the exit code."""
    from sb3_quad.training.pipeline import load_pipeline, make_jobs, run_pipeline, with_settings

    for flag, given in (("-n", options.n_timesteps), ("-i", options.trained_agent)):
        if given is not None:
            raise ConfigError(
                f"{flag} goes with a single run (--algo, --env); a pipeline's stages have their own in {conf_file}"
            )
    pipeline = with_settings(load_pipeline(conf_file), overrides)
    jobs = make_jobs(pipeline, job)
    start = time.perf_counter()
    result = run_pipeline(pipeline, jobs, Path(conf_file).stem, say)
    return finish(result, options.reference, time.perf_counter() - start, jobs[0], say)


def finish(result: PipelineResult, reference: bool, seconds: float, first: TrainingJob, say: Callable[[str], None]) -> int:
    """Train the reference agent if it is wanted, and print both tasks' tables."""
    if result.exit_code != 0:
        return result.exit_code
    from sb3_quad.experts.models import load_model
    from sb3_quad.experts.resolve import resolve_expert
    from sb3_quad.training.job import describe
    from sb3_quad.training.trainer import train

    times = {entry.stage.name: entry.seconds for entry in result.stages}
    pilots: dict[str, Any] = {"expert": resolve_expert(first.config.expert or "pid", _vehicle(first))}
    pilots |= {entry.stage.name: load_model(entry.agent) for entry in result.stages}
    if reference:
        job = _reference(first, sum(entry.timesteps for entry in result.stages))
        say(f"PPO only: {describe(job)}")
        alone = train(job, say)
        if alone.exit_code != 0:
            return alone.exit_code
        times["PPO only"] = alone.seconds
        pilots["PPO only"] = load_model(alone.run.best_model if alone.run.best_model.is_file() else alone.run.model)
    print_tables(pilots, first)
    say("; ".join(f"{name}: {value:.0f} s" for name, value in times.items()) + f"; both stages together: {seconds:.0f} s")
    for entry in result.stages:
        say(f"{entry.stage.name}: {entry.agent}")
    say(f"saved in {result.folder}")
    return 0


def print_tables(pilots: Mapping[str, Any], job: TrainingJob) -> None:
    """Both tasks, all pilots on the same fresh episodes; beside ITM's the thesis's figures."""
    from sb3_quad.envs.registration import ENVIRONMENTS
    from sb3_quad.training.trainer import FRESH_SEED

    beside = THESIS_PILOTS if _vehicle(job) == THESIS_VEHICLE else ()
    seed = job.seed + FRESH_SEED
    for task in ENVIRONMENTS.values():
        table = task_table(pilots, task, FRESH_EPISODES, seed, "the same for all", beside, **job.config.flight_kwargs)
        console().print(table)


def _reference(first: TrainingJob, n_timesteps: int) -> TrainingJob:
    """PPO alone on as many transitions as all stages had together."""
    from sb3_quad.settings.config import load_config

    kept = {"vec_env": first.config.vec_env, "env_kwargs": first.config.flight_kwargs}
    config = load_config(REFERENCE_ALGO, REFERENCE_ENV, None, {**kept, "n_timesteps": n_timesteps})
    return replace(first, config=config, trained_agent=None)


def _vehicle(job: TrainingJob) -> Any:
    return job.config.env_kwargs.get("vehicle", THESIS_VEHICLE)


def is_pipeline_run(folder: Path) -> bool:
    """Whether a folder is a pipeline's rather than a single run's."""
    from sb3_quad.training.pipeline import STATUS_FILE

    return (folder / STATUS_FILE).is_file()


def resume_stages(folder: Path, changes: Mapping[str, Any], reference: bool, say: Callable[[str], None]) -> int:
    """Go on with an interrupted pipeline. Returns the exit code."""
    from sb3_quad.training.pipeline import first_job, resume_pipeline

    start = time.perf_counter()
    result = resume_pipeline(folder, say, **changes)
    return finish(result, reference, time.perf_counter() - start, first_job(folder), say)
