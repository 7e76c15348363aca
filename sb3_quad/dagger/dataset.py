"""The aggregated dataset: visited observations with the expert's action for each."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch as th

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import atomic_write


class AggregatedDataset:
    """A bounded set of (observation, expert action) pairs, on the CPU; the oldest leave first.

    :param capacity: most pairs held
    :param observation_shape: shape of one observation
    :param action_dim: length of one action
    :param dtype: of the observations; actions are float32
    """

    def __init__(
        self, capacity: int, observation_shape: tuple[int, ...], action_dim: int, dtype: npt.DTypeLike = np.float32
    ) -> None:
        self.capacity = capacity
        # np.empty takes no memory before it is written to, so a large capacity costs what is in use.
        self._observations = th.from_numpy(np.empty((capacity, *observation_shape), dtype=dtype))
        self._actions = th.from_numpy(np.empty((capacity, action_dim), dtype=np.float32))
        self._size = 0
        self._oldest = 0

    def __len__(self) -> int:
        return self._size

    def clear(self) -> None:
        """Forget every pair."""
        self._size = self._oldest = 0

    def add(self, observations: npt.NDArray[np.generic], actions: npt.NDArray[np.float32]) -> None:
        """Add observations (n, ...) and actions (n, action_dim), oldest first; of more than ``capacity``, the last."""
        observations, actions = observations[-self.capacity :], actions[-self.capacity :]
        n = len(observations)
        start = (self._oldest + self._size) % self.capacity
        head = min(n, self.capacity - start)  # the rest wraps round to the beginning
        for store, rows in ((self._observations, observations), (self._actions, actions)):
            array = store.numpy()
            array[start : start + head] = rows[:head]
            array[: n - head] = rows[head:]
        overwritten = max(0, self._size + n - self.capacity)
        self._size = self._size + n - overwritten
        self._oldest = (self._oldest + overwritten) % self.capacity

    def draw(self, batch_size: int, n_batches: int, rng: np.random.Generator) -> th.Tensor:
        """Row numbers of ``n_batches`` mini-batches for :meth:`pairs`, shape (n_batches, batch_size).

        Counted from the oldest pair, so that what is drawn does not depend on where the ring begins.
        """
        return th.from_numpy(draw_rows(self._size, n_batches * batch_size, rng)).view(n_batches, batch_size)

    def pairs(self, rows: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Observations (b, ...) and expert actions (b, action_dim) of rows (b,) counted from the oldest."""
        if self._oldest:
            rows = (rows + self._oldest) % self.capacity
        return self._observations.index_select(0, rows), self._actions.index_select(0, rows)

    def save(self, path: Path) -> None:
        """Write every pair, oldest first, to an .npz file; the file appears whole or not at all."""
        observations, actions = self.pairs(th.arange(self._size))
        with atomic_write(path) as file:
            np.savez(file, observations=observations.numpy(), actions=actions.numpy())

    def load(self, path: Path) -> None:
        """Replace the pairs by those of a file that :meth:`save` wrote; the last ``capacity`` of them.

        :raises ConfigError: a file that is missing, damaged, or of other observations or actions
        """
        try:
            with np.load(path, allow_pickle=False) as file:
                observations, actions = file["observations"], file["actions"]
        except (OSError, KeyError, ValueError, EOFError, AttributeError, zipfile.BadZipFile) as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            raise ConfigError(f"dataset {path}: cannot be read ({reason}); it must come from save_dataset") from None
        for name, rows, store in (
            ("observations", observations, self._observations),
            ("actions", actions, self._actions),
        ):
            if rows.shape[1:] != tuple(store.shape[1:]) or len(rows) != len(actions):
                expected = f"({len(actions)}, {', '.join(map(str, store.shape[1:]))})"
                raise ConfigError(f"dataset {path}: {name} of shape {rows.shape}, this model needs {expected}")
        self.clear()
        self.add(observations, actions)


def draw_rows(n_rows: int, count: int, rng: np.random.Generator) -> npt.NDArray[np.int64]:
    """``count`` row numbers below ``n_rows``: whole passes in random order, then a remainder drawn at random."""
    passes, rest = divmod(count, n_rows)
    parts = [rng.permutation(n_rows) for _ in range(passes)]
    return np.concatenate([*parts, rng.integers(n_rows, size=rest)]).astype(np.int64, copy=False)
