"""Pipelines: several training jobs in a row, each starting from the agent of the one before.

The two stages of the thesis (4.2) form one. A pipeline's file lists its stages in order, as
``zoo_configs/two_stage.yml`` does; :class:`Stage` describes the keys.
"""

import os
import shlex
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt, field_validator

from sb3_quad.agents.zips import load_zip
from sb3_quad.base.errors import ConfigError, TrainingError, named
from sb3_quad.base.files import locked, refuse_links, refuse_outside, save_model
from sb3_quad.base.process import StopSignals
from sb3_quad.base.seeds import LARGEST, seed_for
from sb3_quad.base.types import Report, StrDict, StrMapping, StrPath
from sb3_quad.base.validate import Frozen, Share, validate
from sb3_quad.base.yaml_files import write_yaml
from sb3_quad.callbacks.best_model import RATES
from sb3_quad.envs.simulation.observation import OBSERVATION_SIZE
from sb3_quad.evaluation.offset_correction import correct_offset
from sb3_quad.training.config import (
    SETTINGS,
    TrainingConfig,
    TrainingJob,
    describe,
    load_agent,
    load_config,
    merged,
    with_absolute_paths,
)
from sb3_quad.training.hand_over import HandOver, hand_over
from sb3_quad.training.options import (
    DEFAULT_ALGO,
    DEFAULT_ENV,
    DEFAULT_PIPELINE,
    KEPT_BY_STAGES,
)
from sb3_quad.training.rivals import (
    HEAD_START,
    Flown,
    best_of,
    fly_agent,
    fly_rivals,
    with_vehicle,
)
from sb3_quad.training.runs import RunFolder, claim_folder, open_run, refuse_elsewhere
from sb3_quad.training.trainer import resume, train

STATUS_FILE = "pipeline.yml"
State = Literal["new", "begun", "done"]


class Stage(Frozen):
    """One stage of a pipeline."""

    name: str = Field(min_length=1)
    """what the stage is called in tables"""
    algo: str
    """as for a single run"""
    env: str
    """as for a single run"""
    conf_file: str | None = None
    """settings file; <algo>.yml of the package without it"""
    settings: StrDict = {}
    """changes to these settings, such as n_timesteps: 5_000_000"""
    seed_offset: NonNegativeInt = 0
    """added to the seed, so that stages on the same task fly different episodes"""
    pass_on: Literal["best", "last"] = "best"
    """best: the agent of the best evaluation, by best_by of its settings, be it the one that the
    stage starts from; last: the last one, unless it is below that one"""
    correct_offset: PositiveFloat | None = None
    """offset correction after the stage: α of Eq. 4.10, such as 0.7; 1: only the offset"""
    require: dict[Literal["success_rate", "survival_rate"], Share] = {"survival_rate": 0.5}
    """the least that the evaluation of its agent must reach; otherwise the pipeline stops"""
    rivals: list[str] = []
    """agents of the package and experts that first fly the vehicle, if one is given; an agent that
    is above that of the stage before is what the stage starts from"""
    rival_settings: StrDict = {}
    """changes to the settings if it starts from a rival, whose network may be larger"""
    eval_freq: int | None = None
    """timesteps between evaluations of this stage"""
    eval_episodes: PositiveInt | None = None
    """episodes of each evaluation"""
    agent: Any = Field(default=None, exclude=True, repr=False)
    """the loaded agent that a single run starts from"""

    def job(self, options: StrMapping) -> TrainingJob:
        """Return the checked job of the stage.

        :param options: those of :class:`~sb3_quad.training.options.JobOptions`; the evaluations of
            the stage may differ from those of its pipeline.
        :raises ConfigError: settings or options that do not fit.
        """
        # A settings file takes precedence over the agent's settings.
        like = None if self.conf_file else self.agent
        config = load_config(self.algo, self.env, self.conf_file, self.settings, like)
        own = self.model_dump(include={"eval_freq", "eval_episodes"}, exclude_none=True)
        fields = {**own, **options, "config": config, "agent": self.agent}
        return validate(TrainingJob, fields, "command line")


class Pipeline(Frozen):
    """The stages, in order."""

    stages: list[Stage] = Field(min_length=1)

    @field_validator("stages")
    @classmethod
    def _different_names(cls, stages: list[Stage]) -> list[Stage]:
        if len({stage.name for stage in stages}) < len(stages):
            raise ValueError("give each stage a name of its own")
        return stages


