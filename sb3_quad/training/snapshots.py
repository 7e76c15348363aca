"""Snapshots of a run: one file that holds all it needs to go on, and is replaced as a whole."""

import io
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import VecEnv

from sb3_quad.base.arrays import Arrays
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import one_line, read_arrays, write_arrays, write_bytes
from sb3_quad.callbacks.interruption import ENVIRONMENT, MEMORY, LastGoodModel, set_random_state
from sb3_quad.controllers.zips import load_zip
from sb3_quad.training.algorithms import get_algorithm
from sb3_quad.training.runs import RunFolder

DATASET = "dataset."  # before the names of the dataset's arrays
BUFFER_ARRAYS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")  # of a replay buffer
SHARE = 0.03  # of the run's time that snapshots may take


class SnapshotFile(LastGoodModel):
    """Writes the snapshot of a rollout's start to the run folder: of the first rollout, then of one in so many seconds.

    Where writing takes long, as it does for a large dataset on a slow disk, snapshots are rarer.

    :param every: most seconds of training that a killed run may lose; 0: only :meth:`write` writes.
    :param report: told of a snapshot that cannot be written; the training goes on.
    """

    def __init__(
        self,
        run: RunFolder,
        every: float,
        report: Callable[[str], None] = print,
        hurry: Callable[[], bool] = lambda: False,
    ) -> None:
        super().__init__(hurry)
        self._run, self._every, self._report = run, every, report
        self._written, self._took, self._rollout_start = -np.inf, 0.0, time.monotonic()

    def _on_rollout_start(self) -> None:
        before = self.snapshot
        super()._on_rollout_start()
        if self.snapshot is None or self.snapshot is before:
            return
        start, self._rollout_start = self._rollout_start, time.monotonic()
        if self._run.episodes.is_file():
            self.snapshot.state["episodes"] = np.array(self._run.episodes.stat().st_size)
        if self._run.best_model.is_file():
            self.snapshot.state["best_model"] = np.fromfile(self._run.best_model, dtype=np.uint8)
        if hasattr(self.model, "dataset"):
            self.snapshot.state[f"{DATASET}added"] = np.array(self.model.dataset.added)
        for name, buffer in _replay_buffers(self.model).items():
            self.snapshot.state.update({f"{name}.pos": np.array(buffer.pos), f"{name}.full": np.array(buffer.full)})
        due = self._written + max(self._every, self._took / SHARE)
        if self._every > 0 and self._rollout_start + (self._rollout_start - start) >= due:  # the next one would be too late
            try:
                self.write()
            except ConfigError as error:
                self._report(f"warning: no new snapshot, the one before is kept: {error}")
            self._written = time.monotonic()
            self._took = self._written - self._rollout_start

    def write(self) -> None:
        """Write the latest snapshot; until that is whole, the file holds the one before.

        :raises ConfigError: a folder that cannot be written, a full disk.
        """
        assert self.snapshot is not None
        timesteps, model, state = self.snapshot
        arrays: dict[str, Any] = {"timesteps": timesteps, "model": np.frombuffer(model, dtype=np.uint8), **state}
        if hasattr(self.model, "dataset"):
            dataset = self.model.dataset.snapshot(int(state[f"{DATASET}added"]))
            arrays |= {f"{DATASET}{name}": array for name, array in dataset.items()}
        for name, buffer in _replay_buffers(self.model).items():
            arrays |= {f"{name}.{key}": array for key, array in buffer_arrays(buffer).items()}
        write_arrays(self._run.resume_state, **arrays)


