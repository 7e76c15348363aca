"""Several training jobs in a row, each starting from the agent of the one before: the two stages of the thesis (4.2).

A pipeline's file names its stages in order::

    stages:
      - name: stage one
        algo: dagger
        env: QuadTargetTracking-v0
      - name: stage two
        algo: ppo_bc
        env: QuadStateRecovery-v0
        pass_on: best
        require: {success_rate: 0.9}

=========  ================================================================================================
key        meaning
=========  ================================================================================================
name       what the stage is called in tables
algo, env  as for a single run
conf_file  settings file; ``<algo>.yml`` of the package without it
settings   changes to these settings, such as ``n_timesteps: 5_000_000``
pass_on    ``best`` (default): the best evaluation, by success, then by reward; or ``last``
trim       correct the agent's steady offset before passing it on: ``position``, by offset and scale of its position
           (:mod:`sb3_quad.training.trim`), or ``hover``, by its last layer (:mod:`sb3_quad.training.hover`)
require    ``success_rate``, ``mean_reward``: what the best evaluation must reach, or the pipeline stops here
eval_freq  transitions between evaluations, ``eval_episodes`` in each, for this stage
=========  ================================================================================================
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import Field, PositiveInt

from sb3_quad.base.errors import ConfigError, TrainingError
from sb3_quad.base.files import save_model, write_text
from sb3_quad.base.seeds import seed_for
from sb3_quad.base.validate import Frozen, validate
from sb3_quad.report.curves import read_curve
from sb3_quad.settings.algorithms import get_algorithm
from sb3_quad.settings.config import SETTINGS, load_config, with_vehicle_path
from sb3_quad.training.hover import trim_hover
from sb3_quad.training.job import TrainingJob, describe
from sb3_quad.training.runs import RunFolder, claim_folder, open_run
from sb3_quad.training.trainer import resume, train
from sb3_quad.training.trim import trim

STATUS_FILE = "pipeline.yml"


class Requirement(Frozen):
    """What the best evaluation of a stage must reach before the next one begins."""

    success_rate: Annotated[float, Field(ge=0, le=1)] = 0.0
    mean_reward: float | None = None


class Stage(Frozen):
    """One stage of a pipeline; see the module for its keys."""

    name: str = Field(min_length=1)
    algo: str
    env: str
    conf_file: str | None = None
    settings: dict[str, Any] = Field(default_factory=dict)
    pass_on: Literal["best", "last"] = "best"
    trim: Literal["position", "hover"] | None = None
    require: Requirement = Requirement()
    eval_freq: int | None = None
    eval_episodes: PositiveInt | None = None


class Pipeline(Frozen):
    """The stages, in order."""

    stages: tuple[Stage, ...] = Field(min_length=1)


@dataclass(frozen=True)
class StageResult:
    """A finished stage.

    :param agent: the zip that is passed on.
    :param seconds: wall-clock time of its training; of a stage that was resumed, since then.
    """

    stage: Stage
    run: RunFolder
    agent: Path
    timesteps: int
    seconds: float


@dataclass(frozen=True)
class PipelineResult:
    """How a pipeline ended: all stages, or those before an interruption (then ``exit_code`` is not 0).

    :param job: of the first stage.
    """

    folder: Path
    job: TrainingJob
    stages: list[StageResult]
    exit_code: int = 0


def is_pipeline(conf_file: str | Path) -> bool:
    """Whether a settings file holds stages rather than the settings of one run."""
    return "stages" in SETTINGS.read(conf_file)[0]


def is_pipeline_run(folder: Path) -> bool:
    """Whether a folder is a pipeline's rather than a single run's."""
    return (folder / STATUS_FILE).is_file()


def load_pipeline(conf_file: str | Path) -> Pipeline:
    """The pipeline in a file, by path or by the name of one in the package.

    :raises ConfigError: an unreadable file, or a key that is unknown, missing or out of range.
    """
    return validate(Pipeline, *SETTINGS.read(conf_file))


def with_settings(pipeline: Pipeline, changes: Mapping[str, Any]) -> Pipeline:
    """The pipeline with ``changes`` put over the settings of every stage (into them, for ``env_kwargs``)."""
    stages = []
    for stage in pipeline.stages:
        settings = {**stage.settings, **changes}
        if "env_kwargs" in stage.settings and "env_kwargs" in changes:
            settings["env_kwargs"] = {**stage.settings["env_kwargs"], **changes["env_kwargs"]}
        if "env_kwargs" in settings:
            settings["env_kwargs"] = with_vehicle_path(settings["env_kwargs"])
        stages.append(stage.model_copy(update={"settings": settings}))
    return Pipeline(stages=tuple(stages))


def make_jobs(pipeline: Pipeline, job: Mapping[str, Any]) -> list[TrainingJob]:
    """The job of every stage, checked before the first one starts.

    :param job: arguments of every :class:`TrainingJob`, such as ``seed``; a stage's own ``eval_freq`` and
        ``eval_episodes`` go before them.
    :raises ConfigError: settings that do not fit, named with their stage.
    """
    jobs = []
    for stage in pipeline.stages:
        try:
            config = load_config(stage.algo, stage.env, stage.conf_file, stage.settings)
        except ConfigError as error:
            raise ConfigError(f"stage {stage.name!r}: {error}") from None
        own = {key: getattr(stage, key) for key in ("eval_freq", "eval_episodes") if getattr(stage, key) is not None}
        jobs.append(TrainingJob(config, **{**job, **own}))
    return jobs


def run_pipeline(
    pipeline: Pipeline, jobs: list[TrainingJob], name: str, report: Callable[[str], None] = print
) -> PipelineResult:
    """Train the stages one after the other, each from the agent that the one before passed on.

    Their run folders lie where single runs lie; ``<log_folder>/<name>/<name>_<run>/pipeline.yml`` says which they are.

    :param name: of the pipeline, for its folder.
    :raises SB3QuadError: as :func:`~sb3_quad.training.trainer.train`; or a requirement that was missed.
    """
    folder = claim_folder(Path(jobs[0].log_folder) / name, name)
    return _go_on(folder, pipeline, jobs, [], None, report)


def resume_pipeline(folder: Path, report: Callable[[str], None] = print, **changes: Any) -> PipelineResult:
    """Go on with an interrupted pipeline: within the stage that was interrupted, then with the stages after it.

    :param changes: arguments of the jobs to change, as for :func:`~sb3_quad.training.trainer.resume`.
    :raises ConfigError: a folder without an interrupted pipeline, or with a damaged ``pipeline.yml``.
    """
    pipeline, content = _read_status(folder)
    jobs = make_jobs(pipeline, {**content["job"], **changes})
    done = []
    for stage, entry in zip(pipeline.stages, content["done"], strict=False):
        done.append(StageResult(stage, open_run(entry["run"]), Path(entry["agent"]), entry["timesteps"], entry["seconds"]))
    if len(done) == len(pipeline.stages):
        raise ConfigError(f"{folder}: all stages of this pipeline are done")
    return _go_on(folder, pipeline, jobs, done, content["current"], report, **changes)


def _read_status(folder: Path) -> tuple[Pipeline, dict[str, Any]]:
    content, where = SETTINGS.read(folder / STATUS_FILE)
    if not {"stages", "job", "done", "current"} <= content.keys():
        raise ConfigError(f"{where}: holds no pipeline's status")
    return validate(Pipeline, {"stages": content["stages"]}, where), content


def _go_on(
    folder: Path,
    pipeline: Pipeline,
    jobs: list[TrainingJob],
    done: list[StageResult],
    current: str | None,
    report: Callable[[str], None],
    **changes: Any,
) -> PipelineResult:
    for stage, job in list(zip(pipeline.stages, jobs, strict=True))[len(done) :]:
        report(f"{stage.name}: {describe(job)}")
        if current is not None and open_run(current).resume_state.is_file():
            result = resume(current, report, **changes)
        else:
            start = replace(job, trained_agent=str(done[-1].agent)) if done else job
            result = train(start, report, on_start=lambda run: _write_status(folder, pipeline, jobs, done, str(run.path)))
        current = None
        if result.exit_code != 0:
            report(f"to go on with the whole pipeline: --resume {folder}")
            return PipelineResult(folder, jobs[0], done, result.exit_code)
        agent = _passed_on(stage, result.run)
        if stage.trim is not None:
            agent = _trimmed(agent, job, stage.trim, report)
        done.append(StageResult(stage, result.run, agent, result.model.num_timesteps, round(result.seconds, 1)))
        _write_status(folder, pipeline, jobs, done, None)
    return PipelineResult(folder, jobs[0], done)


def _passed_on(stage: Stage, run: RunFolder) -> Path:
    """The zip that a stage passes on.

    :raises TrainingError: its best evaluation misses the stage's requirement.
    """
    if run.evaluations.is_file():
        curve = read_curve(run.path)
        scores = list(zip(curve.success.tolist(), curve.reward.tolist(), strict=True))
        success, reward = max(scores) if stage.pass_on == "best" else scores[-1]
        wanted = -np.inf if stage.require.mean_reward is None else stage.require.mean_reward
        if success < stage.require.success_rate or reward < wanted:
            raise TrainingError(
                f"stage {stage.name!r}: success {success:.3f} and mean reward {reward:.2f} miss what it requires "
                f"(success_rate {stage.require.success_rate:g}, mean_reward {wanted:g}); its run is {run.path}"
            )
    return run.best_model if stage.pass_on == "best" and run.best_model.is_file() else run.model


def _trimmed(agent: Path, job: TrainingJob, kind: str, report: Callable[[str], None]) -> Path:
    """Trim the agent in a zip; the trimmed one lies beside it."""
    model = get_algorithm(job.config.algo).load(agent, device=job.device)
    seed, settings = seed_for("trim", job.seed), job.flight_settings
    if kind == "hover":
        hover = trim_hover(model, seed, settings)
        done = f"action at the target {hover.before:.4f} from hover, now {hover.after:.4f}"
    else:
        result = trim(model, seed, settings)
        done = f"steady offset {result.offset_before:.3f} m, now {result.offset_after:.3f} m; position scale {result.scale:g}"
    trimmed = agent.with_name("trimmed_model.zip")
    save_model(model, trimmed)
    report(f"trimmed: {done}: {trimmed}")
    return trimmed


def _write_status(
    folder: Path, pipeline: Pipeline, jobs: list[TrainingJob], done: list[StageResult], current: str | None
) -> None:
    own = ("algo", "env", "trained_agent", "eval_freq", "eval_episodes")  # the stages hold theirs
    status = {
        "stages": [stage.model_dump(mode="json", exclude_defaults=True) for stage in pipeline.stages],
        "job": {key: value for key, value in jobs[0].arguments().items() if key not in own},
        "done": [
            {"run": str(r.run.path), "agent": str(r.agent), "timesteps": r.timesteps, "seconds": r.seconds} for r in done
        ],
        "current": current,
    }
    write_text(folder / STATUS_FILE, yaml.safe_dump(status, sort_keys=False))