class Status(Pipeline):
    """The content of ``pipeline.yml`` in a pipeline's folder."""

    job: StrDict
    """options of every job"""
    runs: list[str]
    """the run folders of the stages that have begun, in the log folder"""
    agent: str = ""
    """the zip that is handed over at the end, by its path from the log folder"""


class StageResult(NamedTuple):
    """A finished stage.

    :param run: its run folder. The agent is in another one if the stage ended below its start.
    :param agent: the zip that is passed on.
    :param seconds: time of training; if it was resumed, since then; 0 if it was done before.
    """

    run: str
    agent: str
    seconds: float


class PipelineResult(NamedTuple):
    """How a pipeline ended.

    :param stages: the finished stages by name. After an interruption, some are missing.
    :param job: the job of the first stage.
    :param agent: the zip that is handed over; empty after an interruption.
    :param problem: why it is not that of the last stage; empty if it is.
    :param exit_code: 1 if there is a problem; otherwise as of a
        :class:`~sb3_quad.training.trainer.TrainingResult`.
    """

    folder: Path
    stages: dict[str, StageResult]
    job: TrainingJob
    agent: str = ""
    problem: str = ""
    exit_code: int = 0


def load_pipeline(conf_file: StrPath, changes: StrMapping | None = None) -> Pipeline:
    """Load the pipeline in a file, by path or by the name of one in the package.

    :param changes: changes to the settings of every stage, merged as by
        :func:`~sb3_quad.training.config.merged`.
    :raises ConfigError: an unreadable file, or a key that is unknown, missing or out of range.
    """
    pipeline = validate(Pipeline, *SETTINGS.read(conf_file))
    stages = []
    for stage in pipeline.stages:
        settings = merged(stage.settings, changes or {}, stage.name)
        # The pipeline may be resumed from another folder.
        update: StrDict = {"settings": with_absolute_paths(stage.env, settings)}
        # The stages of a packaged pipeline use packaged settings, whatever is in the user's folder.
        if stage.conf_file is not None and SETTINGS.is_packaged(conf_file):
            update["conf_file"] = str(SETTINGS.packaged(stage.conf_file))
        stages.append(stage.model_copy(update=update))
    return Pipeline(stages=stages)


def plan_training(options: StrMapping, changes: StrDict) -> Pipeline | Stage:
    """Return what the options of ``train`` ask for: a pipeline, or the only stage of a single run.

    :param options: the given options, including ``conf_file`` and those of ``KEPT_BY_STAGES``.
    :param changes: changes to the settings of every stage.
    :raises ConfigError: an option that a pipeline's stages have themselves, or an agent that does
        not fit.
    """
    file = options.get("conf_file")
    # Without any of these, the default is a pipeline rather than a single run.
    if not options.keys() & {"algo", "env", "conf_file"}:
        file = SETTINGS.packaged(DEFAULT_PIPELINE)
    if file is not None and "stages" in SETTINGS.read(file)[0]:
        for key in options.keys() & KEPT_BY_STAGES:
            raise ConfigError(
                f"{key} goes with a single run (algo, env); "
                f"the stages of a pipeline have their own in {file}"
            )
        return load_pipeline(file, changes)
    agent = None
    if "initial_policy" in options:
        agent = load_agent(options["initial_policy"])
    algo = options.get("algo") or DEFAULT_ALGO
    env = options.get("env") or DEFAULT_ENV
    # Nothing follows that a bad agent could spoil, and a sweep compares any.
    return Stage(
        name=algo, algo=algo, env=env, conf_file=file, settings=changes, agent=agent, require={}
    )


