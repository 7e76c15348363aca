"""Buffers with an expert's actions: SB3's rollout buffer, and DAgger's dataset."""

from collections.abc import Generator, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch as th
from stable_baselines3.common.buffers import RolloutBuffer

from sb3_quad.base.errors import ConfigError, raised_as
from sb3_quad.base.files import read_arrays, write_arrays
from sb3_quad.base.types import AnyArray, Arrays, Float32Array, IntArray, StrDict, StrPath

# Names of arrays in files; Stable-Baselines 2 and imitation use the shorter ones.
_OBSERVATIONS = ("observations", "obs")
_ACTIONS = ("actions", "acts")


class Batch(NamedTuple):
    """A mini-batch as rows of arrays of length m, which are not copied.

    :param rows: (b,).
    :param observations: (m, ...).
    :param targets: (m, columns): of an actor's row, for the terms that the loss has, the expert's
        action (a), the action flown (a), its log-probability then and its advantage; of a critic's
        row, V at the time of the rollout and the return.
    """

    rows: IntArray
    observations: AnyArray
    targets: Float32Array

    def tensors(self, device: th.device) -> tuple[th.Tensor, th.Tensor]:
        """Return the observations (b, ...) and targets (b, columns)."""
        # PyTorch gathers in a third of the time that NumPy's indexing and a copy take.
        rows = th.from_numpy(self.rows)
        observations = th.from_numpy(self.observations).index_select(0, rows)
        targets = th.from_numpy(self.targets).index_select(0, rows)
        return observations.to(device), targets.to(device)


class ExpertRolloutSamples(NamedTuple):
    """SB3's ``RolloutBufferSamples``, (b, ...) each, and the expert's actions (b, action_dim)."""

    observations: th.Tensor
    actions: th.Tensor
    old_values: th.Tensor
    old_log_prob: th.Tensor
    advantages: th.Tensor
    returns: th.Tensor
    expert_actions: th.Tensor


class ExpertRolloutBuffer(RolloutBuffer):
    """SB3's rollout buffer with the expert's action for each state.

    ``expert_actions`` has shape (buffer_size, n_envs, action_dim) while the buffer fills. The
    algorithm writes row ``pos`` before it calls :meth:`add` for the same step. ``bc_coef`` is the
    weight that the cloning term will have in the update on this rollout. Where it is 0, no row is
    labelled.
    """

    expert_actions: Float32Array
    bc_coef = 0.0

    def reset(self) -> None:
        shape = (self.buffer_size, self.n_envs, self.action_dim)
        self.expert_actions = np.zeros(shape, dtype=np.float32)
        self._targets: tuple[Float32Array, Float32Array] | None = None
        super().reset()

    def get(self, batch_size: int | None = None) -> Generator[ExpertRolloutSamples, None, None]:  # type: ignore[override]
        """Yield mini-batches in random order, as SB3's buffer does, with the expert's actions."""
        n_rows = batch_size or self.buffer_size * self.n_envs
        yield from map(self.samples, self.minibatches(n_rows))

    def minibatches(self, batch_size: int, shuffle: bool = True) -> Iterator[IntArray]:
        """Yield the row numbers (b,) of mini-batches.

        :param shuffle: whether they are in random order. False: consecutive in time, that is the
            first step of all environments, then the second.
        """
        if not self.full:
            raise ValueError("the rollout is not complete")
        n_rows = self.buffer_size * self.n_envs
        if shuffle:
            rows = np.random.permutation(n_rows)  # noqa: NPY002 - as SB3 does, bit for bit
        else:
            # In the flattened arrays, the rows of an environment are consecutive.
            rows = np.arange(n_rows).reshape(self.n_envs, self.buffer_size).T.reshape(-1)
        if not self.generator_ready:
            stock = ("observations", "actions", "values", "log_probs", "advantages", "returns")
            for name in (*stock, "expert_actions"):
                setattr(self, name, self.swap_and_flatten(getattr(self, name)))
            self.generator_ready = True
        for start in range(0, n_rows, batch_size):
            yield rows[start : start + batch_size]

    def samples(self, rows: IntArray) -> ExpertRolloutSamples:
        """Return the rows of a mini-batch as tensors."""
        stock = self._get_samples(rows)
        return ExpertRolloutSamples(*stock, self.to_torch(self.expert_actions[rows]))

    def batches(self, rows: IntArray) -> tuple[Batch, Batch]:
        """Return a mini-batch as an accelerator takes it: for the actor and for the critic."""
        if self._targets is None:
            for_actor = [self.actions, self.log_probs, self.advantages]
            if self.bc_coef != 0.0:
                for_actor.insert(0, self.expert_actions)
            for_critic = [self.values, self.returns]
            self._targets = np.hstack(for_actor, dtype=np.float32), np.hstack(for_critic)
        actor_targets, critic_targets = self._targets
        actor = Batch(rows, self.observations, actor_targets)
        return actor, Batch(rows, self.observations, critic_targets)


