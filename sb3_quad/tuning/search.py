"""The search for hyperparameters: trials, each a training of its own, in a study of Optuna that may
be shared and resumed.
"""

import hashlib
import json
import math
import os
import platform
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from optuna.distributions import BaseDistribution, distribution_to_json
from optuna.pruners import BasePruner, MedianPruner, NopPruner, SuccessiveHalvingPruner
from optuna.samplers import BaseSampler, CmaEsSampler, RandomSampler, TPESampler
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, TrialState

from sb3_quad.base.errors import ConfigError, TrainingError, unknown
from sb3_quad.base.files import one_line
from sb3_quad.base.imports import require
from sb3_quad.base.process import has_ended
from sb3_quad.training.config import TrainingJob, build_config
from sb3_quad.training.trainer import train
from sb3_quad.tuning.space import SearchSpace

SAMPLERS: Mapping[str, Callable[[int, int], BaseSampler]] = {  # from a seed and n_startup_trials
    "tpe": lambda seed, n: TPESampler(
        seed=seed, n_startup_trials=n, multivariate=True, constant_liar=True
    ),
    "random": lambda seed, n: RandomSampler(seed=seed),
    "cmaes": lambda seed, n: CmaEsSampler(
        seed=seed, n_startup_trials=n, warn_independent_sampling=False
    ),
}
PRUNERS: Mapping[
    str, Callable[[int, int], BasePruner]
] = {  # from n_startup_trials and n_evaluations
    "median": lambda n, evaluations: MedianPruner(
        n_startup_trials=n, n_warmup_steps=evaluations // 3
    ),
    "halving": lambda n, evaluations: SuccessiveHalvingPruner(min_resource=1),
    "none": lambda n, evaluations: NopPruner(),
}
BEGUN_WITH = "begun_with"  # user attribute of a study: what all its trials share
OWNER = "owner"  # user attribute of a trial: the machine and the process that train it
SETTINGS, SUCCESS, REWARD, RUN, ERROR = (
    "settings",
    "success_rate",
    "mean_reward",
    "run",
    "error",
)  # others
INTERRUPTED = "interrupted"  # the error of trials that are tried again
AGAIN = {"again": True}  # user attributes of the trials that do so


