"""Runs a training job: from its settings to a run folder with a model.

A run that a signal or an error ends leaves a model and a snapshot, taken between two rollouts. If
the environments can be restored (the batched one can), the resumed run equals an uninterrupted one
bit for bit; otherwise the episodes start again.
"""

import copy
import inspect
import pickle
import shlex
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, ProgressBarCallback
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv

from sb3_quad.agents.transfer import transfer_policy
from sb3_quad.algorithms.chain import STATISTICS, note_chain, share_statistics, statistics_of
from sb3_quad.algorithms.labelling import Labeller
from sb3_quad.base.errors import ConfigError, SB3QuadError, TrainingError
from sb3_quad.base.files import (
    locked,
    make_folder,
    one_line,
    refuse_links,
    save_model,
    write_bytes,
    write_text,
)
from sb3_quad.base.imports import require
from sb3_quad.base.process import StopSignals
from sb3_quad.base.seeds import seed_for
from sb3_quad.base.types import Report, StrDict
from sb3_quad.base.validate import validate
from sb3_quad.callbacks.best_model import BestModel, ShouldContinue
from sb3_quad.callbacks.every import Checkpoint, EpisodeLog, ProgressLine
from sb3_quad.callbacks.snapshot import SnapshotFile
from sb3_quad.training.algorithms import instance
from sb3_quad.training.config import TrainingConfig, TrainingJob, build_config, load_agent
from sb3_quad.training.environments import WORKER_ENDED, make_environments
from sb3_quad.training.runs import (
    MADE_WITH,
    RunFolder,
    claim_run,
    made_with,
    open_run,
    refuse_elsewhere,
)
from sb3_quad.training.snapshots import load_snapshot

NEVER = 2**62  # timesteps
OWN_TASK = ""  # the name of evaluations on the task of the training


class TrainingResult(NamedTuple):
    """How a run ended.

    :param seconds: wall-clock time of the training, evaluations included.
    :param exit_code: 0; 130 after SIGINT, 143 after SIGTERM, 129 after SIGHUP.
    """

    job: TrainingJob
    run: RunFolder
    model: BaseAlgorithm
    seconds: float
    exit_code: int = 0


def train(
    job: TrainingJob,
    report: Report = print,
    on_start: Callable[[RunFolder], None] = lambda run: None,
    should_continue: ShouldContinue = lambda success, reward: True,
) -> TrainingResult:
    """Train a job in a new run folder.

    :param report: called with one line for each event.
    :param on_start: called with the run folder before the training begins.
    :param should_continue: called after each evaluation with its success rate and mean reward;
        False ends the training.
    :raises SB3QuadError: bad settings; or a training that cannot continue, after the last good
        model was saved.
    """
    # Check everything first, so that no empty run folder is left.
    if job.tensorboard_log is not None:
        make_folder(job.tensorboard_log, "TensorBoard folder", "-tb")
    with StopSignals() as signals, _environments(job) as (env, eval_envs):
        model = build_model(job, env)
        callbacks = _user_callbacks(job.config)
        with tracked(job):
            run = claim_run(job.log_folder, job.config.algo, job.config.env_id)
            with locked(run.path, "run folder"):
                run.write_yaml(job.config.settings, job.arguments() | made_with())
                on_start(run)
                return _Training(
                    job, run, model, eval_envs, callbacks, signals, report, should_continue
                ).run_to_end()


def resume(run_folder: str, report: Report = print, **changes: Any) -> TrainingResult:
    """Continue an interrupted or killed run in its folder.

    Settings, seed, optimiser, dataset and step count stay the same. A run that has not reached its
    first rollout is started.

    :param changes: options of the job to change, such as ``progress``.
    :raises SB3QuadError: a folder without such a run, or with a complete one; one that another
        process trains, or with damaged files; otherwise as :func:`train`.
    """
    run = open_run(run_folder)
    refuse_links(run.path)
    settings, options = run.read_yaml()
    if not {"algo", "env"} <= options.keys():
        raise ConfigError(f"{run.arguments}: algo or env is missing")
    config = build_config(str(options["algo"]), str(options["env"]), settings, str(run.config))
    # These are in args.yml for readers only; they are not options.
    for name in ("algo", "env", "env_kwargs", *MADE_WITH):
        options.pop(name, None)
    job = validate(TrainingJob, {**options, **changes, "config": config}, str(run.arguments))
    log_folder = run.path.absolute().parent.parent
    refuse_elsewhere(job, str(run.config.parent), log_folder, changes)
    with (
        StopSignals() as signals,
        locked(run.path, "run folder"),
        _environments(job) as (env, eval_envs),
    ):
        if run.not_begun:
            model = build_model(job, env)
        else:
            model = load_snapshot(run, job, env, **_expert(config))
            env.seed(seed_for("training", job.seed))  # as in build_model
        report(f"resuming after {model.num_timesteps:,} of {config.n_timesteps:,} timesteps")
        callbacks = _user_callbacks(config)
        with tracked(job):
            return _Training(job, run, model, eval_envs, callbacks, signals, report).run_to_end()


