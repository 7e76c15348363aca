"""The aggregated dataset: visited observations with the expert's action for each."""

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch as th

from sb3_quad.base.arrays import Arrays, BoolArray, Float32Array, IntArray
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import read_arrays, write_arrays


class AggregatedDataset:
    """A bounded set of (observation, expert action) pairs, on the CPU; the oldest leave first.

    :param capacity: most pairs held
    :param observation_shape: shape of one observation
    :param action_dim: length of one action
    :param dtype: of the observations; actions are float32
    """

    row_pairs = 1  # pairs in a row

    def __init__(
        self, capacity: int, observation_shape: tuple[int, ...], action_dim: int, dtype: npt.DTypeLike = np.float32
    ) -> None:
        shapes = {"observations": (*observation_shape,), "actions": (action_dim,)}
        self._allocate(capacity, shapes, {"observations": dtype})

    def _allocate(self, capacity: int, shapes: dict[str, tuple[int, ...]], dtypes: dict[str, npt.DTypeLike]) -> None:
        """Room for ``capacity`` rows of each array, float32 where ``dtypes`` says nothing else."""
        self.capacity = capacity
        types = {name: np.dtype(dtypes.get(name, np.float32)) for name in shapes}
        # np.empty takes no memory before it is written to, so a large capacity costs what is in use.
        self._stores = {name: th.from_numpy(np.empty((capacity, *shape), types[name])) for name, shape in shapes.items()}
        self.added = 0  # since it was empty

    def __len__(self) -> int:
        return min(self.added, self.capacity)

    @property
    def n_pairs(self) -> int:
        """Pairs held."""
        return len(self) * self.row_pairs

    def clear(self) -> None:
        """Forget every pair."""
        self.added = 0

    def add(self, observations: npt.NDArray[Any], actions: Float32Array) -> None:
        """Add observations (n, ...) and actions (n, action_dim), oldest first; of more than ``capacity``, the last."""
        self._add(observations=observations, actions=actions)

    def _add(self, **arrays: npt.NDArray[Any]) -> None:
        n = min(len(arrays["actions"]), self.capacity)
        rows = (self.added + np.arange(n)) % self.capacity
        for name, store in self._stores.items():
            store.numpy()[rows] = arrays[name][-n:]
        self.added += n

    def pairs(self, rows: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Observations (b, ...) and expert actions (b, action_dim) of rows (b,), counted from the oldest."""
        observations, actions, *_ = self._rows(rows)
        return observations, actions

    def _rows(self, rows: th.Tensor) -> list[th.Tensor]:
        """Those of each array, in the order of :meth:`_allocate`."""
        if self.added > self.capacity:
            rows = (rows + self.added) % self.capacity
        return [store.index_select(0, rows) for store in self._stores.values()]

    def arrays(self, rows: IntArray) -> tuple[npt.NDArray[Any], Float32Array, IntArray]:
        """Where ``rows`` are in all that there is room for, which comes before: observations and actions, (capacity, size)."""
        places = (rows + self.added) % self.capacity if self.added > self.capacity else rows
        observations, actions = (self._stores[name].numpy() for name in ("observations", "actions"))
        return observations.reshape(self.capacity, -1), actions, places

    def save(self, path: str | Path) -> None:
        """Write every pair, oldest first, to an .npz file, whole or not at all; ``.npz`` is added to a name without a suffix.

        :raises ConfigError: a place that cannot be written to
        """
        columns = zip(self._stores, self._rows(th.arange(len(self))), strict=True)
        arrays: dict[str, Any] = {name: array.numpy() for name, array in columns}
        write_arrays(_npz(path), **arrays)

    def load(self, path: str | Path) -> None:
        """Replace the pairs by the last ``capacity`` of those in a file that :meth:`save` wrote.

        :raises ConfigError: a file that is missing, damaged, or of other observations or actions
        """
        arrays = read_arrays(_npz(path))
        self._check(arrays, len(arrays.get("actions", ())), path)
        self.clear()
        self._add(**arrays)

    def snapshot(self, added: int) -> Arrays:
        """The memory as it was when it had been added ``added`` pairs: now, or before the latest :meth:`add`.

        What :meth:`add` has replaced since then is not there any more: as many pairs must be added before the next are taken.
        The arrays are views.
        """
        n = min(added, self.capacity)
        return {"added": np.array(added), **{name: store.numpy()[:n] for name, store in self._stores.items()}}

    def restore(self, snapshot: Arrays, path: str | Path) -> None:
        """Go back to a :meth:`snapshot`.

        :param path: the file that it comes from, for the message.
        :raises ConfigError: it is of another capacity, or of other observations or actions
        """
        added = int(snapshot.get("added", 0))
        n = min(added, self.capacity)
        self._check(snapshot, n, path)
        for name, store in self._stores.items():
            store.numpy()[:n] = snapshot[name]
        self.added = added

    def _check(self, arrays: Arrays, n: int, path: str | Path) -> None:
        given = {name: arrays[name].shape for name in self._stores if name in arrays}
        needed = {name: (n, *store.shape[1:]) for name, store in self._stores.items()}
        if given != needed:
            raise ConfigError(f"dataset {path}: holds arrays of shape {given}, this model needs {needed}")


class SequenceDataset(AggregatedDataset):
    """A bounded set of sequences: what one environment saw in one rollout, the oldest leave first. A row is a sequence.

    With each step it holds whether an episode began there, and with each sequence what the actor remembered before it.

    :param capacity: most pairs held; those of whole sequences, and of one at least.
    :param n_steps: of a sequence.
    :param memory_shape: (n_layers, size) of each of the two arrays of the actor's recurrent state.
    """

    def __init__(
        self,
        capacity: int,
        observation_shape: tuple[int, ...],
        action_dim: int,
        dtype: npt.DTypeLike,
        n_steps: int,
        memory_shape: tuple[int, int],
    ) -> None:
        self.row_pairs = n_steps
        shapes = {"observations": (n_steps, *observation_shape), "actions": (n_steps, action_dim), "starts": (n_steps,)}
        shapes |= dict.fromkeys(("hidden", "cell"), memory_shape)
        self._allocate(max(capacity // n_steps, 1), shapes, {"observations": dtype, "starts": np.bool_})

    def add_sequences(
        self,
        observations: npt.NDArray[Any],
        actions: Float32Array,
        starts: BoolArray,
        memory: tuple[Float32Array, Float32Array],
    ) -> None:
        """Add n sequences: observations (n, n_steps, ...), actions (n, n_steps, action_dim), starts (n, n_steps).

        :param memory: hidden and cell state before them, (n, n_layers, size) each.
        """
        self._add(observations=observations, actions=actions, starts=starts, hidden=memory[0], cell=memory[1])

    def sequences(self, rows: th.Tensor) -> list[th.Tensor]:
        """Observations, actions, starts, hidden and cell states of rows (b,), each (b, ...), counted from the oldest."""
        return self._rows(rows)


def sample_rows(n_rows: int, count: int, rng: np.random.Generator, shuffle: bool = True) -> IntArray:
    """``count`` row numbers below ``n_rows``: whole passes in random order, then a remainder at random; or all in order."""
    if not shuffle:
        return np.arange(count, dtype=np.int64) % n_rows
    passes, rest = divmod(count, n_rows)
    parts = [rng.permutation(n_rows) for _ in range(passes)]
    return np.concatenate([*parts, rng.integers(n_rows, size=rest)]).astype(np.int64, copy=False)


def _npz(path: str | Path) -> Path:
    return Path(path) if Path(path).suffix else Path(f"{path}.npz")
