"""Several training jobs in a row, each starting from the agent of the one before: the two stages of
the thesis (4.2).

A pipeline's file lists its stages in order, as ``zoo_configs/two_stage.yml`` does; :class:`Stage`
says the keys.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import yaml
from pydantic import (
    Field,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    field_validator,
    model_validator,
)

from sb3_quad.algorithms.offset_correction import correct_hover, correct_offset
from sb3_quad.base.errors import ConfigError, TrainingError
from sb3_quad.base.files import locked, save_model, write_text
from sb3_quad.base.literals import parse_mapping
from sb3_quad.base.process import StopSignals
from sb3_quad.base.seeds import LARGEST, seed_for
from sb3_quad.base.validate import Frozen, validate
from sb3_quad.controllers.zips import load_zip
from sb3_quad.evaluation.learning_curves import read_curve
from sb3_quad.simulation.observation import OBSERVATION_SIZE
from sb3_quad.training.algorithms import get_algorithm
from sb3_quad.training.arrival_correction import LEFT, correct_arrival
from sb3_quad.training.config import SETTINGS, load_config, with_vehicle_path
from sb3_quad.training.job import TrainingJob, describe
from sb3_quad.training.runs import RunFolder, claim_folder, open_run
from sb3_quad.training.trainer import resume, train, trained_seconds

STATUS_FILE = "pipeline.yml"


class Requirement(Frozen):
    """What the best evaluation of a stage must reach before the next one begins."""

    success_rate: Annotated[float, Field(ge=0, le=1)] = 0.0
    mean_reward: float | None = None


class Stage(Frozen):
    """One stage of a pipeline."""

    name: str = Field(min_length=1, description="what the stage is called in tables")
    algo: str = Field(description="as for a single run")
    env: str = Field(description="as for a single run")
    conf_file: str | None = Field(
        default=None, description="settings file; <algo>.yml of the package without it"
    )
    settings: dict[str, Any] = Field(
        default={}, description="changes to these settings, such as n_timesteps: 5_000_000"
    )
    seed_offset: NonNegativeInt = Field(
        default=0,
        description="added to the seed, so that a stage sees other episodes than one before it on the same task",
    )
    pass_on: Literal["best", "last"] = Field(
        default="best", description="the best evaluation, as best_by of its settings says"
    )
    correct_offset: Literal["position", "hover", "arrival"] | None = Field(
        default=None, description="algorithms.offset_correction, .arrival say how"
    )
    position_scale: PositiveFloat = Field(
        default=1.0, description="α, which correct_offset: position makes a part of the agent"
    )
    overshoot_cost: NonNegativeFloat = Field(
        default=LEFT, description="s that correct_offset: arrival counts for a target left again"
    )
    correction_env_kwargs: dict[str, Any] = Field(
        default={}, description="changes to env_kwargs in which correct_offset: arrival counts, too"
    )
    correction_rounds: PositiveInt = Field(
        default=1,
        description="how often correct_offset: arrival searches, each time from what it found before",
    )
    require: Requirement = Field(
        default=Requirement(), description="the pipeline stops where this is missed"
    )
    eval_freq: int | None = Field(
        default=None, description="timesteps between evaluations of this stage"
    )
    eval_episodes: PositiveInt | None = Field(default=None, description="episodes in each")

    @model_validator(mode="after")
    def _of_its_trim(self) -> "Stage":
        for name in (
            "position_scale",
            "overshoot_cost",
            "correction_env_kwargs",
            "correction_rounds",
        ):
            kind = "position" if name == "position_scale" else "arrival"
            if (
                getattr(self, name) != type(self).model_fields[name].default
                and self.correct_offset != kind
            ):
                raise ValueError(f"{name} goes with correct_offset: {kind}")
        return self


class Pipeline(Frozen):
    """The stages, in order."""

    stages: tuple[Stage, ...] = Field(min_length=1)

    @field_validator("stages")
    @classmethod
    def _of_their_own_names(cls, stages: tuple[Stage, ...]) -> tuple[Stage, ...]:
        if len({stage.name for stage in stages}) < len(stages):
            raise ValueError(
                f"{', '.join(stage.name for stage in stages)}: give each a name of its own"
            )
        return stages


class Status(Pipeline):
    """What ``pipeline.yml`` in a pipeline's folder holds."""

    job: dict[str, Any] = Field(description="arguments of every job")
    runs: tuple[str, ...] = Field(description="the run folders of the stages that have begun")


