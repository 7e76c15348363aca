"""Snapshots of a run: one file that holds all it needs to go on, and is replaced as a whole."""

import io
import json
import os
import random
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import torch as th
from pydantic import TypeAdapter
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_quad.base.arrays import Arrays
from sb3_quad.base.errors import ConfigError, TrainingError
from sb3_quad.base.files import model_bytes, one_line, read_arrays, write_arrays, write_bytes
from sb3_quad.controllers.zips import load_zip
from sb3_quad.training.algorithms import get_algorithm
from sb3_quad.training.runs import RunFolder

ENVIRONMENT = "environment."  # before the names of its arrays
COUNTERS = {
    "dataset": ("added",),
    "replay_buffer": ("pos", "full"),
}  # of what a model may keep: how far it is filled
LOG = TypeAdapter(
    dict[str, tuple[float, int, tuple[str, ...]]]
)  # by name: value, how many it is the mean of, not shown by
NO_BYTES = np.zeros(0, np.uint8)
ANY_LENGTH = ("model", "best_model", "random", "log")
SHARE = 0.03  # of the run's time that snapshots may take
PAUSE = 1.0  # s between two snapshots of an off-policy algorithm, whose rollouts are short


class Snapshot(NamedTuple):
    """A model between two rollouts."""

    timesteps: int
    model: bytes  # the zip


class SnapshotFile(BaseCallback):
    """Takes a :class:`Snapshot` whenever a rollout starts, and writes that of the first, then one
    in so many seconds.

    Where writing takes long, as it does for a large dataset on a slow disk, fewer are written.

    :param every: seconds between two snapshots; 0: only :meth:`write` writes.
    :param report: called with one line if a snapshot cannot be written; the training goes on.
    :param hurry: whether an off-policy algorithm's next snapshot is wanted at once.
    :raises TrainingError: parameters that are no longer finite; the snapshot is then the one from
        before that update.
    """

    snapshot: Snapshot | None = None

    def __init__(
        self, run: RunFolder, every: float, report: Callable[[str], None], hurry: Callable[[], bool]
    ) -> None:
        super().__init__()
        self._run, self._every, self._report, self._hurry = run, every, report, hurry
        self._state: Arrays = {}
        self._taken, self._next_write = -np.inf, -np.inf  # s

    @property
    def is_fresh(self) -> bool:
        """Whether the rollout under way is in its first step after the snapshot, so that no buffer
        holds more than it.
        """
        after = self.num_timesteps - self.training_env.num_envs
        return (
            not isinstance(self.model, OffPolicyAlgorithm)
            or self.snapshot is None
            or self.snapshot.timesteps == after
        )

    def _on_training_start(self) -> None:
        if (
            self._run.resume_state.is_file()
        ):  # the log of a resumed run says what it would have said
            set_log(
                self.logger,
                read_arrays(self._run.resume_state, "log").get("log"),
                self._run.resume_state,
            )

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        start = time.monotonic()
        if (
            isinstance(self.model, OffPolicyAlgorithm)
            and start < self._taken + PAUSE
            and not self._hurry()
        ):
            return
        for name, parameter in self.model.policy.named_parameters():
            if not th.isfinite(parameter).all():
                raise TrainingError(
                    f"after {self.num_timesteps:,} timesteps {name} is no longer finite; lower learning_rate"
                )
        self._taken, self.snapshot = (
            start,
            Snapshot(self.model.num_timesteps, model_bytes(self.model)),
        )
        self._state = self._beside_the_model()
        start = time.monotonic()
        if self._every > 0 and start >= self._next_write:
            try:
                self.write()
            except ConfigError as error:
                self._report(f"warning: no new snapshot, the one before is kept: {error}")
            self._next_write = start + max(self._every, (time.monotonic() - start) / SHARE)

    def _beside_the_model(self) -> Arrays:
        """Random numbers, environments, how far files have come, and how far the dataset and
        buffers are filled.

        What these hold is read when the snapshot is written. A rollout later they hold more, and
        the oldest of a full one are replaced; the resumed training adds the same rows again before
        it reads any.
        """
        model: Any = self.model
        batch: Any = getattr(
            self.training_env.unwrapped, "batch", None
        )  # there is none in dummy and subproc
        state = random_state() | {"log": log_state(self.logger)}
        state |= _with_prefix(ENVIRONMENT, batch.snapshot() if batch is not None else {})
        episodes, best_model = self._run.episodes, self._run.best_model
        state["episodes"] = np.array(episodes.stat().st_size if episodes.is_file() else 0)
        state["best_model"] = (
            np.fromfile(best_model, dtype=np.uint8) if best_model.is_file() else NO_BYTES
        )
        return state | _counters(model)

    def write(self) -> None:
        """Write the latest snapshot; until that is whole, the file holds the one before.

        :raises ConfigError: a folder that cannot be written, a full disk.
        """
        assert self.snapshot is not None
        timesteps, model = self.snapshot
        arrays: dict[str, Any] = {
            "timesteps": np.array(timesteps),
            "model": np.frombuffer(model, dtype=np.uint8),
            **self._state,
        }
        for name, store in _stores(self.model).items():
            arrays |= _with_prefix(f"{name}.", _filled(store))
        write_arrays(self._run.resume_state, **arrays)


