"""What a command prints at its end: agents and experts on the same fresh episodes, where everything
is, what to type next.
"""

import shlex
from collections.abc import Iterable, Mapping
from typing import Any

from sb3_quad.base.seeds import seed_for
from sb3_quad.cli.output import console
from sb3_quad.controllers.agent_settings import agent_settings
from sb3_quad.controllers.resolve import DEFAULT_EXPERT, resolve_expert
from sb3_quad.controllers.zips import load_model
from sb3_quad.envs.registration import ENVIRONMENTS
from sb3_quad.evaluation.compare import SCENARIOS, task_table
from sb3_quad.evaluation.tables import Table
from sb3_quad.simulation.settings import FlightSettings
from sb3_quad.training.config import TrainingJob
from sb3_quad.training.pipeline import PipelineResult
from sb3_quad.training.runs import RunFolder, open_run
from sb3_quad.training.trainer import TrainingResult

FRESH_EPISODES, PIPELINE_EPISODES = 240, 480  # in a table after a single run, and after a pipeline


def print_tables(
    controllers: Mapping[str, Any],
    how: Mapping[str, Any],
    n: int,
    seed: int,
    thesis_columns: Iterable[str] = (),
) -> None:
    """Print a table as of :func:`task_table` for each task.

    :param how: the controllers fly in any task: vehicle, noise and scaling.
    """
    for task in SCENARIOS:
        console().print(
            task_table(controllers, FlightSettings(task=task, **how), n, seed, thesis_columns)
        )


def agent_and_expert(job: TrainingJob, model: Any) -> Table:
    """The table of the agent of a job and of its expert over the same episodes, which no training
    has seen.

    :param job: of an environment of this package.
    """
    settings = job.flight_settings
    controllers = {"agent": model, "expert": _expert(job)}
    agent = "IL-agent" if job.config.algo == "dagger" else "RL-agent"
    return task_table(
        controllers, settings, FRESH_EPISODES, seed_for("table", job.seed), (agent, "expert")
    )


def _expert(job: TrainingJob) -> Any:
    """The expert of a training, or the default one, for the vehicle that the agent flies and in its
    layout.
    """
    flown = job.flight_settings
    return resolve_expert(
        job.config.expert or DEFAULT_EXPERT, flown.vehicle, layout=flown.rotor_layout
    )


def close_run(result: TrainingResult) -> int:
    """Print the table of a single run's agent and where everything is. Returns the exit code."""
    if result.exit_code != 0:
        return result.exit_code
    if result.job.config.task is not None:
        console().print(agent_and_expert(result.job, result.model))
    if result.seconds:  # else a complete run that made no evaluations
        print(f"trained in {result.seconds:.1f} s")
    print(
        f"saved in {result.run.path}: {', '.join(sorted(entry.name for entry in result.run.path.iterdir()))}"
    )
    _print_next(result.run)
    return 0


def close_pipeline(result: PipelineResult, seconds: float) -> int:
    """Print both tasks' tables of all stages' agents and where everything is. Returns the exit
    code.

    :param seconds: that the pipeline took.
    """
    if result.exit_code != 0:
        return result.exit_code
    flown = result.job.flight_settings
    controllers = {"expert": _expert(result.job)}
    controllers |= {name: load_model(stage.agent) for name, stage in result.stages.items()}
    thesis_columns = ("expert", "IL-agent", "RL-agent")
    print_tables(
        controllers,
        flown.in_any_task(),
        PIPELINE_EPISODES,
        seed_for("table", result.job.seed),
        thesis_columns,
    )
    for name, stage in result.stages.items():
        print(f"{name}: {stage.agent}, {stage.seconds:.0f} s")
    print(f"saved in {result.folder}, {seconds:.0f} s in all")
    _print_next(open_run([*result.stages.values()][-1].run))
    return 0


def _print_next(run: RunFolder) -> None:
    """Print the commands that show, measure and export a run's agent, if it flies an environment of
    this package.
    """
    if run.name not in ENVIRONMENTS:
        return
    agent, label = (
        shlex.quote(str(run.result)),
        shlex.quote(f"{run.path.parent.name}_{run.path.name}"),
    )
    vehicle = (
        " --vehicle itm" if agent_settings(run.result)[0].vehicles else ""
    )  # else the one that it was trained on
    print(f"next:\n  sb3-quad enjoy {agent} --env {run.name} -o {label}.png")
    print(f"  sb3-quad demo {agent} pid -o {label}.html")
    print(f"  sb3-quad evaluate {agent} --suite quick -o evaluations/{label}")
    print(f"  sb3-quad export {agent} --format torchscript{vehicle}")