class StageResult(NamedTuple):
    """A finished stage.

    :param run: its run folder.
    :param agent: the zip that is passed on.
    :param seconds: of training; of a stage that was resumed, since then.
    """

    run: str
    agent: str
    timesteps: int
    seconds: float


@dataclass(frozen=True)
class PipelineResult:
    """How a pipeline ended.

    :param stages: by name, all of them, or those before an interruption (then ``exit_code`` is not
        0).
    :param job: that of the first stage.
    """

    folder: Path
    stages: dict[str, StageResult]
    job: TrainingJob
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
    """The pipeline with ``changes`` put over the settings of every stage (into them, for
    ``env_kwargs``).
    """
    stages = []
    for stage in pipeline.stages:
        settings = {**stage.settings, **changes}
        parts = [
            parse_mapping(given.get("env_kwargs"), f"{stage.name}: env_kwargs")
            for given in (stage.settings, changes)
        ]
        if any(parts):
            settings["env_kwargs"] = with_vehicle_path({**parts[0], **parts[1]})
        stages.append(stage.model_copy(update={"settings": settings}))
    return pipeline.model_copy(update={"stages": tuple(stages)})


def run_pipeline(
    pipeline: Pipeline, job: Mapping[str, Any], name: str, report: Callable[[str], None] = print
) -> PipelineResult:
    """Train the stages one after the other, each from the agent that the one before passed on.

    Their run folders lie where single runs lie; ``<log_folder>/<name>/<name>_<run>/pipeline.yml``
    says which they are.

    :param job: arguments of every :class:`TrainingJob`, such as ``seed``; a stage's own
        ``eval_freq`` and ``eval_episodes`` go before them.
    :param name: of the pipeline, for its folder.
    :raises ConfigError: settings that do not fit, named with their stage, before the first one
        starts.
    :raises SB3QuadError: as :func:`~sb3_quad.training.trainer.train`; or a requirement that was
        missed.
    """
    status = Status(stages=pipeline.stages, job=dict(job), runs=())
    jobs = stage_jobs(status, status.job)
    return _train_stages(claim_folder(Path(jobs[0].log_folder) / name, name), status, jobs, report)


def resume_pipeline(
    folder: Path, report: Callable[[str], None] = print, **changes: Any
) -> PipelineResult:
    """Go on with an interrupted or killed pipeline: within the stage that was under way, then with
    the stages after it.

    :param changes: arguments of the jobs to change, as for
        :func:`~sb3_quad.training.trainer.resume`.
    :raises ConfigError: a folder that another process works on, or with a damaged ``pipeline.yml``.
    """
    status = validate(Status, *SETTINGS.read(folder / STATUS_FILE))
    status = status.model_copy(update={"job": {**status.job, **changes}})
    return _train_stages(folder, status, stage_jobs(status, status.job), report, **changes)


def stage_jobs(pipeline: Pipeline, job: Mapping[str, Any]) -> list[TrainingJob]:
    """What each stage trains, checked.

    :raises ConfigError: settings of a stage, or arguments of its job, that do not fit.
    """
    jobs = []
    for stage in pipeline.stages:
        where = f"stage {stage.name!r}"
        try:
            config = load_config(stage.algo, stage.env, stage.conf_file, stage.settings)
            if stage.correct_offset == "arrival":
                config.flight_settings.with_changes(**stage.correction_env_kwargs)
        except ConfigError as error:
            raise ConfigError(f"{where}: {error}") from None
        if (
            stage.correct_offset in ("position", "hover")
            and config.task is not None
            and config.flight_settings.size != OBSERVATION_SIZE
        ):
            raise ConfigError(
                f"{where}: correct_offset: {stage.correct_offset} is for agents that see the 18 features alone"
            )
        own = stage.model_dump(include={"eval_freq", "eval_episodes"}, exclude_none=True)
        made = validate(TrainingJob, {**job, **own, "config": config}, where)
        jobs.append(made.model_copy(update={"seed": (made.seed + stage.seed_offset) % LARGEST}))
    return jobs


