"""Optuna's studies: where they are remembered, what proposes their trials, what cuts them short."""

import os
import platform
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Event, Thread
from typing import Any, Literal

import numpy as np
import optuna
from optuna import Study, Trial
from optuna.exceptions import DuplicatedStudyError
from optuna.pruners import BasePruner, MedianPruner, NopPruner, SuccessiveHalvingPruner
from optuna.samplers import BaseSampler, CmaEsSampler, RandomSampler, TPESampler
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend, JournalFileSymlinkLock
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
LINE = b'{"op_code":'  # begins every line of a journal
OWNER = "owner"  # user attribute of a trial: the machine and process that train it, and when they last said so
SIGN, LEASE = 20.0, 120.0  # s between two signs of life; without any for so long, a process counts as dead
PATIENCE = 10.0  # s to wait for the process that begins a study to say what it began with


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
    opened: Any = None if storage is None else str(storage)
    try:
        if storage is not None and "://" not in str(storage):
            Path(storage).parent.mkdir(parents=True, exist_ok=True)
            opened = JournalStorage(_Journal(str(opened)))
        try:
            study, new = optuna.create_study(study_name=name, storage=opened, direction=direction), True
        except DuplicatedStudyError:
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


class _Journal(JournalFileBackend):
    """A journal file whose last line, where a full disk has cut it, is dropped before the next one is appended to it."""

    def __init__(self, path: str) -> None:
        self._path, self._own_lock = Path(path), JournalFileSymlinkLock(path)
        super().__init__(path, self._own_lock)

    def append_logs(self, logs: list[dict[str, Any]]) -> None:
        """As Optuna's.

        :raises ValueError: a file that ends as no journal does.
        """
        with self._path.open("rb+") as file:
            if file.seek(0, os.SEEK_END) and (file.seek(-1, os.SEEK_CUR), file.read())[1] != b"\n":
                self._own_lock.acquire()  # another process may be in the middle of a line
                try:
                    file.seek(0)
                    content = file.read()
                    whole = content.rfind(b"\n") + 1
                    if content[whole : whole + len(LINE)] != LINE[: len(content) - whole]:
                        raise ValueError("its last line is not a journal's")
                    file.truncate(whole)
                finally:
                    self._own_lock.release()
        super().append_logs(logs)


def ask(study: Study, sampler: str, seed: int, n_startup_trials: int) -> Trial:
    """The next trial of a study. What is proposed depends on ``seed``, the trial's number and the trials known.

    So processes that share a study propose different trials, and a study that is resumed goes on as if never left.

    :param sampler: one of :data:`SAMPLERS`.
    :param n_startup_trials: sampled at random first.
    """
    study.sampler = RandomSampler()  # proposes nothing yet: the trial's number is to be known first
    trial = study.ask()
    own = int(np.random.SeedSequence([seed, trial.number]).generate_state(1)[0])
    study.sampler = SAMPLERS[sampler](own, n_startup_trials)
    return Trial(study, trial._trial_id)


@contextmanager
def owned(trial: Trial) -> Iterator[None]:
    """Within the block, a thread tells the study every 20 s that this process still trains a trial.

    Optuna's heartbeats do the same, for databases alone.
    """
    ended = Event()

    def sign() -> None:
        trial.set_user_attr(OWNER, [platform.node(), os.getpid(), time.time()])

    def keep_signing() -> None:
        while not ended.wait(SIGN):
            with suppress(Exception):  # a storage that fails is told of by who trains
                sign()

    thread = Thread(target=keep_signing, daemon=True)
    try:
        sign()
        thread.start()
        yield
    finally:
        ended.set()
        if thread.ident is not None:
            thread.join()


def dead_trials(study: Study) -> list[FrozenTrial]:
    """The trials that are said to run, but whose process is gone from this machine or has given no sign of life for 120 s."""
    running = study.get_trials(deepcopy=False, states=[TrialState.RUNNING])
    return [trial for trial in running if _is_dead(trial)]


def _is_dead(trial: FrozenTrial) -> bool:
    begun = trial.datetime_start.timestamp() if trial.datetime_start else 0.0
    machine, process, last = trial.user_attrs.get(OWNER, ["", 0, begun])
    if machine == platform.node():
        try:
            os.kill(process, 0)  # does nothing but fail where there is none
        except ProcessLookupError:
            return True
        except PermissionError:  # another user's
            pass
    return bool(time.time() - last > LEASE)