def run_pipeline(
    pipeline: Pipeline, job: StrMapping, name: str, report: Report = print
) -> PipelineResult:
    """Train the stages one after the other, each from the agent that the one before passed on.

    Their run folders are where those of single runs are.
    ``<log_folder>/<name>/<name>_<run>/pipeline.yml`` lists them; the same folder
    holds the settings of each stage, ``stage_<number>.yml``.

    :param job: options of every :class:`TrainingJob`, such as ``seed``; a stage's own ``eval_freq``
        and ``eval_episodes`` take precedence.
    :param name: name of the pipeline, for its folder.
    :raises ConfigError: settings that do not fit, named with their stage, before the first one
        starts.
    :raises SB3QuadError: as :func:`~sb3_quad.training.trainer.train`; or a requirement that was
        missed.
    """
    jobs = stage_jobs(pipeline, job)
    folder = claim_folder(Path(jobs[0].log_folder) / name, name)
    # The settings are written, too, since their files may change before a resume.
    stages = []
    for number, (stage, planned) in enumerate(zip(pipeline.stages, jobs, strict=True)):
        settings = f"stage_{number}.yml"
        write_yaml(folder / settings, {stage.env: planned.config.settings})
        stages.append(stage.model_copy(update={"conf_file": settings, "settings": {}}))
    status = Status(stages=stages, job=dict(job), runs=[])
    content = status.model_dump(mode="json", exclude_defaults=True)
    write_yaml(folder / STATUS_FILE, content)
    own = jobs[0].model_dump(include={"log_folder", "tensorboard_log"})
    return resume_pipeline(folder, report, **own)


def stage_jobs(pipeline: Pipeline, job: StrMapping) -> list[TrainingJob]:
    """Return the checked job of each stage.

    :raises ConfigError: settings of a stage, or options of its job, that do not fit.
    """
    jobs: list[TrainingJob] = []
    for stage in pipeline.stages:
        with named(f"stage {stage.name!r}"):
            made = stage.job(job)
            _check_correction(stage, made.config)
            if jobs and bool(made.config.normalize) != bool(jobs[-1].config.normalize):
                raise ConfigError("normalize: must be as in the stage before, whose agent it has")
            if stage.require and "require" in stage.model_fields_set and made.eval_episodes == 0:
                raise ConfigError("require: needs evaluations; give --eval-episodes")
        jobs.append(made.model_copy(update={"seed": (made.seed + stage.seed_offset) % LARGEST}))
    return jobs


def _check_correction(stage: Stage, config: TrainingConfig) -> None:
    """Check that the offset of a stage's agent can be corrected, if it is to be."""
    wrapped = config.env_wrapper or config.vec_env_wrapper
    fits = config.task and not wrapped and config.flight_settings.size == OBSERVATION_SIZE
    if stage.correct_offset and not fits:
        raise ConfigError(
            "correct_offset: is for agents in this package's environments without wrappers, "
            f"which see the {OBSERVATION_SIZE} features alone; remove it"
        )