@contextmanager
def _environments(job: TrainingJob) -> Iterator[tuple[VecEnv, dict[str, VecEnv]]]:
    """Make the environments to train in and those to evaluate in, and close them at the end.

    The latter are a mapping by task, with the job's own under OWN_TASK; it is empty without
    evaluations.
    """
    config = job.config
    eval_envs = {}
    with ExitStack() as stack:
        seed = seed_for("training", job.seed)
        env = stack.enter_context(
            closing(make_environments(config, config.n_envs, seed, staggered=True))
        )
        if job.eval_episodes > 0:
            # The batched environment flies all episodes of an evaluation at once.
            most = job.eval_episodes if config.vec_env == "batch" else 1
            n_envs = min(job.n_eval_envs or most, job.eval_episodes)
            seed = seed_for("evaluation", job.seed)
            for task in (OWN_TASK, *config.eval_tasks):
                eval_config = job.for_evaluation(**({"task": task} if task else {}))
                eval_envs[task] = stack.enter_context(
                    closing(make_environments(eval_config, n_envs, seed))
                )
        yield env, eval_envs


def _expert(config: TrainingConfig) -> StrDict:
    """Return the expert as a keyword of the algorithm; empty if it learns from none."""
    return {} if config.expert is None else {"expert": config.make_expert()}


def _user_callbacks(config: TrainingConfig) -> list[BaseCallback]:
    return [instance(path, "callback", **keywords) for path, keywords in config.callback]