class Search:
    """Trains with one choice of settings after the other.

    Trials are judged as the best model of a run is: by the share of successful episodes of the
    deterministic policy, and among equals by the mean reward; see :func:`score`. The episodes and
    the seed of the training are the same for all trials. The first trial has the settings as they
    are.

    :param job: what every trial does, but for the settings that are varied; its run folders go to
        its ``log_folder``.
    :param name: of the study, within its storage.
    :param storage: a database's URL (with ``://``), or else the path of a journal file. A study
        that it holds is continued.
    :param sampler: one of :data:`SAMPLERS`; ``pruner`` one of :data:`PRUNERS`.
    :param n_startup_trials: sampled at random before the sampler begins, and finished before the
        median pruner does.
    :param n_evaluations: of each trial, the last at its end.
    :raises ConfigError: an option that there is not; a storage that cannot be used, or that holds a
        study of this name of another kind.
    """

    def __init__(
        self,
        job: TrainingJob,
        space: SearchSpace,
        name: str,
        storage: str | Path,
        sampler: str = "tpe",
        pruner: str = "median",
        n_startup_trials: int = 10,
        n_evaluations: int = 10,
    ) -> None:
        for kind, given, valid in (("sampler", sampler, SAMPLERS), ("pruner", pruner, PRUNERS)):
            if given not in valid:
                raise ConfigError(unknown(kind, given, valid))
        if min(n_evaluations, job.eval_episodes) < 1 or n_startup_trials < 0:
            raise ConfigError(
                "n_evaluations and eval_episodes must be at least 1, n_startup_trials at least 0"
            )
        self.job, self.space, self.name, self.storage = job, space, name, storage
        self.n_evaluations = n_evaluations
        wanted = {
            key: json.dumps(value, sort_keys=True, default=str)
            for key, value in self._shared().items()
        }
        self.study = open_study(name, storage)
        if BEGUN_WITH not in self.study.user_attrs and not self.study.trials:
            self.study.set_user_attr(BEGUN_WITH, wanted)
            if (first := space.start()) is not None:
                self.study.enqueue_trial(first)
        known, where = self.study.user_attrs.get(BEGUN_WITH), f"study {name} in {storage}"
        if not isinstance(known, dict):
            raise ConfigError(f"{where}: is not of tune; give another --study-name")
        differing = ", ".join(
            sorted(key for key in {**known, **wanted} if known.get(key) != wanted.get(key))
        )
        if differing:
            other = f"was begun with other settings ({differing})"
            raise ConfigError(f"{where}: {other}; give the same again, or another --study-name")
        self.study.pruner = PRUNERS[pruner](n_startup_trials, n_evaluations)
        self.study.sampler = NumberedSampler(sampler, job.seed, n_startup_trials)

    def try_one(self, most: int | None) -> FrozenTrial | None:
        """Train once.

        :param most: trials of the study, those of other processes and earlier sessions included,
            failed ones not.
        :return: the trial that ended; None: the study has as many as it may.
        :raises ConfigError: a storage that fails meanwhile.
        """
        try:
            retry_dead_trials(self.study)
            if most is not None and len(self.trials("COMPLETE", "PRUNED", "RUNNING")) >= most:
                return None
            trial = self.study.ask(dict(self.space.dimensions))
            trial.set_user_attr(OWNER, [platform.node(), os.getpid()])
            self.study.tell(trial, *self._outcome(trial))
            return self.study.get_trials(deepcopy=False)[trial.number]
        except (OSError, optuna.exceptions.OptunaError) as error:
            raise ConfigError(
                f"storage {self.storage}: fails ({type(error).__name__}: {one_line(error)})"
            ) from error

    def trials(self, *states: str) -> list[FrozenTrial]:
        """The trials in these states, such as ``COMPLETE``; all that ended by default."""
        wanted = states or ("COMPLETE", "PRUNED", "FAIL")
        return [
            trial for trial in self.study.get_trials(deepcopy=False) if trial.state.name in wanted
        ]

    @property
    def best(self) -> FrozenTrial | None:
        """The best trial that was finished, of any process; None if there is none."""
        return max(self.trials("COMPLETE"), key=lambda trial: trial.value or 0.0, default=None)

    def _outcome(self, trial: optuna.Trial) -> tuple[float | None, TrialState]:
        """Train as a trial says; its value and state. Whatever a choice of settings leads to, the
        next may fare better.
        """
        try:
            value = self._value(trial)
            return value, TrialState.PRUNED if value is None else TrialState.COMPLETE
        except Exception as error:
            trial.set_user_attr(ERROR, f"{type(error).__name__}: {one_line(error)}")
        except KeyboardInterrupt:
            trial.set_user_attr(ERROR, INTERRUPTED)
            self.study.enqueue_trial(trial.params, AGAIN)
        return None, TrialState.FAIL

    def _value(self, trial: optuna.Trial) -> float | None:
        """What a trial's last evaluation was worth; None: it was pruned."""
        known, count = self.job.config, self.n_evaluations
        settings = self.space.settings(trial.params)
        trial.set_user_attr(SETTINGS, json.dumps(settings))
        config = build_config(known.algo, known.env_id, settings, f"trial {trial.number}")
        rollout = config.rollout_steps * config.n_envs
        total = math.ceil(config.n_timesteps / rollout) * rollout  # the last rollout is a whole one
        every = math.ceil(total / count)
        evaluations: list[float] = []

        def should_continue(success: float, reward: float) -> bool:
            evaluations.append(
                reward if known.task is None else score(success, reward, self.job.eval_episodes)
            )
            trial.report(evaluations[-1], len(evaluations))
            trial.set_user_attr(SUCCESS, success)
            trial.set_user_attr(REWARD, reward)
            return len(evaluations) >= count or not trial.should_prune()

        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="You have specified a mini-batch size")
            result = train(
                self.job.model_copy(
                    update={"config": config, "eval_freq": every, "snapshot_every": 0}
                ),
                report=lambda line: None,
                on_start=lambda run: trial.set_user_attr(RUN, str(run.path)),
                should_continue=should_continue,
            )
        if result.exit_code != 0:
            raise KeyboardInterrupt
        if result.model.num_timesteps < total:
            return None
        if not math.isfinite(evaluations[-1]):
            raise TrainingError(f"the mean reward is {trial.user_attrs[REWARD]}")
        return evaluations[-1]

    def _shared(self) -> dict[str, Any]:
        """What all trials of a study must share to be compared."""
        job, config, agent = self.job, self.job.config, None
        if job.trained_agent is not None:
            try:
                agent = hashlib.sha256(Path(job.trained_agent).read_bytes()).hexdigest()
            except OSError as error:
                raise ConfigError(
                    f"{job.trained_agent}: cannot be read ({error.strerror or error})"
                ) from None
        return {
            "algo": config.algo,
            "env": config.env_id,
            **config.settings,
            "search_space": {
                name: distribution_to_json(each) for name, each in self.space.dimensions.items()
            },
            "seed": job.seed,
            "trained_agent": agent,
            "n_evaluations": self.n_evaluations,
            "eval_episodes": job.eval_episodes,
        }


