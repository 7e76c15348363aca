"""What algorithms learn from: SB3's rollout and replay buffers with the expert's actions, and
DAgger's dataset.
"""

from collections.abc import Generator
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch as th
from stable_baselines3.common.buffers import (
    DictReplayBuffer,
    NStepReplayBuffer,
    ReplayBuffer,
    RolloutBuffer,
)
from stable_baselines3.common.vec_env import VecNormalize

from sb3_quad.algorithms.networks.gradients import Batch
from sb3_quad.base.arrays import Arrays, Float32Array, IntArray


class ExpertRolloutBuffer(RolloutBuffer):
    """SB3's rollout buffer with a row of expert actions beside each row of actions.

    ``expert_actions`` has shape (buffer_size, n_envs, action_dim) while the buffer fills; the
    algorithm writes row ``pos`` before it calls :meth:`add` for the same step. ``labelled`` says
    whether it does so in this rollout.
    """

    expert_actions: Float32Array
    labelled = False

    def reset(self) -> None:
        self.expert_actions = np.zeros(
            (self.buffer_size, self.n_envs, self.action_dim), dtype=np.float32
        )
        self._targets: tuple[Float32Array, Float32Array] | None = None
        super().reset()

    def get(
        self, batch_size: int | None = None, shuffle: bool = True
    ) -> Generator[tuple[Batch, Batch], None, None]:  # type: ignore[override]
        """Mini-batches of the actor and of the critic, the same rows; without ``shuffle``,
        consecutive in time.
        """
        in_time, first = (
            np.arange(self.buffer_size * self.n_envs).reshape(self.n_envs, -1).T.reshape(-1),
            0,
        )
        sampled: Any = super().get(batch_size)
        for rows in sampled:
            if self._targets is None:
                labels = [self.swap_and_flatten(self.expert_actions)] if self.labelled else []
                for_actor = np.hstack(
                    [*labels, self.actions, self.log_probs, self.advantages], dtype=np.float32
                )
                self._targets = for_actor, np.hstack([self.values, self.returns])
            chosen = rows if shuffle else in_time[first : first + len(rows)]
            first += len(rows)
            yield (
                Batch(chosen, self.observations, self._targets[0]),
                Batch(chosen, self.observations, self._targets[1]),
            )

    def _get_samples(self, batch_inds: IntArray, env: VecNormalize | None = None) -> IntArray:  # type: ignore[override]
        return batch_inds


class ExpertReplaySamples(NamedTuple):
    """SB3's ``ReplayBufferSamples``, (b, ...) each, with the expert's scaled actions; Dict
    observations by key.
    """

    observations: th.Tensor | dict[str, th.Tensor]
    actions: th.Tensor
    next_observations: th.Tensor | dict[str, th.Tensor]
    dones: th.Tensor
    rewards: th.Tensor
    discounts: th.Tensor | None
    expert_actions: th.Tensor


class ExpertReplayBuffer(ReplayBuffer):
    """SB3's replay buffer with the expert's scaled actions for each state.

    The algorithm calls :meth:`label` before it calls :meth:`add` for the same step.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.expert_actions = np.zeros((self.buffer_size, self.n_envs, self.action_dim), np.float32)

    def label(self, actions: Float32Array) -> None:
        """Set the expert's actions (n_envs, action_dim) for the row that is added next."""
        self.expert_actions[self.pos] = actions

    def _get_samples(
        self, batch_inds: IntArray, env: VecNormalize | None = None
    ) -> ExpertReplaySamples:  # type: ignore[override]
        # SB3 samples each row's environment itself and keeps it to itself: the same numbers are
        # sampled twice.
        before = np.random.get_state()  # noqa: NPY002
        at = batch_inds, np.random.randint(0, high=self.n_envs, size=batch_inds.shape)  # noqa: NPY002
        np.random.set_state(before)  # noqa: NPY002
        return ExpertReplaySamples(
            *super()._get_samples(batch_inds, env), self.to_torch(self.expert_actions[at])
        )


class ExpertNStepReplayBuffer(ExpertReplayBuffer, NStepReplayBuffer):  # type: ignore[misc]
    """The same with SB3's n-step returns."""


class ExpertDictReplayBuffer(ExpertReplayBuffer, DictReplayBuffer):  # type: ignore[misc]
    """The same for Dict observations."""


class AggregatedDataset:
    """A bounded set of (observation, expert action) pairs, on the CPU; the oldest leave first.

    :param capacity: most pairs held
    :param observation_shape: shape of one observation
    :param action_dim: length of one action
    :param dtype: of the observations; actions are float32
    """

    def __init__(
        self,
        capacity: int,
        observation_shape: tuple[int, ...],
        action_dim: int,
        dtype: npt.DTypeLike = np.float32,
    ) -> None:
        self.capacity = capacity
        # np.empty takes no memory before it is written to, so a large capacity costs what is in
        # use.
        self._arrays = {
            "observations": np.empty((capacity, *observation_shape), dtype),
            "actions": np.empty((capacity, action_dim), np.float32),
        }
        self.added = 0  # since it was empty

    def __len__(self) -> int:
        return min(self.added, self.capacity)

    def clear(self) -> None:
        """Forget every pair."""
        self.added = 0

    def add(self, observations: npt.NDArray[Any], actions: Float32Array) -> None:
        """Add observations (n, ...) and actions (n, action_dim), oldest first; of more than
        ``capacity``, the last.
        """
        n = min(len(actions), self.capacity)
        places = (self.added + np.arange(n)) % self.capacity
        for array, new in zip(self._arrays.values(), (observations, actions), strict=True):
            array[places] = new[-n:]
        self.added += n

    def batch(self, rows: IntArray) -> Batch:
        """A mini-batch of rows (b,), counted from the oldest, with their actions as targets."""
        places = (rows + self.added) % self.capacity if self.added > self.capacity else rows
        return Batch(places, self._arrays["observations"], self._arrays["actions"])

    @property
    def pairs(self) -> Arrays:
        """Copies of observations (n, ...) and expert actions (n, action_dim), by name, oldest
        first, as for :meth:`add`.
        """
        return {
            name: array[self.batch(np.arange(len(self))).rows]
            for name, array in self._arrays.items()
        }

    @property
    def filled(self) -> Arrays:
        """Views of the rows that are in use, in the order of memory."""
        return {name: array[: len(self)] for name, array in self._arrays.items()}


def sample_rows(
    n_rows: int, count: int, rng: np.random.Generator, shuffle: bool = True
) -> IntArray:
    """``count`` row numbers below ``n_rows``: whole passes in random order, then a remainder at
    random; or all in order.
    """
    if not shuffle:
        return np.arange(count, dtype=np.int64) % n_rows
    passes, rest = divmod(count, n_rows)
    parts = [rng.permutation(n_rows) for _ in range(passes)]
    return np.concatenate([*parts, rng.integers(n_rows, size=rest)]).astype(np.int64, copy=False)
