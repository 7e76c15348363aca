"""Optuna's studies: where they are remembered, what proposes their trials, what cuts them short."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.extras import require
from sb3_quad.base.files import one_line

if TYPE_CHECKING:
    from optuna import Study, Trial
    from optuna.pruners import BasePruner
    from optuna.samplers import BaseSampler

SAMPLERS: Mapping[str, Callable[[Any, int, int], BaseSampler]] = {  # of optuna.samplers, a seed and n_startup_trials
    "tpe": lambda samplers, seed, n: samplers.TPESampler(seed=seed, n_startup_trials=n, multivariate=True, constant_liar=True),
    "random": lambda samplers, seed, n: samplers.RandomSampler(seed=seed),
    "cmaes": lambda samplers, seed, n: samplers.CmaEsSampler(seed=seed, n_startup_trials=n, warn_independent_sampling=False),
}
PRUNERS: Mapping[str, Callable[[Any, int, int], BasePruner]] = {  # of optuna.pruners, n_startup_trials, n_evaluations
    "median": lambda pruners, n, evaluations: pruners.MedianPruner(n_startup_trials=n, n_warmup_steps=evaluations // 3),
    "halving": lambda pruners, n, evaluations: pruners.SuccessiveHalvingPruner(min_resource=1),
    "none": lambda pruners, n, evaluations: pruners.NopPruner(),
}
PATIENCE = 10.0  # s to wait for the process that begins a study to say what it began with


def load_optuna() -> Any:
    """Optuna, without its log and without warnings that parts of it are experimental.

    :raises ConfigError: Optuna or cmaes is missing; the message says what to install.
    """
    require("cmaes", "tune", "a search")  # Optuna imports it only when it first samples
    optuna = require("optuna", "tune", "a search")
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    warnings.filterwarnings("ignore", category=optuna.exceptions.ExperimentalWarning)
    return optuna


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
    :raises ConfigError: Optuna is missing; a storage that cannot be used, such as a file that is no journal.
    """
    optuna = load_optuna()
    opened: Any = None if storage is None else str(storage)
    try:
        if storage is not None and "://" not in str(storage):
            Path(storage).parent.mkdir(parents=True, exist_ok=True)
            opened = optuna.storages.JournalStorage(optuna.storages.journal.JournalFileBackend(opened))
        try:
            study, new = optuna.create_study(study_name=name, storage=opened, direction=direction), True
        except optuna.exceptions.DuplicatedStudyError:
            study, new = optuna.load_study(study_name=name, storage=opened), False
    except Exception as error:  # databases and damaged journals raise what they like
        reason = f"{type(error).__name__}: {one_line(error)}"
        raise ConfigError(f"storage {storage}: cannot be used ({reason})") from None
    attribute, settings = begun_with
    end = time.monotonic() + PATIENCE
    while not new and attribute not in study.user_attrs and not study.trials and time.monotonic() < end:
        time.sleep(0.1)  # the process that has just begun it may take a moment to say so
    if attribute not in study.user_attrs and not study.trials:
        study.set_user_attr(attribute, settings)
        if first is not None:
            study.enqueue_trial(dict(first))
    return study, study.user_attrs.get(attribute)


def ask(study: Study, sampler: str, seed: int, n_startup_trials: int) -> Trial:
    """The next trial of a study. What is proposed depends on ``seed``, the trial's number and the trials known.

    So processes that share a study propose different trials, and a study that is resumed goes on as if never left.

    :param sampler: one of :data:`SAMPLERS`.
    :param n_startup_trials: sampled at random first.
    """
    optuna = load_optuna()
    study.sampler = optuna.samplers.RandomSampler()  # proposes nothing yet: the trial's number is to be known first
    trial = study.ask()
    own = int(np.random.SeedSequence([seed, trial.number]).generate_state(1)[0])
    study.sampler = SAMPLERS[sampler](optuna.samplers, own, n_startup_trials)
    sampled: Trial = optuna.trial.Trial(study, trial._trial_id)
    return sampled