def load_snapshot(
    run: RunFolder, algo: str, env: VecEnv, device: str, **attributes: Any
) -> BaseAlgorithm:
    """The model of a run's snapshot, ready for ``learn(…, reset_num_timesteps=False)``; what came
    after it is taken back.

    :param attributes: given to ``load``: what the zip does not hold, such as ``expert``.
    :raises ConfigError: a file that is missing or damaged, or of other settings; nothing has been
        taken back then.
    """
    path = run.resume_state
    if not path.is_file():
        further = (
            f"; to train its model further use -i {run.result}" if run.result.is_file() else ""
        )
        raise ConfigError(f"run folder {run.path}: holds no interrupted run{further}")
    state, batch = read_arrays(path), getattr(env.unwrapped, "batch", None)
    environment = {
        name.removeprefix(ENVIRONMENT): each
        for name, each in state.items()
        if name.startswith(ENVIRONMENT)
    }
    algorithm = get_algorithm(algo)
    _check(state, {"model": NO_BYTES}, path)
    zip_file, where = io.BytesIO(state["model"].tobytes()), f"{path}: model"
    model: Any = load_zip(
        algorithm,
        zip_file,
        where=where,
        env=env,
        device=device,
        force_reset=batch is None,
        **attributes,
    )
    one = np.array(0)
    _check(
        state,
        {
            "timesteps": one,
            "episodes": one,
            "best_model": NO_BYTES,
            "log": np.array(""),
            **random_state(),
        },
        path,
    )
    _check(state, _with_prefix(ENVIRONMENT, batch.snapshot() if batch is not None else {}), path)
    _require(
        batch is not None or not environment,
        f"{ENVIRONMENT}… is of environments of another kind",
        path,
    )
    _require(int(state["episodes"]) >= 0, "episodes is negative", path)
    try:
        set_random_state(state)
    except Exception as error:  # what is no state raises what it likes
        _require(
            False, f"random and torch are no states of random numbers ({one_line(error)})", path
        )
    _require(model.num_timesteps == int(state["timesteps"]), "timesteps is not that of model", path)
    _check(state, _counters(model), path)
    for name, store in _stores(model).items():
        for counter in COUNTERS[name]:
            value = state[f"{name}.{counter}"].item()
            _require(
                0 <= value < getattr(store, "buffer_size", np.inf),
                f"{name}.{counter} is beyond its rows",
                path,
            )
            setattr(store, counter, value)
        own = _with_prefix(f"{name}.", _filled(store))
        # What was written later than the rest may hold more rows.
        state |= {
            each: state[each][: len(rows)]
            for each, rows in own.items()
            if each in state and state[each].ndim
        }
        _check(state, own, path)
        for each, rows in own.items():
            rows[...] = state[each]
    if batch is not None:
        try:
            batch.restore(environment)
        except ConfigError as error:
            raise ConfigError(f"{path}: {error}") from None
    _take_back(run, state, model.num_timesteps)
    set_random_state(state)
    return cast(BaseAlgorithm, model)


def _check(state: Arrays, expected: Arrays, path: Path) -> None:
    """See that a snapshot has arrays of the names, types and shapes of those that are expected."""
    for name, like in expected.items():
        _require(name in state, f"{name} is missing", path)
        array = state[name]
        kinds = [
            (each.dtype.kind, each.ndim) if name in ANY_LENGTH else (each.dtype, each.shape)
            for each in (array, like)
        ]
        found = f"{name} is {array.dtype} of shape {array.shape}, must be {like.dtype} of shape {like.shape}"
        _require(kinds[0] == kinds[1], found, path)