class AggregatedDataset:
    """A bounded set of (observation, expert action) pairs on the CPU; the oldest are dropped first.

    :param capacity: maximum number of pairs
    :param observation_shape: shape of one observation
    :param action_dim: length of one action
    :param dtype: dtype of the observations; actions are float32
    """

    #: The lowest and the highest valid actions, (action_dim,) each; a file's must lie between them
    action_range: Any = (-np.inf, np.inf)

    def __init__(
        self,
        capacity: int,
        observation_shape: tuple[int, ...],
        action_dim: int,
        dtype: npt.DTypeLike = np.float32,
    ) -> None:
        self.capacity = capacity
        # np.empty takes no memory until it is written to: a large capacity costs only what is in
        # use.
        self.observations = np.empty((capacity, *observation_shape), dtype)
        self.actions = np.empty((capacity, action_dim), np.float32)
        self.added = 0  # pairs added since it was last empty

    def __len__(self) -> int:
        return min(self.added, self.capacity)

    def clear(self) -> None:
        """Forget every pair."""
        self.added = 0

    def add(self, observations: AnyArray, actions: Float32Array) -> None:
        """Add observations (n, ...) and actions (n, action_dim), oldest first.

        If there are more than ``capacity`` pairs, the last ones are kept.
        """
        n = min(len(actions), self.capacity)
        places = (self.added + np.arange(n)) % self.capacity
        self.observations[places] = observations[-n:]
        self.actions[places] = actions[-n:]
        self.added += n

    def batch(self, rows: IntArray) -> Batch:
        """Return a mini-batch of rows (b,), counted from the oldest, with actions as targets."""
        places = (rows + self.added) % self.capacity if self.added > self.capacity else rows
        return Batch(places, self.observations, self.actions)

    @property
    def pairs(self) -> StrDict:
        """Copies of observations (n, ...) and expert actions (n, action_dim) by name, oldest first.

        :meth:`add` takes them.
        """
        places = self.batch(np.arange(len(self))).rows
        return {"observations": self.observations[places], "actions": self.actions[places]}

    @property
    def filled(self) -> Arrays:
        """Views of the rows in use, in memory order."""
        n = len(self)
        return {"observations": self.observations[:n], "actions": self.actions[:n]}

    def save(self, path: StrPath) -> None:
        """Write the pairs to an ``.npz`` file, which is replaced as a whole or not at all.

        :raises ConfigError: a folder that cannot be written, a full disk.
        """
        write_arrays(path, **self.pairs)

    def load(self, source: Any) -> None:
        """Replace the present pairs with those of recorded flights.

        :param source: an ``.npz`` file with the arrays ``observations`` and ``actions``, as
            :meth:`save` and ``fly(..., record=...)`` write them, or ``obs`` and ``acts``, of one
            flight or (flights, steps, …); or several flights, each with arrays of these names: a
            Minari dataset, or a list of trajectories of imitation. A flight may have one
            observation more than actions, its last.
        :raises ConfigError: a file that is missing or damaged, belongs to other spaces, or has more
            pairs than ``capacity``; the present pairs are kept.
        """
        where = type(source).__name__
        if isinstance(source, (str, Path)):
            where = str(source)
            source = [SimpleNamespace(**read_arrays(source, (*_OBSERVATIONS, *_ACTIONS)))]
        # Start with zero rows of ours, so that concatenating another shape fails.
        seen = [self.observations[:0]]
        acted = [self.actions[:0]]
        # Third-party files may contain anything.
        with raised_as(ConfigError, f"{where}: holds no flights that fit the environment"):
            for flight in source:
                for observations, actions in self._flights(flight):
                    if len(observations) == len(actions) + 1:
                        observations = observations[:-1]
                    seen.append(observations)
                    acted.append(actions.reshape(len(actions), -1))
            observations = np.concatenate(seen, dtype=seen[0].dtype, casting="same_kind")
            actions = np.concatenate(acted, dtype=np.float32)
            if not 0 < len(observations) == len(actions) <= self.capacity:
                raise ValueError(
                    f"{len(observations)} observations, {len(actions)} actions, room for"
                    f" {self.capacity}"
                )
            valid = actions.clip(*self.action_range)
            # This refuses NaN, too, but not what rounding leaves.
            if not np.allclose(actions, valid, rtol=0.0, atol=1e-6):
                low, high = actions.min(), actions.max()
                raise ValueError(f"actions from {low:.9g} to {high:.9g}, beyond the valid ones")
            if not np.isfinite(observations).all():
                raise ValueError("observations that are not finite")
        self.clear()
        self.add(observations, valid)

    def _flights(self, flight: Any) -> Iterator[tuple[AnyArray, AnyArray]]:
        """Yield the observations and the actions of a flight, or of several, (flights, steps, …).

        :raises ValueError: an array is missing.
        """
        observations = _first(flight, _OBSERVATIONS)
        actions = _first(flight, _ACTIONS)
        if observations.ndim > self.observations.ndim:
            yield from zip(observations, actions, strict=True)
        else:
            yield observations, actions


def _first(flight: Any, names: Sequence[str]) -> AnyArray:
    """Return the array that has one of the names.

    :raises ValueError: the flight has no such array.
    """
    for name in names:
        if hasattr(flight, name):
            return np.asarray(getattr(flight, name))
    raise ValueError(f"lacks {' or '.join(names)}")


def sample_rows(
    n_rows: int, count: int, rng: np.random.Generator, shuffle: bool = True
) -> IntArray:
    """Return ``count`` row numbers below ``n_rows``.

    They are whole passes in random order, then a random remainder. Without ``shuffle``, all rows in
    order, again and again.
    """
    if not shuffle:
        return np.arange(count, dtype=np.int64) % n_rows
    passes, rest = divmod(count, n_rows)
    parts = [rng.permutation(n_rows) for _ in range(passes)]
    parts.append(rng.integers(n_rows, size=rest))
    return np.concatenate(parts).astype(np.int64, copy=False)
