"""The closing lines of a command: tables of agents and experts, where everything is, what is next.

The tables are of fresh episodes, the same for all.
"""

import shlex
from pathlib import Path
from typing import Any

from sb3_quad.agents.agent_settings import agent_settings
from sb3_quad.agents.zips import load_model, saved_data
from sb3_quad.base.errors import SB3QuadError
from sb3_quad.base.seeds import seed_for
from sb3_quad.cli.output import console
from sb3_quad.envs.registration import ENVIRONMENTS
from sb3_quad.envs.simulation.settings import KEY
from sb3_quad.evaluation.compare import compare
from sb3_quad.evaluation.tables import Table
from sb3_quad.training.config import TrainingJob
from sb3_quad.training.hand_over import hand_over
from sb3_quad.training.pipeline import PipelineResult
from sb3_quad.training.runs import RunFolder, open_run
from sb3_quad.training.trainer import TrainingResult

FRESH_EPISODES = 240  # in the table after a single run
PIPELINE_EPISODES = 480  # in each table after a pipeline
NEXT = """next:
  sb3-quad enjoy {agent} --env {env} -o {label}.mp4
  sb3-quad demo {agent} pid -o {label}.html
  sb3-quad evaluate {agent} --suite quick -o evaluations/{label}
  sb3-quad export {agent} --format onnx{vehicle}"""


def agent_and_expert(job: TrainingJob, model: Any) -> Table:
    """Return the table of a job's agent and its expert, over episodes that no training has flown.

    :param job: of an environment of this package.
    """
    how = dict(job.flight_settings)
    how["max_episode_steps"] = job.flight_settings.longest_episode
    return compare(
        {"agent": model, "expert": job.for_evaluation().make_expert()},
        [how.pop("task")],
        FRESH_EPISODES,
        seed_for("table", job.seed),
        thesis_columns=("IL-agent" if job.config.algo == "dagger" else "RL-agent", "expert"),
        **how,
    ).tables[0]


def print_agent(job: TrainingJob, model: Any) -> None:
    """Print :func:`agent_and_expert`, or why there is none: what was trained is there anyway."""
    # Training writes this into all agents that fly without wrappers.
    if not hasattr(model, KEY):
        print("no table: its flights have no wrappers; the evaluations above have them")
        return
    try:
        console().print(agent_and_expert(job, model))
    except SB3QuadError as error:
        print("no table:", error)


def close_run(result: TrainingResult) -> int:
    """Print the table of a single run's agent and where everything is. Returns the exit code: 1 if
    the run ended below the agent that it started from.
    """
    if result.exit_code != 0:
        return result.exit_code
    run = result.run
    handed = hand_over(run, result.job.config.best_by)
    if result.job.config.task:
        model = result.model if handed.agent == run.model else load_model(handed.agent)
        print_agent(result.job, model)
    if "task_results" in handed.row:
        reward = handed.row["results"].mean()
        print(f"mean reward as trained: {reward:.2f}; a table shows the task's own")
    if handed.is_start:
        why = handed.problem or "no evaluation is better than that of its start"
        print(f"{why}; the agent is the one it started from, {result.job.initial_policy}")
    if handed.agent != run.model:
        print(f"agent: {handed.agent}, the best of its evaluations; the last one is {run.model}")
    # A complete run without evaluations does not know how long it took.
    if result.seconds:
        print(f"trained in {result.seconds:.1f} s")
    print("saved in", run.path)
    _print_next(run, run.result)
    return int(bool(handed.problem))


def close_pipeline(result: PipelineResult) -> int:
    """Print tables of all stages' agents or why there are none, and where everything is. Returns
    the exit code: 1 if the last stage ended below an agent of before.
    """
    if not result.agent:
        return result.exit_code
    # A stage that ended below its start has no agent of its own.
    labels: dict[str, str] = {}
    for name, stage in result.stages.items():
        is_rival = Path(stage.agent).parent == result.folder
        labels.setdefault(stage.agent, Path(stage.agent).stem if is_rival else name)
    if result.problem:
        labels[result.agent] += " (handed over)"
    agents = {label: agent for agent, label in labels.items()}
    # Training writes this into all agents that fly without wrappers.
    flown = {name: agent for name, agent in agents.items() if KEY in saved_data(agent)}
    if flown:
        _print_stages(result.job, flown)
    else:
        print("no tables: their flights have no wrappers; the evaluations above have them")
    for name, stage in result.stages.items():
        print(f"{name}: {stage.agent}, {stage.seconds:.0f} s")
    print("saved in", result.folder)
    *_, (name, last) = result.stages.items()
    if result.problem:
        print(f"{name}: {result.problem}; the agent is {labels[result.agent]}, {result.agent}")
    _print_next(open_run(last.run), Path(result.agent))
    return result.exit_code


def _print_stages(job: TrainingJob, agents: dict[str, str]) -> None:
    """Print tables of the stages' agents, each as it was trained, and of the expert of ``job``; or
    why there are none.
    """
    try:
        tables = compare(
            {"expert": job.for_evaluation().make_expert(), **agents},
            n_episodes=PIPELINE_EPISODES,
            seed=seed_for("table", job.seed),
            thesis_columns=("expert", "IL-agent", "RL-agent"),
        )
        console().print(tables)
    except SB3QuadError as error:
        print("no tables:", error)


def _print_next(run: RunFolder, agent: Path) -> None:
    """Print the commands that show, measure and export an agent, by the name of a run.

    Environments of other packages have no such commands, nor agents behind wrappers.
    """
    if run.name not in ENVIRONMENTS or KEY not in saved_data(agent):
        return
    # An agent of many vehicles has none that export could take by itself.
    settings, _ = agent_settings(agent)
    print(
        NEXT.format(
            agent=shlex.quote(str(agent)),
            label=shlex.quote(f"{run.path.parent.name}_{run.path.name}"),
            env=run.name,
            vehicle=" --vehicle itm" if settings.vehicles else "",
        )
    )
