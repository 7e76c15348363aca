"""The aggregated dataset: visited observations with the expert's action for each."""

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch as th

from sb3_quad.base.arrays import Arrays, Float32Array, IntArray
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import read_arrays, write_arrays
from sb3_quad.base.memory import check_memory


class AggregatedDataset:
    """A bounded set of (observation, expert action) pairs, on the CPU; the oldest leave first.

    :param capacity: most pairs held
    :param observation_shape: shape of one observation
    :param action_dim: length of one action
    :param dtype: of the observations; actions are float32
    :raises ConfigError: more than this machine's memory holds
    """

    def __init__(
        self, capacity: int, observation_shape: tuple[int, ...], action_dim: int, dtype: npt.DTypeLike = np.float32
    ) -> None:
        self.capacity = capacity
        size = int(np.prod(observation_shape)) * np.dtype(dtype).itemsize + action_dim * 4
        check_memory(f"dataset_capacity {capacity:,}", capacity * size)
        # np.empty takes no memory before it is written to, so a large capacity costs what is in use.
        self._observations = th.from_numpy(np.empty((capacity, *observation_shape), dtype=dtype))
        self._actions = th.from_numpy(np.empty((capacity, action_dim), dtype=np.float32))
        self.added = 0  # since it was empty

    def __len__(self) -> int:
        return min(self.added, self.capacity)

    def clear(self) -> None:
        """Forget every pair."""
        self.added = 0

    def add(self, observations: npt.NDArray[Any], actions: Float32Array) -> None:
        """Add observations (n, ...) and actions (n, action_dim), oldest first; of more than ``capacity``, the last."""
        observations, actions = observations[-self.capacity :], actions[-self.capacity :]
        rows = (self.added + np.arange(len(actions))) % self.capacity
        self._observations.numpy()[rows] = observations
        self._actions.numpy()[rows] = actions
        self.added += len(actions)

    def pairs(self, rows: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Observations (b, ...) and expert actions (b, action_dim) of rows (b,), counted from the oldest."""
        if self.added > self.capacity:
            rows = (rows + self.added) % self.capacity
        return self._observations.index_select(0, rows), self._actions.index_select(0, rows)

    def arrays(self, rows: IntArray) -> tuple[npt.NDArray[Any], Float32Array, IntArray]:
        """Where ``rows`` are in all that there is room for, which comes before: observations and actions, (capacity, size)."""
        places = (rows + self.added) % self.capacity if self.added > self.capacity else rows
        return self._observations.numpy().reshape(self.capacity, -1), self._actions.numpy(), places

    def save(self, path: str | Path) -> None:
        """Write every pair, oldest first, to an .npz file, whole or not at all; ``.npz`` is added to a name without a suffix.

        :raises ConfigError: a place that cannot be written to
        """
        observations, actions = self.pairs(th.arange(len(self)))
        write_arrays(_npz(path), observations=observations.numpy(), actions=actions.numpy())

    def load(self, path: str | Path) -> None:
        """Replace the pairs by the last ``capacity`` of those in a file that :meth:`save` wrote.

        :raises ConfigError: a file that is missing, damaged, or of other observations or actions
        """
        arrays = read_arrays(_npz(path))
        self._check(arrays, len(arrays.get("actions", ())), path)
        self.clear()
        self.add(arrays["observations"], arrays["actions"])

    def snapshot(self, added: int) -> Arrays:
        """The memory as it was when it had been added ``added`` pairs: now, or before the latest :meth:`add`.

        What :meth:`add` has replaced since then is not there any more: as many pairs must be added before the next are taken.
        The arrays are views.
        """
        n = min(added, self.capacity)
        return {"added": np.array(added), "observations": self._observations.numpy()[:n], "actions": self._actions.numpy()[:n]}

    def restore(self, snapshot: Arrays, path: str | Path) -> None:
        """Go back to a :meth:`snapshot`.

        :param path: the file that it comes from, for the message.
        :raises ConfigError: it is of another capacity, or of other observations or actions
        """
        added = int(snapshot.get("added", 0))
        n = min(added, self.capacity)
        self._check(snapshot, n, path)
        self._observations.numpy()[:n], self._actions.numpy()[:n] = snapshot["observations"], snapshot["actions"]
        self.added = added

    def _check(self, arrays: Arrays, n: int, path: str | Path) -> None:
        stores = {"observations": self._observations, "actions": self._actions}
        given = {name: arrays[name].shape for name in stores if name in arrays}
        needed = {name: (n, *store.shape[1:]) for name, store in stores.items()}
        if given != needed:
            raise ConfigError(f"dataset {path}: holds arrays of shape {given}, this model needs {needed}")


def sample_rows(n_rows: int, count: int, rng: np.random.Generator, shuffle: bool = True) -> IntArray:
    """``count`` row numbers below ``n_rows``: whole passes in random order, then a remainder at random; or all in order."""
    if not shuffle:
        return np.arange(count, dtype=np.int64) % n_rows
    passes, rest = divmod(count, n_rows)
    parts = [rng.permutation(n_rows) for _ in range(passes)]
    return np.concatenate([*parts, rng.integers(n_rows, size=rest)]).astype(np.int64, copy=False)


def _npz(path: str | Path) -> Path:
    return Path(path) if Path(path).suffix else Path(f"{path}.npz")