def load_snapshot(run: RunFolder, algo: str, env: VecEnv, device: str, **attributes: Any) -> BaseAlgorithm:
    """The model of a run's snapshot, ready for ``learn(…, reset_num_timesteps=False)``; what came after it is taken back.

    :param attributes: given to ``load``: what the zip does not hold, such as ``expert``.
    :raises ConfigError: a file that is missing or damaged.
    """
    path = run.resume_state
    if not path.is_file():
        further = f"; to train its model further use -i {run.result}" if run.result.is_file() else ""
        raise ConfigError(f"run folder {run.path}: holds no interrupted run{further}")
    state = read_arrays(path)
    if "timesteps" not in state:
        raise ConfigError(f"{path}: not a snapshot")
    in_one_file = "model" in state  # version 0.1 wrote three
    environment, dataset = _part(state, ENVIRONMENT), _part(state, DATASET)
    source, place = (io.BytesIO(state["model"].tobytes()), path) if in_one_file else (run.model, run.model)
    try:
        keywords = {"env": env, "device": device, "force_reset": not environment, **attributes}
        model: Any = load_zip(get_algorithm(algo), source, **keywords)
    except ConfigError as error:
        raise ConfigError(str(error).replace(str(source), str(place))) from None
    except Exception as error:  # what a damaged archive raises depends on where the damage is
        raise ConfigError(f"{place}: not a complete SB3 zip ({one_line(error)})") from None
    if model.num_timesteps != int(state["timesteps"]):
        raise ConfigError(
            f"run folder {run.path}: {run.model.name} is after {model.num_timesteps:,} timesteps, "
            f"{path.name} after {int(state['timesteps']):,}; they belong to different interruptions"
        )
    if hasattr(model, "dataset"):
        model.dataset.restore(dataset, path) if in_one_file else model.load_dataset(run.dataset)
    for name, buffer in _replay_buffers(model).items():
        restore_buffer(buffer, _part(state, f"{name}."), path)
    batch: Any = getattr(env.unwrapped, "batch", None)
    if environment and batch is None:
        raise ConfigError(f"{path}: holds the state of batched environments; use the run's own settings")
    if environment:
        batch.restore(environment)
        if hasattr(model, "restore_memory"):
            model.restore_memory(_part(state, MEMORY))
    _take_back(run, state)
    set_random_state(state)
    return cast(BaseAlgorithm, model)


def _replay_buffers(model: Any) -> dict[str, ReplayBuffer]:
    """By name; those of an off-policy algorithm."""
    buffers = {name: getattr(model, name, None) for name in ("replay_buffer", "expert_buffer")}
    return {name: buffer for name, buffer in buffers.items() if isinstance(buffer, ReplayBuffer)}


def buffer_arrays(buffer: ReplayBuffer) -> Arrays:
    """What a replay buffer holds, as :func:`restore_buffer` takes it beside its ``pos`` and ``full``; the arrays are views.

    :raises ConfigError: observations that are a Dict.
    """
    arrays = {name: getattr(buffer, name, None) for name in BUFFER_ARRAYS}
    if isinstance(arrays["observations"], dict):
        raise ConfigError("replay buffers of Dict observations are not part of a snapshot")
    rows = buffer.size() + 1  # with the memory-efficient variant's last observation
    return {name: array[: min(rows, len(array))] for name, array in arrays.items() if array is not None}


def restore_buffer(buffer: ReplayBuffer, arrays: Arrays, path: str | Path) -> None:
    """Go back to :func:`buffer_arrays`, ``pos`` and ``full``.

    :param path: the file that they come from, for the message.
    :raises ConfigError: they do not fit.
    """
    for name in BUFFER_ARRAYS:
        store, given = getattr(buffer, name, None), arrays.get(name)
        if store is None:
            continue
        if given is None or given.shape[1:] != store.shape[1:] or len(given) > len(store):
            raise ConfigError(f"{path}: its replay buffer is not of this model ({name})")
        store[: len(given)] = given
    buffer.pos, buffer.full = int(arrays["pos"]), bool(arrays["full"])


def _part(state: Arrays, prefix: str) -> Arrays:
    return {name.removeprefix(prefix): array for name, array in state.items() if name.startswith(prefix)}


def _take_back(run: RunFolder, state: Arrays) -> None:
    """Let evaluations, best model and episodes be those of the snapshot, so that nothing is there twice."""
    for path in run.path.glob("evaluations*.npz"):
        rows = read_arrays(path)
        earlier = rows["timesteps"] <= state["timesteps"]
        if not earlier.any():
            path.unlink()
        elif not earlier.all():
            write_arrays(path, **{name: array[earlier] for name, array in rows.items()})
    if "model" not in state:  # version 0.1 did not note the other files
        return
    if "best_model" in state:
        write_bytes(run.best_model, state["best_model"].tobytes())
    else:
        run.best_model.unlink(missing_ok=True)
    if run.episodes.is_file():
        os.truncate(run.episodes, min(run.episodes.stat().st_size, int(state.get("episodes", 0))))