def build_model(job: TrainingJob, env: VecEnv) -> BaseAlgorithm:
    """Make the algorithm of a job, with the policy that it starts from.

    :raises ConfigError: settings that the algorithm refuses; an agent that does not fit.
    :raises ExpertError: an expert that fails at its first query.
    """
    config = job.config
    keywords = copy.deepcopy(config.hyperparams) | _expert(config)
    if config.policy_kwargs:
        keywords["policy_kwargs"] = config.policy_kwargs
    keywords |= job.model_dump(include={"seed", "device", "verbose", "tensorboard_log"})
    agent = job.agent
    if agent is None and job.initial_policy:
        agent = load_agent(job.initial_policy)
    # The algorithms of SB3 take no agent to start from.
    takes_agent = "initial_policy" in inspect.signature(config.algorithm).parameters
    if takes_agent:
        keywords["initial_policy"] = agent
    try:
        model = config.algorithm(config.policy, env, **keywords)
    except SB3QuadError:
        raise
    except (ValueError, AssertionError) as error:
        # SB3 raises these for invalid arguments.
        raise ConfigError(
            f"{config.algo} cannot be made with these settings ({one_line(error)})"
        ) from error
    # Query the expert once, so that it fails before there is a run folder.
    if getattr(model, "will_clone", lambda: False)():
        learner: Any = model
        learner.set_expert(learner.expert)
        Labeller(learner.expert, env, check=False).labels(env.reset())
        # The reset has changed the statistics that the agent brought.
        if agent is not None:
            share_statistics(statistics_of(agent), env, training=True)
    # SB3's last update is at the end of the schedule, where a rate of 0 would do nothing.
    rate = keywords.get("learning_rate")
    if isinstance(rate, LinearSchedule):
        n_updates = -(-config.n_timesteps // (config.rollout_steps * env.num_envs))
        rate.end = rate.start / n_updates
    if agent is not None and not takes_agent:
        transfer_policy(agent, model)
    # SB3 has seeded the environments with the seed of the policy.
    env.seed(seed_for("training", job.seed))
    return model


@dataclass
class _Training:
    """The training of a model in a run folder, with its callbacks and its end.

    :param eval_envs: environments by task, the job's own under OWN_TASK; empty: no evaluations.
    :param user_callbacks: the callbacks in the settings.
    """

    job: TrainingJob
    run: RunFolder
    model: BaseAlgorithm
    eval_envs: dict[str, VecEnv]
    user_callbacks: list[BaseCallback]
    signals: StopSignals
    report: Report
    should_continue: ShouldContinue = lambda success, reward: True

    def __post_init__(self) -> None:
        job = self.job
        run = self.run
        self.snapshots = SnapshotFile(
            run.resume_state,
            job.snapshot_every,
            self.report,
            self.signals,
            run.episodes,
            run.best_model,
        )
        # They are called in this order.
        self.callbacks: list[BaseCallback] = [
            self.snapshots,
            EpisodeLog(run.episodes, job.config.env_id),
        ]
        self.best: BestModel | None = None
        if self.eval_envs:
            others = dict(self.eval_envs)
            self.best = BestModel(
                others.pop(OWN_TASK),
                job.eval_freq if job.eval_freq > 0 else NEVER,
                job.eval_episodes,
                seed_for("evaluation", job.seed),
                run.best_model,
                run.evaluations,
                self.report,
                others,
                self.should_continue,
                job.config.best_by,
                with_start=bool(job.agent or job.initial_policy),
            )
            self.callbacks.append(self.best)
        if job.save_freq > 0:
            self.callbacks.append(Checkpoint(job.save_freq, str(run.checkpoint("{steps}"))))
        self.callbacks += self.user_callbacks
        self.callbacks.append(ProgressBarCallback() if job.progress else ProgressLine(self.report))

    def run_to_end(self) -> TrainingResult:
        """Train until the job is done, or a signal or an error ends it, and save the model."""
        statistics = self.model.get_vec_normalize_env()
        setattr(self.model, STATISTICS, statistics)
        # A zip says how its agent flies, but a flight cannot have the user's wrappers.
        settings = note_chain(self.model, self.model.get_env())
        if self.job.config.task and settings is not None:
            self.job.flight_settings.write_into(self.model)
        self.run.error.unlink(missing_ok=True)
        start = time.perf_counter()
        try:
            try:
                self._learn()
            finally:
                # From here on, no signal interrupts what is saved.
                self.signals.hold()
        except (Exception, KeyboardInterrupt, SystemExit) as error:
            if not self.signals.received:
                self._save_after(error)
                raise
        seconds = time.perf_counter() - start
        if self.signals.received:
            self._save_interrupted()
        else:
            # The final statistics, where rl_zoo3 keeps them.
            if statistics is not None:
                write_bytes(self.run.config.with_name("vecnormalize.pkl"), pickle.dumps(statistics))
            save_model(self.model, self.run.model)
            self.run.resume_state.unlink(missing_ok=True)
            self._refuse_removed_folder()
        return TrainingResult(self.job, self.run, self.model, seconds, self.signals.exit_code)

    def _learn(self) -> None:
        config = self.job.config
        self.model.learn(
            config.n_timesteps - self.model.num_timesteps,
            callback=self.callbacks,
            log_interval=self.job.log_interval,
            tb_log_name=f"{config.algo}_{self.run.path.name}",
            reset_num_timesteps=self.model.num_timesteps == 0,
        )
        best = self.best
        if best is None or best.stopped or self.signals.received:
            return
        # A user's callback may have ended the training early.
        if best.latest < self.model.num_timesteps:
            best.evaluate()

    def _save_interrupted(self) -> None:
        """Save the model and the snapshot after a signal."""
        # The model comes first, since it needs the least space.
        where = self.snapshots.save_model(self.run.model)
        if where:
            try:
                self.snapshots.write()
            except ConfigError as error:
                raise ConfigError(f"{error}; interrupted{where}") from error
            self._refuse_removed_folder()
        name = self.signals.name + (where or " before the first rollout")
        self.report(f"interrupted by {name}; to resume: --resume {shlex.quote(str(self.run.path))}")

    def _refuse_removed_folder(self) -> None:
        """:raises TrainingError: the run folder was removed while it was trained.

        It has been recreated for the model only.
        """
        if not self.run.arguments.is_file():
            raise TrainingError(
                f"run folder {self.run.path}: was removed while the training wrote to it; "
                f"the model is in {self.run.model}, "
                "the run's settings and its records until then are lost"
            )

    def _save_after(self, error: BaseException) -> None:
        """Save the last good model, and the traceback of an unexpected error.

        An error with an explanation is raised again; its message says where these are.
        """
        where = self.snapshots.save_model(self.run.model)
        # An error of this package says what is wrong; a traceback would add nothing.
        if isinstance(error, SB3QuadError):
            raise type(error)(f"{error}{where}") from error
        write_text(self.run.error, "".join(traceback.format_exception(error)))
        where += f"; the traceback is in {self.run.error}"
        if isinstance(error, (EOFError, ConnectionError)):
            # Without workers, it may be the reader of the output, as in `sb3-quad train | head`.
            reason = "a connection, or the reader of the output, has ended"
            if self.job.config.vec_env == "subproc":
                reason = WORKER_ENDED
            raise TrainingError(reason + where) from error
        parameters = self.model.policy.parameters()
        if isinstance(error, ValueError) and not all(th.isfinite(p).all() for p in parameters):
            raise TrainingError(
                f"the policy's parameters are no longer finite; lower learning_rate{where}"
            ) from error
        # The command line prints the notes of an error that no check anticipated.
        error.__notes__ = [*getattr(error, "__notes__", ()), where.removeprefix("; ")]


@contextmanager
def tracked(job: TrainingJob) -> Iterator[None]:
    """Track the block in a run of Weights & Biases, if the job asks for it.

    The run is created as in rl_zoo3, and shows TensorBoard's logs.

    :raises ConfigError: it cannot begin, for example without a login.
    """
    if not job.track:
        yield
        return
    # It reads the project, the group and the tags from WANDB_PROJECT, WANDB_RUN_GROUP and
    # WANDB_TAGS.
    wandb = require("wandb", "track", "--track")
    if job.tensorboard_log is None:
        raise ConfigError("--track: shows what TensorBoard would; give -tb FOLDER, too")
    config = job.config
    try:
        run = wandb.init(
            name=f"{config.env_id}__{config.algo}__{job.seed}__{int(time.time())}",
            config={**job.arguments(), **config.settings, **made_with()},
            sync_tensorboard=True,
        )
    except wandb.Error as error:
        raise ConfigError(f"--track: {one_line(error)}") from None
    with run:
        yield
