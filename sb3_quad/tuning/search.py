"""The search for hyperparameters: trials, each a separate training, in an Optuna study that may be
shared and resumed.

Optuna's heartbeats and its retries of stale trials need a database and ``study.optimize``, and its
samplers are seeded once per process. A study here may be a journal file, on any system, and is
reproducible by its seed however often it was interrupted, so retries and seeds of trials are
implemented here.
"""

import json
import math
import os
import platform
from collections.abc import Callable, Container
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from optuna.pruners import MedianPruner, NopPruner, SuccessiveHalvingPruner
from optuna.samplers import BaseSampler, CmaEsSampler, RandomSampler, TPESampler
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock
from optuna.trial import FrozenTrial, TrialState

from sb3_quad.base.errors import ConfigError, TrainingError, raised_as, refuse_unknown
from sb3_quad.base.files import kind_and_line
from sb3_quad.base.imports import require
from sb3_quad.base.process import has_ended
from sb3_quad.base.types import StrDict, StrPath
from sb3_quad.evaluation.controllers import ControllerSpec, controller_record
from sb3_quad.training.config import TrainingConfig, TrainingJob, build_config
from sb3_quad.training.trainer import train
from sb3_quad.tuning.space import SearchSpace

Factories = dict[str, Callable[..., Any]]
# Factories with the arguments n_startup_trials and seed
SAMPLERS: Factories = {
    "tpe": partial(TPESampler, multivariate=True, constant_liar=True),
    "random": lambda n_startup_trials, seed: RandomSampler(seed),
    "cmaes": partial(CmaEsSampler, warn_independent_sampling=False),
}
# Factories with the arguments n_startup_trials and n_evaluations
PRUNERS: Factories = {
    "median": lambda n, evaluations: MedianPruner(n, n_warmup_steps=evaluations // 3),
    "halving": lambda n, evaluations: SuccessiveHalvingPruner(min_resource=1),
    "none": lambda n, evaluations: NopPruner(),
}
# The states of ended trials, in words
STATES = {
    TrialState.COMPLETE: "finished",
    TrialState.PRUNED: "pruned",
    TrialState.FAIL: "failed",
}
BEGUN_WITH = "begun_with"  # user attribute of a study: what all its trials share
# User attributes of a trial. The owner is the machine and the process that trains it.
OWNER = "owner"
# The rate that decides, which is that of survival if best_by says so
RATE = "success_rate"
REWARD = "mean_reward"
RUN = "run"
ERROR = "error"
INTERRUPTED = "interrupted"  # the error of trials that are tried again
AGAIN = {"again": True}  # user attributes of the trials that do so


@dataclass
class Search:
    """Trains with one choice of settings after the other.

    Trials are judged like the best model of a run: by the share of successful episodes of the
    deterministic policy, and among equals by the mean reward; see :func:`score`. The episodes and
    the seed of the training are the same for all trials. The first trial uses the given settings.

    :param job: the job of every trial, except for the varied settings; run folders go to its
        ``log_folder``.
    :param name: name of the study within its storage.
    :param storage: a database's URL (with ``://``), or else the path of a journal file. An existing
        study in it is continued.
    :param sampler: one of :data:`SAMPLERS`; ``pruner`` one of :data:`PRUNERS`.
    :param n_startup_trials: trials sampled at random before the sampler begins, and finished before
        the median pruner does.
    :param n_evaluations: evaluations of each trial, the last one at its end.
    :raises ConfigError: an unknown option; a storage that cannot be used, or with a study of this
        name of another kind.
    """

    job: TrainingJob
    space: SearchSpace
    name: str
    storage: StrPath
    sampler: str
    pruner: str
    n_startup_trials: int
    n_evaluations: int

    def __post_init__(self) -> None:
        refuse_unknown("sampler", [self.sampler], SAMPLERS)
        refuse_unknown("pruner", [self.pruner], PRUNERS)
        # Only trials of the same kind are comparable. This is the kind, as a storage returns it.
        wanted = json.loads(json.dumps(self._shared(), default=str))
        self.study = open_study(self.name, self.storage)
        if BEGUN_WITH not in self.study.user_attrs and not self.study.trials:
            self.study.set_user_attr(BEGUN_WITH, wanted)
            # The first trial uses the given settings, if the space includes them.
            first = self.space.start()
            if first is not None:
                self.study.enqueue_trial(first)
        known = self.study.user_attrs.get(BEGUN_WITH)
        where = f"study {self.name} in {self.storage}"
        if known is None:
            raise ConfigError(f"{where}: was not made by tune; give another --study-name")
        differing = [key for key in {**known, **wanted} if known.get(key) != wanted.get(key)]
        if differing:
            raise ConfigError(
                f"{where}: was begun with other settings ({', '.join(sorted(differing))}); "
                "give the same again, or another --study-name"
            )
        # Sampler and pruner may differ from one session to the next.
        self.study.pruner = PRUNERS[self.pruner](self.n_startup_trials, self.n_evaluations)
        self.study.sampler = NumberedSampler(self.sampler, self.job.seed, self.n_startup_trials)

    def try_one(self, most: int | None) -> FrozenTrial | None:
        """Train once.

        :param most: maximum number of trials in the study, including those of other processes and
            earlier sessions, but not failed ones.
        :return: the trial that ended; None: the study has reached the maximum.
        :raises ConfigError: a storage that fails meanwhile.
        """
        try:
            # A trial that another process left behind no longer counts, but is tried again.
            retry_dead_trials(self.study)
            counted = (TrialState.COMPLETE, TrialState.PRUNED, TrialState.RUNNING)
            if most is not None and len(self.trials(counted)) >= most:
                return None
            trial = self.study.ask(self.space.dimensions)
            trial.set_user_attr(OWNER, [platform.node(), os.getpid()])
            return self.study.tell(trial, *self._outcome(trial))
        except (OSError, optuna.exceptions.OptunaError) as error:
            raise ConfigError(f"storage {self.storage}: fails ({kind_and_line(error)})") from error

    def trials(self, states: Container[TrialState] = STATES) -> list[FrozenTrial]:
        """The trials in these states; by default, all that ended."""
        return self.study.get_trials(deepcopy=False, states=states)

    @property
    def best(self) -> FrozenTrial | None:
        """The best trial that was finished, of any process; None before the first one."""
        with suppress(ValueError):
            return self.study.best_trial
        return None

    def config(self, trial: FrozenTrial | optuna.Trial) -> TrainingConfig:
        """The settings of a trial.

        :raises ConfigError: they do not go together.
        """
        return build_config(
            self.job.config.algo,
            self.job.config.env_id,
            self.space.settings(trial.params),
            f"trial {trial.number}",
        )

    def _outcome(self, trial: optuna.Trial) -> tuple[float | None, TrialState]:
        """Train with a trial's settings; return its value and state. Whatever happens with one
        choice of settings, the next one may do better.
        """
        try:
            value = self._value(trial)
        # This includes errors of a user's callback or environment.
        except (Exception, SystemExit) as error:
            trial.set_user_attr(ERROR, kind_and_line(error))
            return None, TrialState.FAIL
        except KeyboardInterrupt:
            trial.set_user_attr(ERROR, INTERRUPTED)
            self.study.enqueue_trial(trial.params, AGAIN)
            return None, TrialState.FAIL
        return value, TrialState.PRUNED if value is None else TrialState.COMPLETE

    def _value(self, trial: optuna.Trial) -> float | None:
        """Train with a trial's settings; return the value of its last evaluation, None if it was
        pruned.
        """
        config = self.config(trial)
        # A training ends with a whole rollout.
        total = math.ceil(config.n_timesteps / config.rollout) * config.rollout
        every = math.ceil(total / self.n_evaluations)
        values = []

        def should_continue(rate: float, reward: float) -> bool:
            if config.task is None:
                values.append(reward)
            else:
                values.append(score(rate, reward, self.job.eval_episodes))
            trial.report(values[-1], len(values))
            trial.set_user_attr(RATE, rate)
            trial.set_user_attr(REWARD, reward)
            return len(values) >= self.n_evaluations or not trial.should_prune()

        result = train(
            self.job.model_copy(update={"config": config, "eval_freq": every, "snapshot_every": 0}),
            report=lambda line: None,
            on_start=lambda run: trial.set_user_attr(RUN, str(run.path)),
            should_continue=should_continue,
        )
        # The training ends early after a signal, or because the pruner stopped it.
        if result.exit_code != 0:
            raise KeyboardInterrupt
        if result.model.num_timesteps < total:
            return None
        if not math.isfinite(values[-1]):
            raise TrainingError(f"the mean reward is {trial.user_attrs[REWARD]}")
        return values[-1]

    def _shared(self) -> StrDict:
        """Return everything that the trials of a study must share to be compared."""
        job = self.job
        # The agent is identified by its content, since its file may move.
        agent = None
        if job.initial_policy is not None:
            agent = controller_record(ControllerSpec("agent", job.initial_policy)).content
        return {
            "algo": job.config.algo,
            "env": job.config.env_id,
            **job.config.settings,
            "search_space": str(self.space.dimensions),
            "seed": job.seed,
            "initial_policy": agent,
            "n_evaluations": self.n_evaluations,
            "eval_episodes": job.eval_episodes,
        }


@dataclass
class NumberedSampler(BaseSampler):
    """One of :data:`SAMPLERS`, made anew for each trial from a seed, the known trials and its
    number, not counting retries.

    Thus processes that share a study propose different trials, and a resumed study continues as if
    it had never been interrupted.
    """

    kind: str
    seed: int
    n_startup_trials: int

    def infer_relative_search_space(self, study: optuna.Study, trial: FrozenTrial) -> Any:
        # A retry has the parameters of an earlier trial, and does not count.
        number = sum(
            "again" not in earlier.user_attrs
            for earlier in study.get_trials(deepcopy=False)[: trial.number]
        )
        seed = int(np.random.SeedSequence([self.seed, number]).generate_state(1)[0])
        self._sampler = SAMPLERS[self.kind](n_startup_trials=self.n_startup_trials, seed=seed)
        return self._sampler.infer_relative_search_space(study, trial)

    def sample_relative(self, *arguments: Any) -> Any:
        return self._sampler.sample_relative(*arguments)

    def sample_independent(self, *arguments: Any) -> Any:
        return self._sampler.sample_independent(*arguments)


def open_study(name: str, storage: StrPath) -> optuna.Study:
    """Return the study of this name, which may already be in the storage.

    :raises ConfigError: cmaes is missing; a storage that cannot be used, such as a file that is not
        a journal.
    """
    require("cmaes", "tune", "a search")  # Optuna imports it only when it first samples
    backend: Any = str(storage)
    with raised_as(ConfigError, f"storage {storage}: cannot be used"):
        if "://" not in backend:
            path = Path(storage)
            path.parent.mkdir(parents=True, exist_ok=True)
            # Optuna would ignore an incomplete line, and append the next one to it.
            if path.is_file() and path.read_bytes()[-1:] not in (b"", b"\n"):
                raise ValueError(
                    "the last line is cut, as by a full disk, or it is no journal; remove that line"
                )
            # Optuna's other lock needs symbolic links, which Windows reserves for administrators.
            backend = JournalStorage(JournalFileBackend(backend, JournalFileOpenLock(backend)))
        return optuna.create_study(
            study_name=name, storage=backend, direction="maximize", load_if_exists=True
        )


def retry_dead_trials(study: optuna.Study) -> None:
    """Enqueue again the trials whose process on this machine is gone."""
    for trial in study.get_trials(deepcopy=False, states=[TrialState.RUNNING]):
        machine, process = trial.user_attrs.get(OWNER, ["", 0])
        if machine == platform.node() and has_ended(process):
            study.tell(trial.number, state=TrialState.FAIL)
            study.enqueue_trial(trial.params, AGAIN)


def score(success: float, reward: float, n_episodes: int) -> float:
    """Return success and reward as one number: more successful episodes outweigh any reward, which
    decides between equals.

    ``success + s(reward) / n_episodes`` with s(x) = (1 + x / (1 + |x|)) / 2, which rises from 0 to
    1.

    :param success: share of ``n_episodes`` episodes.
    :param reward: mean reward per episode.
    """
    return success + (1.0 + reward / (1.0 + abs(reward))) / (2 * n_episodes)
