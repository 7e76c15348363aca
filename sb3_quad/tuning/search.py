"""The search for hyperparameters: trials, each a training of its own, in a study that may be shared and resumed."""

from __future__ import annotations

import hashlib
import json
import math
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_quad.base.errors import ConfigError, TrainingError
from sb3_quad.base.signals import StopSignals
from sb3_quad.settings.config import TrainingConfig, build_config
from sb3_quad.training.job import TrainingJob
from sb3_quad.tuning.space import SearchSpace, current
from sb3_quad.tuning.study import check_names, make_pruner, make_sampler, open_study

if TYPE_CHECKING:
    from optuna import Study, Trial
    from optuna.trial import FrozenTrial

BEGUN_WITH, SETTINGS, SUCCESS, REWARD, RUN, ERROR = "begun_with", "settings", "success_rate", "mean_reward", "run", "error"
HOPELESS = 5  # so many trials failing at first, and none not: the settings are at fault, not what is varied
PATIENCE = 10.0  # s to wait for the process that begins a study to say what it began with


@dataclass(frozen=True)
class StudyOptions:
    """How a study proposes its trials and cuts them short.

    :param name: of the study, within its storage.
    :param storage: see :func:`sb3_quad.tuning.study.open_study`.
    :param sampler: one of :data:`sb3_quad.tuning.study.SAMPLERS`; ``pruner`` one of its PRUNERS.
    :param n_startup_trials: drawn at random before the sampler begins, and finished before the median pruner does.
    :param n_evaluations: of each trial, the last at its end.
    """

    name: str
    storage: str | Path | None = None
    sampler: str = "tpe"
    pruner: str = "median"
    n_startup_trials: int = 10
    n_evaluations: int = 10

    def __post_init__(self) -> None:
        check_names(self.sampler, self.pruner)
        if self.n_evaluations < 1 or self.n_startup_trials < 0:
            raise ConfigError("n_evaluations must be at least 1, n_startup_trials at least 0")