def _require(fits: bool, otherwise: str, path: Path) -> None:
    if not fits:
        raise ConfigError(
            f"{path}: {otherwise}; it is damaged, or of other settings; -i trains an agent of the run further"
        )


def _with_prefix(prefix: str, arrays: Arrays) -> Arrays:
    return {f"{prefix}{name}": array for name, array in arrays.items()}


def _stores(model: Any) -> dict[str, Any]:
    """What a model keeps beyond a rollout, by name."""
    return {
        name: getattr(model, name) for name in COUNTERS if getattr(model, name, None) is not None
    }


def _counters(model: Any) -> Arrays:
    """How far these are filled."""
    stores = _stores(model)
    return {
        f"{name}.{each}": np.array(getattr(stores[name], each))
        for name in stores
        for each in COUNTERS[name]
    }


def _filled(store: Any) -> Arrays:
    """Views of the rows that a dataset or a replay buffer holds, by name."""
    if not isinstance(store, ReplayBuffer):
        return store.filled  # type: ignore[no-any-return]
    if isinstance(store.observations, dict):
        raise ConfigError("replay buffers of Dict observations are not part of a snapshot")
    rows = store.size() + 1  # the memory-efficient variant keeps the last next observation there
    return {
        name: array[:rows] for name, array in vars(store).items() if isinstance(array, np.ndarray)
    }


def _take_back(run: RunFolder, state: Arrays, timesteps: int) -> None:
    """Let evaluations, best model and episodes be those of the snapshot, so that nothing is there
    twice.
    """
    evaluations = {path: read_arrays(path) for path in run.path.glob("evaluations*.npz")}
    for path, rows in evaluations.items():
        is_table = "timesteps" in rows and len({each.shape[:1] for each in rows.values()}) == 1
        _require(is_table and rows["timesteps"].dtype.kind == "i", "holds no evaluations", path)
    for path, rows in evaluations.items():
        earlier = rows["timesteps"] <= timesteps
        if not earlier.any():
            path.unlink()
        elif not earlier.all():
            write_arrays(path, **{name: array[earlier] for name, array in rows.items()})
    if state["best_model"].size:
        write_bytes(run.best_model, state["best_model"].tobytes())
    else:
        run.best_model.unlink(missing_ok=True)
    if run.episodes.is_file():
        os.truncate(run.episodes, min(run.episodes.stat().st_size, int(state["episodes"])))


def log_state(logger: Logger) -> Any:
    """What was recorded since the logger's last dump, such as the losses of the latest update, as
    JSON.
    """
    numbers = {
        name: value
        for name, value in logger.name_to_value.items()
        if isinstance(value, (int, float, np.number))
    }
    kept = {
        name: (float(each), logger.name_to_count[name], logger.name_to_excluded[name])
        for name, each in numbers.items()
    }
    return np.array(json.dumps(kept))


def set_log(logger: Logger, state: Any, path: Path) -> None:
    """Record what :func:`log_state` gave.

    :raises ConfigError: something else, which the file at ``path`` holds.
    """
    try:
        kept = LOG.validate_python(json.loads(str(state)))
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: not a snapshot (log: {one_line(error)})") from None
    for name, (value, count, excluded) in kept.items():
        logger.name_to_value[name], logger.name_to_excluded[name] = value, excluded
        logger.name_to_count[name] = count


def random_state() -> Arrays:
    """The states of the global random number generators of torch, Python and NumPy, which SB3
    samples from.
    """
    numpy_state: Any = np.random.get_state(legacy=False)  # noqa: NPY002
    numpy_state["state"]["key"] = numpy_state["state"]["key"].tolist()
    text = json.dumps([random.getstate(), numpy_state])
    return {"torch": th.get_rng_state().numpy().copy(), "random": np.array(text)}


def set_random_state(state: Arrays) -> None:
    """Undo what has happened to the random numbers since :func:`random_state`."""
    (version, words, gauss), numpy_state = json.loads(str(state["random"]))
    random.setstate((version, tuple(words), gauss))
    np.random.set_state(numpy_state)  # noqa: NPY002
    th.set_rng_state(th.from_numpy(state["torch"]))
