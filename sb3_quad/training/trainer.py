"""Runs a training job: from its settings to a run folder with a model, also after a signal or an
error.

A snapshot of a run lies between two rollouts. Where the environments can be restored (the batched
one can), the resumed run is bit for bit the one that was not interrupted; elsewhere episodes start
anew.
"""

import copy
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback, ProgressBarCallback
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv

from sb3_quad.algorithms.transfer import transfer_policy
from sb3_quad.base.errors import ConfigError, SB3QuadError, TrainingError
from sb3_quad.base.files import locked, make_folder, one_line, save_model, write_bytes
from sb3_quad.base.process import StopSignals
from sb3_quad.base.seeds import seed_for
from sb3_quad.base.validate import validate
from sb3_quad.callbacks.best_model import BestModel
from sb3_quad.callbacks.episodes import EpisodeLog
from sb3_quad.callbacks.every import Checkpoint
from sb3_quad.controllers.controller import Controller
from sb3_quad.controllers.resolve import resolve_expert
from sb3_quad.controllers.zips import load_model
from sb3_quad.evaluation.learning_curves import read_curve
from sb3_quad.training.algorithms import get_algorithm, takes_expert
from sb3_quad.training.config import TrainingConfig, build_config
from sb3_quad.training.environments import WORKER_ENDED, make_environments
from sb3_quad.training.job import TrainingJob
from sb3_quad.training.runs import MADE_WITH, RunFolder, claim_run, made_with, open_run
from sb3_quad.training.snapshots import Snapshot, SnapshotFile, load_snapshot
from sb3_quad.training.tracking import HyperparameterLog, tracked
from sb3_quad.training.values import instance

NOISES = {"normal": NormalActionNoise, "ornstein-uhlenbeck": OrnsteinUhlenbeckActionNoise}
Report = Callable[[str], None]
ShouldContinue = Callable[[float, float], bool]
EvalEnvs = dict[str | None, VecEnv]


@dataclass(frozen=True)
class TrainingResult:
    """How a run ended.

    :param seconds: wall-clock time of the training, evaluations along the way included.
    :param signal: the name of the signal that interrupted it, empty if none did.
    :param exit_code: 0; 130 after SIGINT, 143 after SIGTERM, 129 after SIGHUP.
    """

    job: TrainingJob
    run: RunFolder
    model: BaseAlgorithm
    seconds: float
    signal: str = ""
    exit_code: int = 0


def train(
    job: TrainingJob,
    report: Report = print,
    on_start: Callable[[RunFolder], None] = lambda run: None,
    should_continue: ShouldContinue = lambda success, reward: True,
) -> TrainingResult:
    """Train as ``job`` says, in a run folder of its own.

    :param report: called with one line for each event.
    :param on_start: called with the run folder before the training begins.
    :param should_continue: called after each evaluation with its success rate and mean reward;
        False ends the training.
    :raises SB3QuadError: bad settings; or a training that cannot go on, after the last good model
        was saved.
    """
    config = job.config
    if job.tensorboard_log is not None:  # before there is a run folder, which would stay empty
        make_folder(job.tensorboard_log, "TensorBoard folder", "-tb")
    with StopSignals() as signals, _environments(job) as (env, eval_envs):
        model = build_model(job, env)
        callbacks = _own_callbacks(config)  # a misspelt keyword leaves no run folder
        with tracked(job):
            run = claim_run(job.log_folder, config.algo, config.env_id, job.uuid)
            with locked(run.path, "run folder"):
                run.write_yaml(config.settings, job.arguments() | made_with())
                on_start(run)
                return _learn(
                    job, run, model, eval_envs, callbacks, signals, report, should_continue
                )


def resume(run_folder: str, report: Report = print, **changes: Any) -> TrainingResult:
    """Go on with an interrupted or killed run, in its folder: same settings, seed, optimiser,
    dataset and step count.

    A run that has not come to its first rollout is begun; one that is complete gives its result.

    :param changes: arguments of the job to change, such as ``progress``.
    :raises SB3QuadError: a folder without such a run, one that another process trains, or with
        damaged files; else as :func:`train`.
    """
    run = open_run(run_folder)
    settings, arguments = run.read_yaml()
    if not {"algo", "env"} <= arguments.keys():
        raise ConfigError(f"{run.arguments}: algo or env is missing")
    config = build_config(str(arguments["algo"]), str(arguments["env"]), settings, str(run.config))
    given = {
        key: value
        for key, value in arguments.items()
        if key not in ("algo", "env", "env_kwargs", *MADE_WITH)
    }
    job = validate(TrainingJob, {**given, **changes, "config": config}, str(run.arguments))
    with (
        StopSignals() as signals,
        locked(run.path, "run folder"),
        _environments(job) as (env, eval_envs),
    ):
        if run.timesteps >= config.n_timesteps:
            report(
                f"complete, {run.timesteps:,} timesteps; to train its agent further: -i {run.path}"
            )
            return TrainingResult(job, run, load_model(run.model, job.device), trained_seconds(run))
        if run.not_begun:
            model = build_model(job, env)
        else:
            attributes = _expert(config) | {
                "tensorboard_log": job.tensorboard_log,
                "verbose": job.verbose,
            }
            model = load_snapshot(run, config.algo, env, job.device, **attributes)
            env.seed(seed_for("training", job.seed))  # as in build_model
        report(f"going on after {model.num_timesteps:,} of {config.n_timesteps:,} timesteps")
        with tracked(job):
            return _learn(job, run, model, eval_envs, _own_callbacks(config), signals, report)


