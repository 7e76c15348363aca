"""``train`` with a pipeline: its stages one after the other, and a table of all their agents at the end."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.seeds import seed_for
from sb3_quad.cli.compare import task_table
from sb3_quad.cli.output import console
from sb3_quad.envs.registration import ENVIRONMENTS
from sb3_quad.experts.models import load_model
from sb3_quad.experts.resolve import resolve_expert
from sb3_quad.settings.config import load_config
from sb3_quad.settings.flight import FlightSettings
from sb3_quad.training.job import TrainingJob, describe
from sb3_quad.training.pipeline import PipelineResult, load_pipeline, resume_pipeline, run_pipeline, with_settings
from sb3_quad.training.trainer import train

FRESH_EPISODES = 960
REFERENCE_ALGO, REFERENCE_ENV = "ppo", "QuadStateRecovery-v0"
THESIS_COLUMNS = ("expert", "IL-agent", "RL-agent", "PPO only")


def run_stages(
    options: argparse.Namespace,
    conf_file: str,
    overrides: Mapping[str, Any],
    job: Mapping[str, Any],
    report: Callable[[str], None],
) -> int:
    """Train the stages of ``conf_file``, compare, tell where everything is. Returns the exit code."""
    for flag, given in (("-n", options.n_timesteps), ("-i", options.trained_agent)):
        if given is not None:
            raise ConfigError(
                f"{flag} goes with a single run (--algo, --env); a pipeline's stages have their own in {conf_file}"
            )
    pipeline = with_settings(load_pipeline(conf_file), overrides)
    start = time.perf_counter()
    result = run_pipeline(pipeline, job, Path(conf_file).stem, report)
    return finish(result, options.reference, time.perf_counter() - start, report)


def finish(result: PipelineResult, reference: bool, seconds: float, report: Callable[[str], None]) -> int:
    """Train the reference agent if it is wanted, and print both tasks' tables."""
    if result.exit_code != 0:
        return result.exit_code
    first, times = result.job, {name: entry.seconds for name, entry in result.stages.items()}
    controllers: dict[str, Any] = {"expert": resolve_expert(first.config.expert or "pid", first.flight_settings.vehicle)}
    controllers |= {name: load_model(entry.agent) for name, entry in result.stages.items()}
    if reference:
        job = _reference(first, sum(entry.timesteps for entry in result.stages.values()))
        report(f"PPO only: {describe(job)}")
        alone = train(job, report)
        if alone.exit_code != 0:
            return alone.exit_code
        times["PPO only"] = alone.seconds
        controllers["PPO only"] = load_model(alone.run.best_model if alone.run.best_model.is_file() else alone.run.model)
    print_tables(controllers, first)
    report("; ".join(f"{name}: {value:.0f} s" for name, value in times.items()) + f"; both stages together: {seconds:.0f} s")
    for name, entry in result.stages.items():
        report(f"{name}: {entry.agent}")
    report(f"saved in {result.folder}")
    return 0


def print_tables(controllers: Mapping[str, Any], job: TrainingJob) -> None:
    """Both tasks, all controllers on the same fresh episodes; beside ITM's the thesis's metrics."""
    seed = seed_for("table", job.seed)
    for task in ENVIRONMENTS.values():
        settings = FlightSettings(task=task, **job.flight_settings.in_any_task())
        console().print(task_table(controllers, settings, FRESH_EPISODES, seed, "the same for all", THESIS_COLUMNS))


def _reference(first: TrainingJob, n_timesteps: int) -> TrainingJob:
    """PPO alone on as many timesteps as all stages had together."""
    kept = {"vec_env": first.config.vec_env, "env_kwargs": first.config.flight_settings.in_any_task()}
    config = load_config(REFERENCE_ALGO, REFERENCE_ENV, None, {**kept, "n_timesteps": n_timesteps})
    return first.model_copy(update={"config": config, "trained_agent": None})


def resume_stages(folder: Path, changes: Mapping[str, Any], reference: bool, report: Callable[[str], None]) -> int:
    """Go on with an interrupted pipeline. Returns the exit code."""
    start = time.perf_counter()
    result = resume_pipeline(folder, report, **changes)
    return finish(result, reference, time.perf_counter() - start, report)