class Search:
    """Trains with one choice of settings after the other.

    Trials are judged as the best model of a run is: by the share of successful episodes of the deterministic policy, and
    among equals by the mean reward; see :func:`score`. The episodes and the seed of the training are the same for all trials.
    The first trial has the settings as they are.

    :param job: what every trial does, but for the settings that are varied; its run folders go to its ``log_folder``.
    :raises ConfigError: a storage that cannot be used, or that holds a study of this name of another kind.
    """

    def __init__(self, job: TrainingJob, space: SearchSpace, options: StudyOptions) -> None:
        if job.eval_episodes < 1:
            raise ConfigError(f"eval_episodes {job.eval_episodes}: must be at least 1, trials are judged by them")
        self.space, self.options = space, options
        self.job = job
        begun_with = {key: json.dumps(value, sort_keys=True, default=str) for key, value in self._kind().items()}
        sampler = make_sampler(options.sampler, job.seed, options.n_startup_trials)
        pruner = make_pruner(options.pruner, options.n_startup_trials, options.n_evaluations)
        self.study, new = open_study(options.name, options.storage, sampler, "maximize", pruner)
        if new:
            self.study.set_user_attr(BEGUN_WITH, begun_with)
            start = space.start()
            if start is not None:
                self.study.enqueue_trial(start)
        else:
            self._check(begun_with)

    def run(
        self, n_trials: int, max_total_trials: int | None, signals: StopSignals, after_each: Callable[[FrozenTrial], None]
    ) -> None:
        """Train up to ``n_trials`` times, until a signal comes, or until the study has ``max_total_trials``.

        :param max_total_trials: those of other processes and earlier sessions included, failed ones not.
        :param after_each: told of each trial that ended.
        :raises TrainingError: the first trials of all have failed.
        :raises ConfigError: a storage that fails meanwhile.
        """
        import optuna

        try:
            self._run(n_trials, max_total_trials, signals, after_each)
        except (OSError, optuna.exceptions.OptunaError) as error:
            reason = " ".join(str(error).split())[:200]
            raise ConfigError(f"storage {self.options.storage}: fails ({type(error).__name__}: {reason})") from error

    def _run(
        self, n_trials: int, max_total_trials: int | None, signals: StopSignals, after_each: Callable[[FrozenTrial], None]
    ) -> None:
        failures = 0
        for number in range(n_trials):
            if signals.received is not None or (max_total_trials is not None and self._counted() >= max_total_trials):
                break
            trial = self.study.ask()
            self._train(trial, signals)
            ended = self.study.get_trials(deepcopy=False)[trial.number]
            after_each(ended)
            failures += ended.state.name == "FAIL" and signals.received is None
            if failures == number + 1 == HOPELESS:
                raise TrainingError(f"the first {HOPELESS} trials failed, the last with: {ended.user_attrs[ERROR]}")

    def trials(self, *states: str) -> list[FrozenTrial]:
        """The trials that ended so, such as ``COMPLETE``; all that ended by default."""
        wanted = states or ("COMPLETE", "PRUNED", "FAIL")
        return [trial for trial in self.study.get_trials(deepcopy=False) if trial.state.name in wanted]

    @property
    def best(self) -> FrozenTrial | None:
        """The best trial that was finished, of any process; None if there is none."""
        return max(self.trials("COMPLETE"), key=lambda trial: trial.value or 0.0, default=None)

    def score(self, success: float, reward: float) -> float:
        """An evaluation as one number, the greater the better."""
        if self.job.config.task is None:
            return reward
        return score(success, reward, self.job.eval_episodes)

    def _counted(self) -> int:
        return sum(trial.state.name in ("COMPLETE", "PRUNED", "RUNNING") for trial in self.study.get_trials(deepcopy=False))

    def _train(self, trial: Trial, signals: StopSignals) -> None:
        """Train as a trial says, and tell the study how it ended."""
        from optuna.trial import TrialState

        try:
            state, value = self._outcome(trial)
        except Exception as error:  # whatever a choice of settings leads to, the next one may fare better
            trial.set_user_attr(ERROR, f"{type(error).__name__}: {' '.join(str(error).split())}")
            state, value = TrialState.FAIL, None
        except BaseException:
            self._leave(trial, "interrupted")
            raise
        if state is None:
            self._leave(trial, "interrupted")
            return
        self.study.tell(trial, value, state=state)

    def _outcome(self, trial: Trial) -> tuple[Any, float | None]:
        """The state and the value of a trial; a state of None if it was interrupted."""
        from optuna.trial import TrialState

        from sb3_quad.training.trainer import train

        settings = self.space.suggest(trial)
        trial.set_user_attr(SETTINGS, json.dumps(settings))
        known = self.job.config
        config = build_config(known.algo, known.env_id, settings, f"trial {trial.number}")
        total, count = _transitions(config), self.options.n_evaluations
        scores: list[tuple[float, float]] = []

        def goes_on(success: float, reward: float) -> bool:
            scores.append((success, reward))
            trial.report(self.score(success, reward), len(scores))
            return len(scores) >= count or not trial.should_prune()

        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="You have specified a mini-batch size")
            result = train(
                # Never due with the last transition: that evaluation follows the last update.
                replace(self.job, config=config, eval_freq=total // count + 1 if count > 1 else -1),
                report=lambda line: None,
                started=lambda run: trial.set_user_attr(RUN, str(run.path)),
                goes_on=goes_on,
            )
        if result.exit_code != 0:
            return None, None
        success, reward = scores[-1]
        trial.set_user_attr(SUCCESS, success)
        trial.set_user_attr(REWARD, reward)
        if result.model.num_timesteps < total:
            return TrialState.PRUNED, None
        value = self.score(success, reward)
        if not math.isfinite(value):
            raise TrainingError(f"the mean reward is {reward}")
        return TrialState.COMPLETE, value

    def _leave(self, trial: Trial, reason: str) -> None:
        """Give a trial up, and have its settings tried again by whoever goes on."""
        from optuna.trial import TrialState

        trial.set_user_attr(ERROR, reason)
        self.study.tell(trial, state=TrialState.FAIL)
        if trial.params:
            self.study.enqueue_trial(trial.params)

    def _kind(self) -> dict[str, Any]:
        """What all trials of a study must share to be compared."""
        job, config = self.job, self.job.config
        agent = None
        if job.trained_agent is not None:
            try:
                agent = hashlib.sha256(Path(job.trained_agent).read_bytes()).hexdigest()
            except OSError as error:
                raise ConfigError(f"{job.trained_agent}: cannot be read ({error.strerror or error})") from None
        return {
            "algo": config.algo,
            "env": config.env_id,
            **config.settings,
            "search_space": self.space.describe(),
            "seed": job.seed,
            "trained_agent": agent,
            "n_evaluations": self.options.n_evaluations,
            "eval_episodes": job.eval_episodes,
        }

    def _check(self, wanted: dict[str, str]) -> None:
        study = f"study {self.options.name} in {self.options.storage}"
        known = _begun_with(self.study)
        if known is None:
            raise ConfigError(f"{study}: is not of tune; give another --study-name")
        differing = sorted(key for key in {**known, **wanted} if known.get(key) != wanted.get(key))
        if differing:
            other = f"was begun with other settings ({', '.join(differing)})"
            raise ConfigError(f"{study}: {other}; give the same again, or another --study-name")


def score(success: float, reward: float, n_episodes: int) -> float:
    """Success and reward as one number: any more successful episodes outweigh any reward, which decides between equals.

    ``success + s(reward) / n_episodes`` with s(x) = (1 + x / (1 + |x|)) / 2, which rises from 0 to 1.

    :param success: share of ``n_episodes`` episodes.
    :param reward: mean per episode.
    """
    return success + (1.0 + reward / (1.0 + abs(reward))) / (2 * n_episodes)


def _transitions(config: TrainingConfig) -> int:
    """How many a training makes: its last rollout is a whole one."""
    rollout = int(current(config.algo, config.hyperparams, "n_steps")) * config.n_envs
    return math.ceil(config.n_timesteps / rollout) * rollout


def _begun_with(study: Study) -> dict[str, str] | None:
    """What a study was begun with. The process that has just begun it may take a moment to say so."""
    end = time.monotonic() + PATIENCE
    while BEGUN_WITH not in study.user_attrs and not study.trials and time.monotonic() < end:
        time.sleep(0.1)
    known = study.user_attrs.get(BEGUN_WITH)
    return known if isinstance(known, dict) else None