@contextmanager
def _environments(job: TrainingJob) -> Iterator[tuple[VecEnv, EvalEnvs]]:
    """The environments to train in and those to evaluate in; closed in the end.

    The latter by task, the run's own first, whose name is None; none if there are no evaluations.
    """
    config = job.config
    evaluating: EvalEnvs = {}
    with ExitStack() as stack:
        made = make_environments(
            config, config.n_envs, seed_for("training", job.seed), staggered=True
        )
        env = stack.enter_context(closing(made))
        if job.eval_episodes > 0:
            n_envs = job.n_eval_envs or (job.eval_episodes if config.vec_env == "batch" else 1)
            for task in (None, *config.eval_tasks):
                settings = job.for_evaluation() if task is None else job.for_evaluation(task=task)
                made = make_environments(
                    settings, min(n_envs, job.eval_episodes), seed_for("evaluation", job.seed)
                )
                evaluating[task] = stack.enter_context(closing(made))
        yield env, evaluating


def _expert(config: TrainingConfig) -> dict[str, Any]:
    if not takes_expert(get_algorithm(config.algo)):
        return {}
    vehicle, layout = config.env_kwargs.get("vehicle", "itm"), config.env_kwargs.get("rotor_layout")
    return {"expert": resolve_expert(config.expert, vehicle, layout=layout)}


def _own_callbacks(config: TrainingConfig) -> list[BaseCallback]:
    return [instance(path, "callback", **kwargs) for path, kwargs in config.callback]


