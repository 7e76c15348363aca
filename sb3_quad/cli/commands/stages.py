"""The end of ``train`` with a pipeline: a table of the agents of all its stages."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from sb3_quad.base.seeds import seed_for
from sb3_quad.cli.compare import task_table
from sb3_quad.cli.output import console, print_line
from sb3_quad.envs.registration import ENVIRONMENTS
from sb3_quad.experts.models import load_model
from sb3_quad.experts.resolve import resolve_expert
from sb3_quad.settings.config import load_config
from sb3_quad.settings.flight import FlightSettings
from sb3_quad.training.job import TrainingJob, describe
from sb3_quad.training.pipeline import PipelineResult
from sb3_quad.training.trainer import train

FRESH_EPISODES = 960
REFERENCE, REFERENCE_ALGO, REFERENCE_ENV = "PPO only", "ppo", "QuadStateRecovery-v0"
THESIS_COLUMNS = ("expert", "IL-agent", "RL-agent", REFERENCE)


def finish_stages(result: PipelineResult, reference: bool, start: float) -> int:
    """Train the reference agent if it is wanted, print both tasks' tables, tell where everything is. Returns the exit code.

    :param reference: PPO alone, on as many timesteps as all stages had together.
    :param start: when the pipeline began, s.
    """
    if result.exit_code != 0:
        return result.exit_code
    seconds, config = time.perf_counter() - start, result.job.config
    times = {name: entry.seconds for name, entry in result.stages.items()}
    controllers = {"expert": resolve_expert(config.expert or "pid", result.job.flight_settings.vehicle)}
    controllers |= {name: load_model(entry.agent) for name, entry in result.stages.items()}
    if reference:
        settings: dict[str, Any] = {"vec_env": config.vec_env, "env_kwargs": config.flight_settings.in_any_task()}
        settings["n_timesteps"] = sum(entry.timesteps for entry in result.stages.values())
        alone = load_config(REFERENCE_ALGO, REFERENCE_ENV, None, settings)
        job = result.job.model_copy(update={"config": alone, "trained_agent": None})
        print_line(f"{REFERENCE}: {describe(job)}")
        trained = train(job, print_line)
        if trained.exit_code != 0:
            return trained.exit_code
        times[REFERENCE] = trained.seconds
        controllers[REFERENCE] = load_model(trained.run.result)
    print_tables(controllers, result.job)
    print_line(
        "; ".join(f"{name}: {value:.0f} s" for name, value in times.items()) + f"; both stages together: {seconds:.0f} s"
    )
    for name, entry in result.stages.items():
        print_line(f"{name}: {entry.agent}")
    print_line(f"saved in {result.folder}")
    return 0


def print_tables(controllers: Mapping[str, Any], job: TrainingJob) -> None:
    """Both tasks, all controllers on the same fresh episodes; beside ITM's the thesis's metrics."""
    seed = seed_for("table", job.seed)
    for task in ENVIRONMENTS.values():
        settings = FlightSettings(task=task, **job.flight_settings.in_any_task())
        console().print(task_table(controllers, settings, FRESH_EPISODES, seed, "the same for all", THESIS_COLUMNS))
