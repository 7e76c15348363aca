"""The search for hyperparameters: trials, each a training of its own, in a study that may be shared and resumed."""

import hashlib
import json
import math
import os
import platform
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from optuna import Trial
from optuna.exceptions import OptunaError, TrialPruned
from optuna.trial import FrozenTrial

from sb3_quad.base.errors import ConfigError, TrainingError, unknown
from sb3_quad.base.files import one_line
from sb3_quad.base.signals import StopSignals
from sb3_quad.training.config import build_config
from sb3_quad.training.job import TrainingJob
from sb3_quad.training.trainer import train
from sb3_quad.tuning.space import SearchSpace
from sb3_quad.tuning.study import OWNER, PRUNERS, SAMPLERS, NumberedSampler, open_study, retry_dead_trials

BEGUN_WITH, SETTINGS, SUCCESS, REWARD, RUN, ERROR = "begun_with", "settings", "success_rate", "mean_reward", "run", "error"
INTERRUPTED = "interrupted"  # the error of trials that are tried again
HOPELESS = 5  # so many trials failing at first, and none not: the settings are at fault, not what is varied


class Search:
    """Trains with one choice of settings after the other.

    Trials are judged as the best model of a run is: by the share of successful episodes of the deterministic policy, and
    among equals by the mean reward; see :func:`score`. The episodes and the seed of the training are the same for all trials.
    The first trial has the settings as they are.

    :param job: what every trial does, but for the settings that are varied; its run folders go to its ``log_folder``.
    :param name: of the study, within its storage.
    :param storage: see :func:`sb3_quad.tuning.study.open_study`.
    :param sampler: one of :data:`sb3_quad.tuning.study.SAMPLERS`; ``pruner`` one of its PRUNERS.
    :param n_startup_trials: sampled at random before the sampler begins, and finished before the median pruner does.
    :param n_evaluations: of each trial, the last at its end.
    :raises ConfigError: an option that there is not; a storage that cannot be used, or that holds a study of this name of
        another kind.
    """

    def __init__(
        self,
        job: TrainingJob,
        space: SearchSpace,
        name: str,
        storage: str | Path | None = None,
        sampler: str = "tpe",
        pruner: str = "median",
        n_startup_trials: int = 10,
        n_evaluations: int = 10,
    ) -> None:
        for kind, given, valid in (("sampler", sampler, SAMPLERS), ("pruner", pruner, PRUNERS)):
            if given not in valid:
                raise ConfigError(unknown(kind, given, valid))
        if min(n_evaluations, job.eval_episodes) < 1 or n_startup_trials < 0:
            raise ConfigError("n_evaluations and eval_episodes must be at least 1, n_startup_trials at least 0")
        self.job, self.space, self.name, self.storage = job, space, name, storage
        self.n_evaluations = n_evaluations
        wanted = {key: json.dumps(value, sort_keys=True, default=str) for key, value in self._kind().items()}
        self.study, known = open_study(name, storage, "maximize", (BEGUN_WITH, wanted), space.start())
        self.study.pruner = PRUNERS[pruner](n_startup_trials, n_evaluations)
        self.study.sampler = NumberedSampler(sampler, job.seed, n_startup_trials)
        where = f"study {name} in {storage}"
        if not isinstance(known, dict):
            raise ConfigError(f"{where}: is not of tune; give another --study-name")
        differing = ", ".join(sorted(key for key in {**known, **wanted} if known.get(key) != wanted.get(key)))
        if differing:
            other = f"was begun with other settings ({differing})"
            raise ConfigError(f"{where}: {other}; give the same again, or another --study-name")

    def try_one(self, most: int | None) -> FrozenTrial | None:
        """Train once.

        :param most: trials of the study, those of other processes and earlier sessions included, failed ones not.
        :return: the trial that ended; None: the study has as many as it may.
        :raises ConfigError: a storage that fails meanwhile.
        """
        ended: list[FrozenTrial] = []
        try:
            retry_dead_trials(self.study)
            if most is not None and len(self.trials("COMPLETE", "PRUNED", "RUNNING")) >= most:
                return None
            self.study.optimize(self._train, 1, catch=(Exception,), callbacks=[lambda study, trial: ended.append(trial)])
        except (OSError, OptunaError) as error:
            raise ConfigError(f"storage {self.storage}: fails ({type(error).__name__}: {one_line(error)})") from error
        return ended[0]

    def trials(self, *states: str) -> list[FrozenTrial]:
        """The trials in these states, such as ``COMPLETE``; all that ended by default."""
        wanted = states or ("COMPLETE", "PRUNED", "FAIL")
        return [trial for trial in self.study.get_trials(deepcopy=False) if trial.state.name in wanted]

    @property
    def best(self) -> FrozenTrial | None:
        """The best trial that was finished, of any process; None if there is none."""
        return max(self.trials("COMPLETE"), key=lambda trial: trial.value or 0.0, default=None)

    def _train(self, trial: Trial) -> float:
        """Train as a trial says; its value. Whatever a choice of settings leads to, the next one may fare better."""
        trial.set_user_attr(OWNER, [platform.node(), os.getpid()])
        try:
            return self._value(trial)
        except TrialPruned:
            raise
        except Exception as error:
            trial.set_user_attr(ERROR, f"{type(error).__name__}: {one_line(error)}")
            raise
        except KeyboardInterrupt:
            trial.set_user_attr(ERROR, INTERRUPTED)
            self.study.enqueue_trial(trial.params)
            raise TrainingError(INTERRUPTED) from None

    def _value(self, trial: Trial) -> float:
        known, count = self.job.config, self.n_evaluations
        settings = self.space.suggest(trial)
        trial.set_user_attr(SETTINGS, json.dumps(settings))
        config = build_config(known.algo, known.env_id, settings, f"trial {trial.number}")
        rollout = config.rollout_steps * config.n_envs
        total = math.ceil(config.n_timesteps / rollout) * rollout  # the last rollout is a whole one
        every = total // count + 1 if count > 1 else -1  # never due with the last timestep: that one follows the last update
        evaluations: list[tuple[float, float]] = []

        def value() -> float:
            success, reward = evaluations[-1]
            return reward if known.task is None else score(success, reward, self.job.eval_episodes)

        def should_continue(success: float, reward: float) -> bool:
            evaluations.append((success, reward))
            trial.report(value(), len(evaluations))
            return len(evaluations) >= count or not trial.should_prune()

        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="You have specified a mini-batch size")
            result = train(
                self.job.model_copy(update={"config": config, "eval_freq": every, "snapshot_every": 0}),
                report=lambda line: None,
                on_start=lambda run: trial.set_user_attr(RUN, str(run.path)),
                should_continue=should_continue,
            )
        if result.exit_code != 0:
            raise KeyboardInterrupt
        trial.set_user_attr(SUCCESS, evaluations[-1][0])
        trial.set_user_attr(REWARD, evaluations[-1][1])
        if result.model.num_timesteps < total:
            raise TrialPruned
        if not math.isfinite(value()):
            raise TrainingError(f"the mean reward is {evaluations[-1][1]}")
        return value()

    def _kind(self) -> dict[str, Any]:
        """What all trials of a study must share to be compared."""
        job, config, agent = self.job, self.job.config, None
        if job.trained_agent is not None:
            try:
                agent = hashlib.sha256(Path(job.trained_agent).read_bytes()).hexdigest()
            except OSError as error:
                raise ConfigError(f"{job.trained_agent}: cannot be read ({error.strerror or error})") from None
        return {
            "algo": config.algo,
            "env": config.env_id,
            **config.settings,
            "search_space": {name: repr(each) for name, each in self.space.dimensions.items()},
            "seed": job.seed,
            "trained_agent": agent,
            "n_evaluations": self.n_evaluations,
            "eval_episodes": job.eval_episodes,
        }