def build_model(job: TrainingJob, env: VecEnv) -> BaseAlgorithm:
    """The algorithm of a job, new, with the policy that it starts from.

    :raises ConfigError: settings that it refuses, or for which this machine has too little memory;
        an agent that does not fit.
    :raises ExpertError: an expert that fails when it is asked for the first time.
    """
    config = job.config
    keywords = {**copy.deepcopy(config.hyperparams), **_expert(config)}
    if config.noise_type is not None:
        zeros = np.zeros(env.action_space.shape or ())
        keywords["action_noise"] = NOISES[config.noise_type](zeros, zeros + config.noise_std)
    if config.policy_kwargs:
        keywords["policy_kwargs"] = config.policy_kwargs
    keywords |= {
        "seed": job.seed,
        "device": job.device,
        "verbose": job.verbose,
        "tensorboard_log": job.tensorboard_log,
    }
    try:
        model = get_algorithm(config.algo)(config.policy, env, **keywords)
    except SB3QuadError:
        raise
    except MemoryError as error:
        sizes = "n_steps by n_envs, buffer_size or dataset_capacity"
        raise ConfigError(
            f"{config.algo}: {sizes} is more than this machine's memory ({one_line(error)})"
        ) from None
    except (TypeError, ValueError, AssertionError, RuntimeError) as error:
        raise ConfigError(
            f"{config.algo} cannot be made with these settings ({one_line(error)})"
        ) from error
    asked: Callable[[], bool] = getattr(model, "will_clone", lambda: "expert" in keywords)
    if asked():  # an expert that fails does so before there is a run folder
        observation: Any = env.reset()
        Controller.for_env(keywords["expert"], env).labels(observation)
    rate = keywords.get("learning_rate")
    if isinstance(rate, LinearSchedule):  # SB3's last update has its end: at 0 it would do nothing
        rate.end = rate.start / -(-config.n_timesteps // (config.rollout_steps * env.num_envs))
    if job.trained_agent is not None:
        transfer_policy(job.trained_agent, model)
    env.seed(seed_for("training", job.seed))  # SB3 has seeded it with the seed of the policy
    return model


def _learn(
    job: TrainingJob,
    run: RunFolder,
    model: BaseAlgorithm,
    eval_envs: EvalEnvs,
    own_callbacks: list[BaseCallback],
    signals: StopSignals,
    report: Report,
    should_continue: ShouldContinue = lambda success, reward: True,
) -> TrainingResult:
    config = job.config
    last_good, best = (
        SnapshotFile(run, job.snapshot_every, report, lambda: signals.received is not None),
        None,
    )
    if config.task is not None and not (
        config.env_wrapper or config.vec_env_wrapper
    ):  # flights have no wrappers
        job.flight_settings.write_into(model)
    callbacks: list[BaseCallback] = [
        last_good,
        EpisodeLog(run.episodes, config.env_id),
        HyperparameterLog(job),
    ]
    if eval_envs:
        best = BestModel(
            eval_envs[None],
            every=job.eval_freq if job.eval_freq > 0 else 2**62,
            n_episodes=job.eval_episodes,
            seed=seed_for("evaluation", job.seed),
            best_model=run.best_model,
            evaluations=run.evaluations,
            report=report,
            others={task: env for task, env in eval_envs.items() if task is not None},
            should_continue=should_continue,
            by=job.config.best_by,
        )
        callbacks.append(best)
    if job.save_freq > 0:
        callbacks.append(Checkpoint(job.save_freq, str(run.checkpoint("{steps}"))))
    callbacks += own_callbacks
    if job.progress:
        callbacks.append(ProgressBarCallback())
    callbacks.append(
        ConvertCallback(lambda local, _: signals.received is None or not last_good.is_fresh)
    )
    start = time.perf_counter()
    try:
        try:
            model.learn(
                config.n_timesteps - model.num_timesteps,
                callback=callbacks,
                # An off-policy algorithm counts episodes: about as many as rows end their episodes
                # once.
                log_interval=job.log_interval * (config.n_envs if config.is_off_policy else 1),
                tb_log_name=f"{config.algo}_{run.path.name}",
                reset_num_timesteps=model.num_timesteps == 0,
            )
            if (
                best is not None
                and signals.received is None
                and not best.stopped
                and best.latest < model.num_timesteps
            ):
                best.evaluate()  # a callback has ended the training before its time
        finally:
            signals.hold()
    except (Exception, KeyboardInterrupt) as error:
        if signals.received is None:
            _save_after(error, run, last_good.snapshot, model)
            raise
    seconds = time.perf_counter() - start
    if signals.received is None:
        save_model(model, run.model)
        run.resume_state.unlink(missing_ok=True)
        _refuse_removed(run, model.num_timesteps)
        return TrainingResult(job, run, model, seconds)
    after = "before the first rollout"
    if last_good.snapshot is not None:
        after = f"after {last_good.snapshot.timesteps:,} timesteps: model saved to {run.model}"
        write_bytes(run.model, last_good.snapshot.model)  # first: it needs the least room
        try:
            last_good.write()
        except ConfigError as error:
            raise ConfigError(f"{error}; interrupted {after}") from error
        _refuse_removed(run, last_good.snapshot.timesteps)
    report(f"interrupted by {signals.name} {after}; to go on: --resume {run.path}")
    return TrainingResult(job, run, model, seconds, signals.name, signals.exit_code)


def trained_seconds(run: RunFolder) -> float:
    """Wall-clock time that a complete run took, as far as its evaluations say."""
    return float(read_curve(run.path).seconds[-1]) if run.evaluations.is_file() else 0.0


def _refuse_removed(run: RunFolder, timesteps: int) -> None:
    """:raises TrainingError: the run's folder was removed while it trained, and has been made again
    for the model alone.
    """
    if not run.arguments.is_file():
        raise TrainingError(
            f"run folder {run.path}: was removed while the training wrote to it; the model after {timesteps:,} timesteps is in"
            f" {run.model}, the run's settings and what it had noted before are lost"
        )


def _save_after(
    error: BaseException, run: RunFolder, snapshot: Snapshot | None, model: BaseAlgorithm
) -> None:
    """Save the last good model; an error of this package's, or of one of its kinds, is raised anew
    and says where that is.
    """
    where = ""
    if snapshot is not None:
        write_bytes(run.model, snapshot.model)
        where = f"; the model after {snapshot.timesteps:,} timesteps is in {run.model}"
    if isinstance(error, SB3QuadError):
        raise type(error)(f"{error}{where}") from error
    if isinstance(error, (EOFError, ConnectionError)):
        raise TrainingError(f"{WORKER_ENDED}{where}") from error
    if isinstance(error, ValueError) and not all(
        th.isfinite(each).all() for each in model.policy.parameters()
    ):
        raise TrainingError(
            f"the policy's parameters are no longer finite; lower learning_rate{where}"
        ) from error
