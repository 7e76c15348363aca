"""Optuna's studies: where they are remembered, what proposes their trials, what cuts them short."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from sb3_quad.base.errors import ConfigError, unknown

if TYPE_CHECKING:
    from optuna import Study
    from optuna.pruners import BasePruner
    from optuna.samplers import BaseSampler
    from optuna.storages import BaseStorage

SAMPLERS = ("tpe", "random", "cmaes")
PRUNERS = ("median", "halving", "none")


def require_optuna(command: str) -> None:
    """See that Optuna and what its samplers need are there.

    :param command: what needs them, for the message.
    :raises ConfigError: one is missing; the message names the extra that brings it.
    """
    try:
        import cmaes  # noqa: F401  (Optuna imports it only when it first samples)
        import optuna
    except ImportError as error:
        raise ConfigError(f"{command} needs Optuna and cmaes ({error}): pip install 'sb3_quad[tune]'") from None
    optuna.logging.set_verbosity(optuna.logging.WARNING)


def open_study(
    name: str,
    storage: str | Path | None,
    sampler: BaseSampler,
    direction: Literal["minimize", "maximize"],
    pruner: BasePruner | None = None,
) -> tuple[Study, bool]:
    """A study, and whether it is new; one that the storage remembers is gone on with.

    :param storage: a database's URL (with ``://``), or else the path of a journal file; None: nothing is remembered.
    :raises ConfigError: a storage that cannot be used, such as a file that is no journal.
    """
    import optuna

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            opened = _open_storage(storage)
            keywords: dict[str, Any] = {"study_name": name, "storage": opened, "sampler": sampler, "pruner": pruner}
            try:
                return optuna.create_study(direction=direction, **keywords), True
            except optuna.exceptions.DuplicatedStudyError:
                return optuna.load_study(**keywords), False
    except Exception as error:  # databases and damaged journals raise what they like
        reason = " ".join(str(error).split())
        raise ConfigError(f"storage {storage}: cannot be used ({type(error).__name__}: {reason[:200]})") from None


def _open_storage(storage: str | Path | None) -> BaseStorage:
    from optuna.storages import InMemoryStorage, JournalStorage, RDBStorage
    from optuna.storages.journal import JournalFileBackend

    if storage is None:
        return InMemoryStorage()
    if "://" in str(storage):
        return RDBStorage(str(storage))
    Path(storage).parent.mkdir(parents=True, exist_ok=True)
    return JournalStorage(JournalFileBackend(str(storage)))


def check_names(sampler: str, pruner: str) -> None:
    """:raises ConfigError: a sampler or a pruner that there is not."""
    if sampler not in SAMPLERS:
        raise ConfigError(unknown("sampler", sampler, SAMPLERS))
    if pruner not in PRUNERS:
        raise ConfigError(unknown("pruner", pruner, PRUNERS))


def make_sampler(name: str, seed: int, n_startup_trials: int) -> BaseSampler:
    """One of :data:`SAMPLERS`. What it proposes for a trial depends on ``seed``, the trial's number and the trials known.

    So processes that share a study propose different trials, and a study that is resumed goes on as if never left.

    :param n_startup_trials: trials drawn at random first.
    """
    from optuna import samplers

    def fresh(number: int) -> samplers.BaseSampler:
        own = int(np.random.SeedSequence([seed, number]).generate_state(1)[0])
        if name == "random":
            return samplers.RandomSampler(seed=own)
        if name == "cmaes":
            return samplers.CmaEsSampler(seed=own, n_startup_trials=n_startup_trials, warn_independent_sampling=False)
        return samplers.TPESampler(seed=own, n_startup_trials=n_startup_trials, multivariate=True, constant_liar=True)

    class PerTrial(samplers.BaseSampler):
        """Asks a new sampler for each trial, seeded by the trial's number."""

        _current = fresh(0)

        def before_trial(self, study: Study, trial: Any) -> None:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # what is experimental about TPE's arguments is Optuna's affair
                self._current = fresh(trial.number)
            self._current.before_trial(study, trial)

        def infer_relative_search_space(self, study: Study, trial: Any) -> Any:
            return self._current.infer_relative_search_space(study, trial)

        def sample_relative(self, study: Study, trial: Any, search_space: Any) -> dict[str, Any]:
            return self._current.sample_relative(study, trial, search_space)

        def sample_independent(self, study: Study, trial: Any, param_name: str, param_distribution: Any) -> Any:
            return self._current.sample_independent(study, trial, param_name, param_distribution)

        def after_trial(self, study: Study, trial: Any, state: Any, values: Any) -> None:
            self._current.after_trial(study, trial, state, values)

    return PerTrial()


def make_pruner(name: str, n_startup_trials: int, n_evaluations: int) -> BasePruner:
    """One of :data:`PRUNERS`, with rl-zoo's settings.

    :param n_startup_trials: trials that ``median`` lets finish first.
    :param n_evaluations: of a trial; ``median`` prunes none before a third of them.
    """
    from optuna import pruners

    if name == "halving":
        return pruners.SuccessiveHalvingPruner(min_resource=1, reduction_factor=4, min_early_stopping_rate=0)
    if name == "median":
        return pruners.MedianPruner(n_startup_trials=n_startup_trials, n_warmup_steps=n_evaluations // 3)
    return pruners.NopPruner()