def _train_stages(
    folder: Path,
    status: Status,
    jobs: list[TrainingJob],
    report: Callable[[str], None],
    **changes: Any,
) -> PipelineResult:
    """Train what is left of the stages. A stage's run folder is noted before its training begins."""
    runs, results = [*status.runs], {}
    agent: str | None = None

    def note(number: int, run: RunFolder) -> None:
        runs[number:] = [str(run.path)]
        write()

    def write() -> None:
        content = status.model_copy(update={"runs": tuple(runs)}).model_dump(
            mode="json", exclude_defaults=True
        )
        write_text(folder / STATUS_FILE, yaml.safe_dump(content, sort_keys=False))

    with locked(folder, "pipeline"), StopSignals(patience=0) as signals:
        try:
            write()
            for number, (stage, job) in enumerate(zip(status.stages, jobs, strict=True)):
                run = open_run(runs[number]) if number < len(runs) else None
                if run is not None and run.timesteps >= job.config.n_timesteps:
                    timesteps, seconds = run.timesteps, trained_seconds(run)
                else:
                    start = job.model_copy(update={"trained_agent": agent}) if agent else job
                    report(f"{stage.name}: {describe(start)}")
                    begun = run is not None and (run.not_begun or run.resume_state.is_file())
                    trained = (
                        resume(runs[number], report, **changes)
                        if begun
                        else train(start, report, on_start=partial(note, number))
                    )
                    if trained.exit_code:
                        break
                    run, timesteps, seconds = (
                        trained.run,
                        trained.model.num_timesteps,
                        trained.seconds,
                    )
                if signals.received is not None:
                    break
                agent = str(
                    _corrected(stage, job, run, report)
                    if stage.correct_offset
                    else _passed_on(stage, job, run)
                )
                results[stage.name] = StageResult(str(run.path), agent, timesteps, seconds)
        except KeyboardInterrupt:
            if signals.received is None:
                raise
    if signals.received is not None:
        report(f"to go on with the whole pipeline: --resume {folder}")
    return PipelineResult(folder, results, jobs[0], signals.exit_code)


def _passed_on(stage: Stage, job: TrainingJob, run: RunFolder) -> Path:
    """The zip that a stage passes on, before it is trimmed; TrainingError if it misses what the
    stage requires.
    """
    if run.evaluations.is_file():
        curve = read_curve(run.path)
        share, success = (
            np.nan_to_num(curve.values(name)) for name in (job.config.best_by, "success")
        )
        scores = list(zip(share, curve.reward, success, strict=True))
        _, reward, success = max(scores) if stage.pass_on == "best" else scores[-1]
        wanted = -np.inf if stage.require.mean_reward is None else stage.require.mean_reward
        if success < stage.require.success_rate or reward < wanted:
            raise TrainingError(
                f"stage {stage.name!r}: success {success:.3f} and mean reward {reward:.2f} miss what it requires "
                f"(success_rate {stage.require.success_rate:g}, mean_reward {wanted:g}); its run is {run.path}"
            )
    return run.best_model if stage.pass_on == "best" and run.best_model.is_file() else run.model


def _corrected(
    stage: Stage, job: TrainingJob, run: RunFolder, report: Callable[[str], None]
) -> Path:
    """The trimmed agent of a stage, which lies beside the one that it is made of."""
    if run.corrected_model.is_file():
        return run.corrected_model
    model = load_zip(get_algorithm(job.config.algo), _passed_on(stage, job, run), device=job.device)
    report(f"trimming the agent ({stage.correct_offset}), which may take minutes")
    seed = seed_for("correction", job.seed)
    if stage.correct_offset == "hover":
        did = correct_hover(model, seed, job.flight_settings)
        words = f"action at the target {did.before:.4f} from hover, now {did.after:.4f}"
    elif stage.correct_offset == "arrival":
        flown = job.config.flight_settings.with_changes(**stage.correction_env_kwargs)
        seeds = [seed_for("correction", job.seed + i) for i in range(stage.correction_rounds)]
        found = [
            correct_arrival(model, each, job.flight_settings, flown, stage.overshoot_cost)
            for each in seeds
        ]
        words = "slow arrivals, failures and losses cost " + "; ".join(
            f"{a:.2f} s, now {b:.2f} s" for a, b in found
        )
    else:
        did = correct_offset(model, seed, job.flight_settings, stage.position_scale)
        words = f"steady offset {did.before:.3f} m, now {did.after:.3f} m"
    save_model(model, run.corrected_model)
    report(f"trimmed: {words}: {run.corrected_model}")
    return run.corrected_model