class NumberedSampler(BaseSampler):
    """One of :data:`SAMPLERS`, made anew for each trial, from a seed, the trials known and its
    number, retries not counted.

    So processes that share a study propose different trials, and a study that is resumed goes on as
    if never left.
    """

    def __init__(self, kind: str, seed: int, n_startup_trials: int) -> None:
        self._kind, self._seed, self._startup = kind, seed, n_startup_trials

    def infer_relative_search_space(
        self, study: optuna.Study, trial: FrozenTrial
    ) -> dict[str, BaseDistribution]:
        again = sum(
            "again" in each.user_attrs
            for each in study.get_trials(deepcopy=False)
            if each.number < trial.number
        )
        own = int(np.random.SeedSequence([self._seed, trial.number - again]).generate_state(1)[0])
        self._sampler = SAMPLERS[self._kind](own, self._startup)
        return self._sampler.infer_relative_search_space(study, trial)

    def sample_relative(self, *arguments: Any) -> dict[str, Any]:
        return self._sampler.sample_relative(*arguments)

    def sample_independent(self, *arguments: Any) -> Any:
        return self._sampler.sample_independent(*arguments)


def open_study(name: str, storage: str | Path) -> optuna.Study:
    """The study of this name, also one that the storage holds already.

    :raises ConfigError: cmaes is missing; a storage that cannot be used, such as a file that is no
        journal.
    """
    require("cmaes", "tune", "a search")  # Optuna imports it only when it first samples
    try:
        opened: Any = str(storage)
        if "://" not in opened:
            path = Path(storage)
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.is_file() and path.read_bytes()[-1:] not in (
                b"",
                b"\n",
            ):  # Optuna would append to that line
                raise ConfigError(
                    "the last line is cut, as by a full disk, or it is no journal; remove that line"
                )
            opened = JournalStorage(JournalFileBackend(str(storage)))
        return optuna.create_study(
            study_name=name, storage=opened, direction="maximize", load_if_exists=True
        )
    except Exception as error:  # databases and damaged journals raise what they like
        reason = f"{type(error).__name__}: {one_line(error)}"
        raise ConfigError(f"storage {storage}: cannot be used ({reason})") from None


def retry_dead_trials(study: optuna.Study) -> None:
    """Have the trials tried again whose process on this machine is gone."""
    for trial in study.get_trials(deepcopy=False, states=[TrialState.RUNNING]):
        machine, process = trial.user_attrs.get(OWNER, ["", 0])
        if machine == platform.node() and has_ended(process):
            study.tell(trial.number, state=TrialState.FAIL)
            study.enqueue_trial(trial.params, AGAIN)


def score(success: float, reward: float, n_episodes: int) -> float:
    """Success and reward as one number: any more successful episodes outweigh any reward, which
    decides between equals.

    ``success + s(reward) / n_episodes`` with s(x) = (1 + x / (1 + |x|)) / 2, which rises from 0 to
    1.

    :param success: share of ``n_episodes`` episodes.
    :param reward: mean per episode.
    """
    return success + (1.0 + reward / (1.0 + abs(reward))) / (2 * n_episodes)
