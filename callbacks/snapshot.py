"""Snapshots of a training: one file with everything that it needs to continue, replaced as a whole.

:class:`SnapshotFile` writes it, :func:`restore` reads it.
"""

import io
import json
import random
import time
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch as th
from pydantic import TypeAdapter
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_quad.agents.zips import load_zip
from sb3_quad.algorithms.chain import STATISTICS, share_statistics
from sb3_quad.base.errors import ConfigError, TrainingError, raised_as
from sb3_quad.base.files import read_arrays, write_arrays, write_bytes
from sb3_quad.base.process import StopSignals
from sb3_quad.base.types import Arrays, Report, StrDict, StrPath

Algorithm = TypeVar("Algorithm", bound=BaseAlgorithm)

# Prefix of the environments' arrays.
ENVIRONMENT = "environment."
# By name: value, sample count, excluded formats.
LOG = TypeAdapter(dict[str, tuple[float, int, tuple[str, ...]]])
NO_BYTES = np.zeros(0, np.uint8)
# Arrays whose length is not known before they are read.
ANY_LENGTH = ("model", "best_model", "random", "log")
# Share of the run's time that snapshots may take.
SHARE = 0.03


class SnapshotFile(BaseCallback):
    """Takes a snapshot whenever a rollout starts, and writes some of them to a file.

    It writes the first one, then one every few seconds. If writing takes long, such as with a large
    dataset on a slow disk, it writes fewer. A training that :func:`restore` continues equals an
    uninterrupted one bit for bit, if its environment is the batched one and has no wrappers.

    >>> from stable_baselines3 import PPO
    >>> from sb3_quad.callbacks.snapshot import restore
    >>> from sb3_quad.envs import QuadcopterVecEnv
    >>> env = QuadcopterVecEnv(8, max_episode_steps=50, seed=0)
    >>> model = PPO("MlpPolicy", env, n_steps=100, batch_size=400, device="cpu")
    >>> _ = model.learn(1600, callback=SnapshotFile("resume.npz"))
    >>> model, _ = restore("resume.npz", PPO, env, device="cpu")
    >>> _ = model.learn(1600, callback=SnapshotFile("resume.npz"), reset_num_timesteps=False)

    :param path: the file.
    :param every: seconds between two snapshots; 0: only :meth:`write` writes.
    :param report: called with one line if a snapshot cannot be written; the training continues.
    :param signals: a received signal ends the training as soon as the snapshot can be completed.
    :param episodes: a log of the training, whose length belongs to the snapshot.
    :param best_model: a file that belongs to the snapshot.
    :raises ConfigError: an algorithm with a replay buffer, when training begins.
    :raises TrainingError: parameters that are no longer finite; the snapshot is then from before
        that update.
    """

    def __init__(
        self,
        path: StrPath,
        every: float = 60.0,
        report: Report = print,
        signals: StopSignals | None = None,
        episodes: StrPath = "0.monitor.csv",
        best_model: StrPath = "best_model.zip",
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        self._path = Path(path)
        self._every = every
        self._report = report
        self._signals = signals or StopSignals()
        self._episodes = Path(episodes)
        self._best_model = Path(best_model)
        self._state: Arrays = {}
        self._next_write = -np.inf  # s

    def _on_training_start(self) -> None:
        if isinstance(self.model, OffPolicyAlgorithm):
            raise ConfigError(
                "SnapshotFile: replay buffers are no part of it; use SB3's CheckpointCallback"
            )
        # Restore pending log values, so that a resumed run logs what an uninterrupted one would.
        # Without reset_num_timesteps=False, the training is a new one.
        if self.num_timesteps == 0 or not self._path.is_file():
            return
        log = read_arrays(self._path, "log")["log"]
        for name, (value, count, excluded) in LOG.validate_json(str(log)).items():
            self.logger.name_to_value[name] = value
            self.logger.name_to_count[name] = count
            self.logger.name_to_excluded[name] = excluded

    def _on_step(self) -> bool:
        return not self._signals.received

    def _on_rollout_start(self) -> None:
        self._take()
        start = time.monotonic()
        if self._every > 0 and start >= self._next_write:
            try:
                self.write()
            except ConfigError as error:
                self._report(f"warning: no new snapshot, the one before is kept: {error}")
            self._next_write = start + max(self._every, (time.monotonic() - start) / SHARE)

    def _on_training_end(self) -> None:
        # A later callback may raise, and the finished model would be lost. After a signal, the
        # training has ended within a rollout.
        if not self._signals.received:
            self._take()

    def _take(self) -> None:
        """Keep the training as it is now.

        :raises TrainingError: its parameters are no longer finite.
        """
        for name, parameter in self.model.policy.named_parameters():
            if not th.isfinite(parameter).all():
                raise TrainingError(
                    f"after {self.num_timesteps:,} timesteps {name} is no longer finite; "
                    "lower learning_rate"
                )
        model = io.BytesIO()
        self.model.save(model)
        # The rows of the dataset are read when the snapshot is written. A rollout later there are
        # more, and the oldest of a full one are replaced; the resumed training adds the same rows
        # again before it reads any.
        self._state = {
            **_surroundings(self.training_env, self.model),
            "timesteps": np.array(self.model.num_timesteps),
            "model": np.frombuffer(model.getvalue(), np.uint8),
            "log": log_state(self.logger),
        }
        if self._episodes.is_file():
            self._state["episodes"] = np.array(self._episodes.stat().st_size)
        if self._best_model.is_file():
            self._state["best_model"] = np.fromfile(self._best_model, np.uint8)

    def write(self) -> None:
        """Write the latest snapshot; until it is complete, the file keeps the one before.

        :raises ConfigError: a folder that cannot be written, a full disk.
        """
        arrays: StrDict = {**self._state, **_rows(self.model)}
        write_arrays(self._path, **arrays)

    def save_model(self, path: StrPath) -> str:
        """Write the model of the latest snapshot, and return its place; empty without one."""
        if not self._state:
            return ""
        write_bytes(path, self._state["model"].tobytes())
        return f"; the model after {self._state['timesteps']:,} timesteps is in {path}"


def restore(
    path: StrPath, algorithm: type[Algorithm], env: VecEnv, **keywords: Any
) -> tuple[Algorithm, Arrays]:
    """Load the model of a snapshot, ready for ``learn(…, reset_num_timesteps=False)``.

    Its dataset, the environments and all random numbers continue where they were.

    :param keywords: passed to ``load``, such as ``device``, and ``expert``, which no zip contains.
    :return: the model, and the arrays of the snapshot.
    :raises ConfigError: a file that is missing or damaged, or has other settings.
    """
    state = read_arrays(path)
    try:
        return _restore(state, algorithm, env, keywords), state
    except ConfigError as error:
        raise misfit(path, error) from None


def misfit(path: StrPath, problem: object) -> ConfigError:
    """Return the error for a file of a run that does not fit."""
    return ConfigError(
        f"{path}: {problem}; it is damaged, or of other settings; "
        "-i trains an agent of the run further"
    )


def _restore(
    state: Arrays, algorithm: type[Algorithm], env: VecEnv, keywords: StrDict
) -> Algorithm:
    batch = _batch(env)
    # The model comes first, since the other expected arrays depend on it.
    _check(state, {"model": NO_BYTES})
    model: Algorithm = load_zip(
        algorithm,
        io.BytesIO(state["model"].tobytes()),
        where="model",
        env=env,
        force_reset=batch is None,
        **keywords,
    )
    share_statistics(getattr(model, STATISTICS, None), env, training=True)
    _check(state, {"timesteps": np.array(0), **_surroundings(env, model)})
    _require(int(state["episodes"]) >= 0, "episodes is negative")
    _require(model.num_timesteps == state["timesteps"], "timesteps is not that of model")
    _fill_dataset(model, state)
    environment = {
        name.removeprefix(ENVIRONMENT): array
        for name, array in state.items()
        if name.startswith(ENVIRONMENT)
    }
    if batch is not None:
        batch.restore(environment)
    else:
        _require(not environment, f"{ENVIRONMENT}… belongs to environments of another kind")
    # The random numbers come last, since loading may sample. Damaged text may raise anything.
    with raised_as(ConfigError, "log, random or torch cannot be read"):
        LOG.validate_json(str(state["log"]))
        set_random_state(state)
    return model


def _surroundings(env: VecEnv, model: Any) -> Arrays:
    """Return random states, environments and the dataset's counter, and placeholders for the log
    and the files.
    """
    state = {
        **random_state(),
        "log": np.array(""),
        "episodes": np.array(0),
        "best_model": NO_BYTES,
    }
    batch = _batch(env)
    if batch is not None:
        for name, array in batch.snapshot().items():
            state[f"{ENVIRONMENT}{name}"] = array
    if hasattr(model, "dataset"):
        state["dataset.added"] = np.array(model.dataset.added)
    return state


def _check(state: Arrays, expected: Arrays) -> None:
    """Check that a snapshot has arrays of the names, types and shapes of the expected ones."""
    for name, like in expected.items():
        _require(name in state, f"{name} is missing")
        array = state[name]
        if name in ANY_LENGTH:
            fits = array.dtype.kind == like.dtype.kind and array.ndim == like.ndim
        else:
            fits = array.dtype == like.dtype and array.shape == like.shape
        _require(
            fits,
            f"{name} is {array.dtype} {array.shape}, must be {like.dtype} {like.shape}",
        )


def _require(fits: bool, problem: str) -> None:
    if not fits:
        raise ConfigError(problem)


def _batch(env: VecEnv) -> Any:
    """Return the batch of the batched environment, which can be restored; None for others, and for
    wrapped ones.
    """
    # Wrappers have their own state, which begins with the episodes.
    return None if env is not env.unwrapped else getattr(env, "batch", None)


def _rows(model: Any) -> Arrays:
    """Return views of the filled rows of a model's dataset, by name; none without a dataset."""
    if not hasattr(model, "dataset"):
        return {}
    return {f"dataset.{key}": array for key, array in model.dataset.filled.items()}


def _fill_dataset(model: Any, state: Arrays) -> None:
    """Put a snapshot's rows into a model's dataset, if it has one."""
    if hasattr(model, "dataset"):
        added = state["dataset.added"].item()
        _require(added >= 0, "dataset.added is negative")
        model.dataset.added = added
    for key, rows in _rows(model).items():
        # Arrays that were written after the counter may have more rows.
        if key in state and state[key].ndim:
            state[key] = state[key][: len(rows)]
        _check(state, {key: rows})
        rows[...] = state[key]


def log_state(logger: Logger) -> Any:
    """Return what was recorded since the logger's last dump, as JSON.

    These are the losses of the latest update, for example.
    """
    records = {}
    for name, value in logger.name_to_value.items():
        if isinstance(value, (int, float, np.number)):
            records[name] = (
                float(value),
                logger.name_to_count[name],
                logger.name_to_excluded[name],
            )
    return np.array(json.dumps(records))


def random_state() -> Arrays:
    """Return the states of the global generators that SB3 samples from.

    They are torch's, Python's and NumPy's.
    """
    states = [random.getstate(), np.random.get_state(legacy=False)]  # noqa: NPY002
    return {
        "torch": th.get_rng_state().numpy().copy(),
        "random": np.array(json.dumps(states, default=np.ndarray.tolist)),
    }


def set_random_state(state: Arrays) -> None:
    """Restore the generators to what :func:`random_state` returned."""
    (version, words, gauss), numpy_state = json.loads(str(state["random"]))
    random.setstate((version, tuple(words), gauss))
    np.random.set_state(numpy_state)  # noqa: NPY002
    th.set_rng_state(th.from_numpy(state["torch"]))