def try_one_of(
    job: TrainingJob, space: SearchSpace, name: str, storage: str | Path, study: tuple[str, str, int, int], most: int | None
) -> int | None:
    """In a worker: one trial of a study that several share, see :meth:`Search.try_one`.

    :param study: sampler, pruner, n_startup_trials, n_evaluations, as for :class:`Search`.
    :return: its number.
    """
    with StopSignals():
        trial = Search(job, space, name, storage, *study).try_one(most)
    return None if trial is None else trial.number


def check_hopeless(ended: Sequence[FrozenTrial]) -> None:
    """:raises TrainingError: the first trials have all failed, not counting interrupted ones."""
    failures = [trial for trial in ended if trial.state.name == "FAIL" and trial.user_attrs.get(ERROR) != INTERRUPTED]
    if len(failures) == len(ended) == HOPELESS:
        raise TrainingError(f"the first {HOPELESS} trials failed, the last with: {failures[-1].user_attrs[ERROR]}")


def score(success: float, reward: float, n_episodes: int) -> float:
    """Success and reward as one number: any more successful episodes outweigh any reward, which decides between equals.

    ``success + s(reward) / n_episodes`` with s(x) = (1 + x / (1 + |x|)) / 2, which rises from 0 to 1.

    :param success: share of ``n_episodes`` episodes.
    :param reward: mean per episode.
    """
    return success + (1.0 + reward / (1.0 + abs(reward))) / (2 * n_episodes)
