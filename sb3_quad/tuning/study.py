"""Optuna's studies: where they are remembered, what proposes their trials, what cuts them short."""

import os
import platform
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import optuna
from optuna import Study
from optuna.distributions import BaseDistribution
from optuna.pruners import BasePruner, MedianPruner, NopPruner, SuccessiveHalvingPruner
from optuna.samplers import BaseSampler, CmaEsSampler, RandomSampler, TPESampler
from optuna.storages import JournalStorage, RDBStorage, RetryHeartbeatStaleTrialCallback
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, TrialState

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import one_line
from sb3_quad.base.imports import require

SAMPLERS: Mapping[str, Callable[[int, int], BaseSampler]] = {  # from a seed and n_startup_trials
    "tpe": lambda seed, n: TPESampler(seed=seed, n_startup_trials=n, multivariate=True, constant_liar=True),
    "random": lambda seed, n: RandomSampler(seed=seed),
    "cmaes": lambda seed, n: CmaEsSampler(seed=seed, n_startup_trials=n, warn_independent_sampling=False),
}
PRUNERS: Mapping[str, Callable[[int, int], BasePruner]] = {  # from n_startup_trials and n_evaluations
    "median": lambda n, evaluations: MedianPruner(n_startup_trials=n, n_warmup_steps=evaluations // 3),
    "halving": lambda n, evaluations: SuccessiveHalvingPruner(min_resource=1),
    "none": lambda n, evaluations: NopPruner(),
}
OWNER = "owner"  # user attribute of a trial: the machine and the process that train it
HEARTBEAT = 30  # s between two signs of life of a trial in a database


def open_study(
    name: str,
    storage: str | Path | None,
    direction: Literal["minimize", "maximize"],
    begun_with: tuple[str, Any],
    first: Mapping[str, Any] | None,
) -> tuple[Study, Any]:
    """A study, and the settings that it was begun with; one that the storage remembers is continued.

    :param storage: a database's URL (with ``://``), or else the path of a journal file; None: nothing is remembered.
    :param begun_with: the settings of a new study, after the name of the user attribute that holds them.
    :param first: parameters of a new study's first trial.
    :raises ConfigError: cmaes is missing; a storage that cannot be used, such as a file that is no journal.
    """
    require("cmaes", "tune", "a search")  # Optuna imports it only when it first samples
    try:
        opened = None if storage is None else _open_storage(str(storage))
        study = optuna.create_study(study_name=name, storage=opened, direction=direction, load_if_exists=True)
    except Exception as error:  # databases and damaged journals raise what they like
        reason = f"{type(error).__name__}: {one_line(error)}"
        raise ConfigError(f"storage {storage}: cannot be used ({reason})") from None
    attribute, settings = begun_with
    if attribute not in study.user_attrs and not study.trials:
        study.set_user_attr(attribute, settings)
        if first is not None:
            study.enqueue_trial(dict(first))
    return study, study.user_attrs.get(attribute)


def _open_storage(storage: str) -> JournalStorage | RDBStorage:
    if "://" in storage:
        retry = RetryHeartbeatStaleTrialCallback()
        return RDBStorage(storage, heartbeat_interval=HEARTBEAT, heartbeat_stale_trial_callback=retry)
    path = Path(storage)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_file() and path.read_bytes()[-1:] not in (b"", b"\n"):  # Optuna would append to that line
        raise ConfigError("the last line is cut, as by a full disk, or it is no journal; remove that line")
    return JournalStorage(JournalFileBackend(storage))


class NumberedSampler(BaseSampler):
    """One of :data:`SAMPLERS`, made anew for each trial, from a seed, the trial's number and the trials known.

    So processes that share a study propose different trials, and a study that is resumed goes on as if never left.
    """

    def __init__(self, kind: str, seed: int, n_startup_trials: int) -> None:
        self._kind, self._seed, self._startup = kind, seed, n_startup_trials

    def infer_relative_search_space(self, study: Study, trial: FrozenTrial) -> dict[str, BaseDistribution]:
        own = int(np.random.SeedSequence([self._seed, trial.number]).generate_state(1)[0])
        self._sampler = SAMPLERS[self._kind](own, self._startup)
        return self._sampler.infer_relative_search_space(study, trial)

    def sample_relative(self, study: Study, trial: FrozenTrial, space: dict[str, BaseDistribution]) -> dict[str, Any]:
        return self._sampler.sample_relative(study, trial, space)

    def sample_independent(self, study: Study, trial: FrozenTrial, name: str, distribution: BaseDistribution) -> Any:
        return self._sampler.sample_independent(study, trial, name, distribution)


def retry_dead_trials(study: Study) -> None:
    """Have the trials tried again whose process on this machine is gone; Optuna's heartbeat does so for databases."""
    for trial in study.get_trials(deepcopy=False, states=[TrialState.RUNNING]):
        machine, process = trial.user_attrs.get(OWNER, ["", 0])
        if machine == platform.node():
            try:
                os.kill(process, 0)  # does nothing but fail where there is none
            except ProcessLookupError:
                study.tell(trial.number, state=TrialState.FAIL)
                study.enqueue_trial(trial.params)
            except PermissionError:  # another user's
                pass