def resume_pipeline(folder: Path, report: Report = print, **changes: Any) -> PipelineResult:
    """Resume an interrupted or killed pipeline within its current stage, then train the others.

    :param changes: options of the jobs to change, as for
        :func:`~sb3_quad.training.trainer.resume`.
    :raises ConfigError: a folder that another process works on, or with a damaged ``pipeline.yml``.
    """
    refuse_links(folder)
    content, where = SETTINGS.read(folder / STATUS_FILE)
    status = validate(Status, content, where)
    log_folder = folder.absolute().parent.parent
    stages = []
    for stage in status.stages:
        settings = str(folder / str(stage.conf_file))
        stages.append(stage.model_copy(update={"conf_file": settings}))
    options = {**status.job, "log_folder": str(log_folder), **changes}
    jobs = stage_jobs(Pipeline(stages=stages), options)
    for job in jobs:
        refuse_elsewhere(job, where, log_folder, changes)
    runs = []
    for name in status.runs:
        refuse_outside(log_folder / name, f"{where}: runs", log_folder)
        refuse_links(log_folder / name)
        runs.append(open_run(log_folder / name))
    results: dict[str, StageResult] = {}
    handed: HandOver | None = None

    def note(number: int, run: RunFolder) -> None:
        """Record a stage's run folder before its training begins."""
        runs[number:] = [run]
        names = [run.path.absolute().relative_to(log_folder).as_posix() for run in runs]
        content["runs"] = names
        write_yaml(folder / STATUS_FILE, content)

    with locked(folder, "pipeline"), StopSignals(patience=0) as signals:
        try:
            for number, (stage, job) in enumerate(zip(stages, jobs, strict=True)):
                if handed is not None:
                    job = job.model_copy(update={"initial_policy": str(handed.agent)})
                flown: list[Flown] = []
                if handed is not None and stage.rivals and with_vehicle(job):
                    before = fly_agent(stages[number - 1].name, job)
                    flown = fly_rivals(
                        before, job, stage.rivals, stage.rival_settings, folder, report
                    )
                    job = best_of(flown, HEAD_START).job or job
                state = state_of(runs, number, job.config.n_timesteps)
                if state == "done":
                    run = runs[number]
                    seconds = 0.0
                else:
                    report(f"stage {number + 1} of {len(jobs)}, {stage.name}: {describe(job)}")
                    if state == "begun":
                        own = {"initial_policy": job.initial_policy}
                        trained = resume(str(runs[number].path), report, **changes, **own)
                    else:
                        trained = train(job, report, on_start=partial(note, number))
                    run = trained.run
                    seconds = trained.seconds
                # ``signals`` also has the signal that ended a training.
                if signals.received:
                    break
                handed = _agent(stage, job, run, report)
                if flown:
                    after = job.model_copy(update={"initial_policy": str(handed.agent)})
                    flown.insert(0, fly_agent(stage.name, after))
                    report(str(flown[0]))
                    best = best_of(flown)
                    if best.job is not None and best.job is not after:
                        agent = Path(str(best.job.initial_policy))
                        problem = f"{best.label} flies this vehicle better"
                        handed = HandOver(agent, {}, problem=problem)
                results[stage.name] = StageResult(str(run.path), str(handed.agent), seconds)
        except KeyboardInterrupt:
            if not signals.received:
                raise
    if signals.received:
        report(f"to resume the whole pipeline: --resume {shlex.quote(str(folder))}")
        return PipelineResult(folder, results, jobs[0], exit_code=signals.exit_code)
    assert handed is not None
    content["agent"] = os.path.relpath(handed.agent, log_folder)
    write_yaml(folder / STATUS_FILE, content)
    exit_code = int(bool(handed.problem))
    return PipelineResult(folder, results, jobs[0], str(handed.agent), handed.problem, exit_code)


def state_of(runs: Sequence[RunFolder], number: int, n_timesteps: int) -> State:
    """Return how far a stage of a pipeline is, by the run folders.

    :param runs: those of the stages that have begun.
    :param number: the stage, from 0.
    :param n_timesteps: timesteps of the stage.
    """
    if number >= len(runs):
        return "new"
    run = runs[number]
    # A callback may end a stage early. If the next stage has a run, this one had ended.
    if number + 1 < len(runs) or run.timesteps >= n_timesteps:
        return "done"
    # A run that has a model and no snapshot cannot be resumed, so it begins again.
    return "begun" if run.not_begun or run.resume_state.is_file() else "new"


def _agent(stage: Stage, job: TrainingJob, run: RunFolder, report: Report) -> HandOver:
    """Return what a stage hands over, after its offset correction, if any.

    :raises TrainingError: it misses the requirement of the stage.
    """
    handed = hand_over(run, job.config.best_by, stage.pass_on)
    # Environments of others need not report the rate that is required by default.
    unknown = 0.0 if "require" in stage.model_fields_set else 1.0
    for name, required in stage.require.items():
        rate = np.mean(handed.row.get(RATES[name.removesuffix("_rate")], unknown))
        if rate < required:
            raise TrainingError(
                f"stage {stage.name!r}: {name} {rate:.3f} "
                f"misses what it requires, {required}; its run is {run.path}"
            )
    if handed.is_start:
        kept = Path(str(job.initial_policy))
        why = handed.problem or "none of its evaluations is better"
        report(f"{stage.name}: {why}; it hands over the agent that it started from, {kept}")
        return handed._replace(agent=kept)
    if not stage.correct_offset:
        return handed
    if run.corrected_model.is_file():
        return handed._replace(agent=run.corrected_model)
    model = load_zip(job.config.algorithm, handed.agent, device=job.device)
    report("correcting the agent's offset, which may take minutes")
    change = correct_offset(
        model, seed_for("correction", job.seed), job.flight_settings, stage.correct_offset
    )
    save_model(model, run.corrected_model)
    report(
        f"corrected: steady offset {change.before:.3f} m, now {change.after:.3f} m: "
        f"{run.corrected_model}"
    )
    return handed._replace(agent=run.corrected_model)
